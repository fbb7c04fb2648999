"""The report of `evaluate` as one HTML file: its pictures are encoded smaller and put into the page."""

import base64
import io
import json
import re
from pathlib import Path

from PIL import Image

from splatgraft.runtime.files import atomic_write

_LONGEST_PX = 1200
_QUALITY = 80
_THUMBNAIL_PX = 240
"""Twice the width at which the page shows them."""
_DATA = re.compile(r'(<script type="application/json" id="views">)(.*?)(</script>)', re.DOTALL)
_LOCAL = re.compile(r'(<(?:img|a)\b[^>]*?\b(?:src|href)=")([^":#]+)(")')
_NOTE = "The page needs only the files in its folder; it loads nothing from the network."
_NOTHING = "data:image/gif;base64,R0lGODlhAQABAAAAACH5BAEKAAEALAAAAAABAAEAAAICTAEAOw=="
"""An empty picture, until the page's script sets the pictures of a view."""


def write_report_file(path: Path, report: Path) -> None:
    """Write the page.

    Args:
        path: A file that ends in .html.
        report: The index.html that `evaluate` wrote, beside its pictures.

    Raises:
        ValueError: There is no report, or one of its pictures is missing.
    """
    if not report.is_file():
        raise ValueError(f"{report}: expected the report of a project, found none; `splatgraft run` writes it")
    text = report.read_text(encoding="utf-8")
    folder = report.parent
    embedded: dict[str, str] = {}

    def whole(name: str) -> str:
        if name not in embedded:
            embedded[name] = _embedded(folder / name, _LONGEST_PX)
        return embedded[name]

    def views(found: re.Match[str]) -> str:
        content = json.loads(found[2])
        for view in content:
            view["files"] = {label: whole(name) for label, name in view["files"].items()}
        return found[1] + json.dumps(content).replace("<", "\\u003c") + found[3]

    def local(found: re.Match[str]) -> str:
        tag, name = found[1], found[2]
        if 'id="left"' in tag or 'id="right"' in tag:
            return tag + _NOTHING + found[3]  # set by the page's script, which has the same picture
        if name.endswith(".json"):  # browsers do not open data addresses, but they save them
            tag = tag.replace("<a ", f'<a download="{name}" ')
        small = name.startswith("views/")
        return tag + (_embedded(folder / name, _THUMBNAIL_PX) if small else whole(name)) + found[3]

    text = _LOCAL.sub(local, text)
    text = _DATA.sub(views, text).replace(_NOTE, "All is in this file; it loads nothing from the network.")
    with atomic_write(path) as stream:
        stream.write(text.encode())


def _embedded(path: Path, longest_px: int) -> str:
    """A file as a data address; pictures no larger than `longest_px`, animations and other files as they are."""
    if not path.is_file():
        raise ValueError(f"{path}: expected a file of the report, found none; `splatgraft run` writes it again")
    if path.suffix.lower() == ".json":
        return _data("application/json", path.read_bytes())
    with Image.open(path) as picture:
        if getattr(picture, "is_animated", False):
            return _data(f"image/{path.suffix[1:].lower()}", path.read_bytes())
        picture.thumbnail((longest_px, longest_px), Image.Resampling.LANCZOS)
        stream = io.BytesIO()
        picture.convert("RGB").save(stream, "WEBP", quality=_QUALITY, method=4)
    return _data("image/webp", stream.getvalue())


def _data(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"
