"""The picture of a project on the start page: the newest of those that it wrote, made small."""

import io
from pathlib import Path

from PIL import Image, UnidentifiedImageError

from splatgraft.project.layout import EDITOR_FOLDER, EXPORTS_FOLDER, PREVIEW_FILE

_RESULTS = ("report/after.png", f"{EDITOR_FOLDER}/{PREVIEW_FILE}")
_EXPORTED = (".png", ".jpg")
_SIZE = (560, 350)
"""Pixels; cards are 280 wide, on screens of twice the density."""
_MAX_PIXELS = 64_000_000
"""Larger pictures are not read: they would need much memory."""
_QUALITY = 84


def newest_picture(root: Path) -> Path | None:
    """The newest picture of a project's result or preview; None where it has none.

    Args:
        root: Folder of the project's results. A link that leads out of it does not count.
    """
    exported = (root / EXPORTS_FOLDER).glob("*") if (root / EXPORTS_FOLDER).is_dir() else ()
    names = [root / name for name in _RESULTS]
    names += [path for path in exported if path.suffix in _EXPORTED and not path.name.startswith(".")]
    inside = root.resolve()
    found = [path for path in names if path.is_file() and path.resolve().is_relative_to(inside)]
    return max(found, key=lambda path: (path.stat().st_mtime_ns, path.name), default=None)


def thumbnail(picture: Path) -> bytes | None:
    """A small JPEG of the middle of a picture; None where it cannot be read."""
    try:
        with Image.open(picture) as found:
            if found.width * found.height > _MAX_PIXELS:
                return None
            found.draft("RGB", _SIZE)
            small = _cropped(found.convert("RGBA"))
    except (OSError, ValueError, SyntaxError, UnidentifiedImageError, Image.DecompressionBombError):
        return None
    # parts of a scene have alpha
    behind = Image.new("RGBA", small.size, (104, 106, 112, 255))
    stream = io.BytesIO()
    Image.alpha_composite(behind, small).convert("RGB").save(stream, "JPEG", quality=_QUALITY)
    return stream.getvalue()


def _cropped(picture: Image.Image) -> Image.Image:
    """The largest middle part of the thumbnail's shape, at its size."""
    width, height = picture.size
    scale = min(width / _SIZE[0], height / _SIZE[1])
    part = (scale * _SIZE[0], scale * _SIZE[1])
    left, top = (width - part[0]) / 2, (height - part[1]) / 2
    return picture.resize(_SIZE, Image.Resampling.LANCZOS, box=(left, top, left + part[0], top + part[1]))
