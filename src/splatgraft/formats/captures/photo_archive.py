"""Photos in a .zip file, as phones and cloud services offer them."""

import shutil
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath, PureWindowsPath

from splatgraft.core.images import IMAGE_SUFFIXES

_MAX_FILES = 20_000
_MAX_BYTES = 32 << 30  # unpacked, of all photos
_MAX_RATIO = 20  # unpacked over packed bytes; photos are compressed already, and masks are small
_SMALL = 256 << 20  # bytes below which any ratio is accepted
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Accepted compression: zipfile unpacks each block of the others whole, which may be thousands of times larger."""


def is_archive(path: Path) -> bool:
    """Whether a path is a .zip file."""
    return path.suffix.lower() == ".zip" and path.is_file()


def count_archived_photos(archive: Path) -> int:
    """Count the photos and masks in a .zip file without unpacking it."""
    with _opened(archive) as (_, members):
        return len(members)


def unpack_photos(archive: Path, folder: Path) -> Path:
    """Unpack the photos and masks of a .zip file to `folder`, with the archive's folders.

    Args:
        archive: A .zip file; files that are no images are left out.
        folder: A new folder; it has all photos at the end, or does not exist.

    Returns:
        `folder`.

    Raises:
        ValueError: The archive is damaged, encrypted or without photos, names files outside of its folder, or is larger
            than any capture.
    """
    partial = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        with _opened(archive) as (opened, members):
            for member, name in members:
                target = partial / name
                target.parent.mkdir(parents=True, exist_ok=True)
                with opened.open(member) as packed, target.open("wb") as out:
                    # zipfile reads at most the size that was checked
                    shutil.copyfileobj(packed, out)
        partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return folder


@contextmanager
def _opened(archive: Path) -> Iterator[tuple[zipfile.ZipFile, list[tuple[zipfile.ZipInfo, PurePosixPath]]]]:
    """Open an archive, and check its members that are images."""
    expected = f"{archive}: expected a .zip of photos, found"
    try:
        with zipfile.ZipFile(archive) as opened:
            members = [(one, PurePosixPath(one.filename)) for one in opened.infolist()]
            members = [(one, name) for one, name in members if not one.is_dir() and _is_picture(name)]
            for _, name in members:
                if name.is_absolute() or PureWindowsPath(name).drive or ".." in name.parts:
                    raise ValueError(f"{expected} one that writes outside of its folder, to {name}")
            size = sum(one.file_size for one, _ in members)
            if len(members) > _MAX_FILES or size > max(_SMALL, min(_MAX_BYTES, _MAX_RATIO * archive.stat().st_size)):
                raise ValueError(f"{expected} one that unpacks to {len(members)} files of {size / 1e9:.1f} GB")
            if any(one.compress_type not in _METHODS for one, _ in members):
                raise ValueError(f"{expected} one that is not deflated or stored")
            if not members:
                raise ValueError(f"{expected} no photo in it")
            yield opened, members
    except (zipfile.BadZipFile, RuntimeError, NotImplementedError, EOFError, zlib.error) as error:
        # zipfile raises RuntimeError for a password
        raise ValueError(f"{expected} one that cannot be read ({error})") from None


def _is_picture(name: PurePosixPath) -> bool:
    hidden = any(part.startswith((".", "__MACOSX")) and part != ".." for part in name.parts)
    return name.suffix.lower() in IMAGE_SUFFIXES and not hidden
