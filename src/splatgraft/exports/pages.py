"""HTML files that load nothing from anywhere: scenes with a viewer for them, and the report of `evaluate`.

The scenes are SOG, the viewer is `viewer/viewer.js` on the PlayCanvas engine (MIT; its licence is part of the page). A
content security policy in the page forbids every request. Pictures of a report are made smaller and put into the page.
"""

import base64
import gzip
import io
import json
import re
from collections.abc import Mapping
from html import escape
from importlib.resources import files
from pathlib import Path

from PIL import Image

from splatgraft.core.gaussians import Gaussians
from splatgraft.exports.export_source import FirstView
from splatgraft.formats.scenes.scene_file import SceneMetadata
from splatgraft.formats.scenes.sog import encode_sog
from splatgraft.runtime.files import atomic_write

_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' blob:; worker-src blob:; "
    "style-src 'unsafe-inline'; img-src blob: data:; connect-src blob:"
)
_LONGEST_PX = 1200
_QUALITY = 80
_THUMBNAIL_PX = 240
"""Twice the width at which the page shows them."""
_DATA = re.compile(r'(<script type="application/json" id="views">)(.*?)(</script>)', re.DOTALL)
_LOCAL = re.compile(r'(<(?:img|a)\b[^>]*?\b(?:src|href)=")([^":#]+)(")')
_NOTE = "The page needs only the files in its folder; it loads nothing from the network."
_NOTHING = "data:image/gif;base64,R0lGODlhAQABAAAAACH5BAEKAAEALAAAAAABAAEAAAICTAEAOw=="
"""An empty picture, until the page's script sets the pictures of a view."""


def write_viewer_page(
    path: Path, scenes: Mapping[str, Gaussians], view: FirstView, *, title: str, background: float = 0.0
) -> None:
    """Write a page of finite scenes by the label of their button; the last one is shown first, a single one has none.

    `background` is the grey behind the scene, sRGB.
    """
    here = files("splatgraft.exports") / "viewer"
    engine = (here / "playcanvas.js").read_bytes()
    distance = sum((a - b) ** 2 for a, b in zip(view.eye, view.center, strict=True)) ** 0.5
    told = {
        "scenes": list(scenes),
        "first": len(scenes) - 1,
        "eye": view.eye,
        "center": view.center,
        "up": view.up,
        "fov_deg": view.fov_deg,
        "aspect": view.aspect,
        "near": 0.01 * distance,
        "far": 100 * distance,
        "background": [background] * 3,
    }
    metadata = SceneMetadata(up=view.up)
    packed = [encode_sog(path, gaussians, metadata) for gaussians in scenes.values()]
    data = "\n".join(
        f'<script type="application/octet-stream" id="scene{index}">{_base64(scene)}</script>'
        for index, scene in enumerate(packed)
    )
    text = _PAGE.format(
        policy=_POLICY,
        title=escape(title),
        licence=(here / "playcanvas.LICENSE.txt").read_text(encoding="utf-8").strip(),
        style=(here / "viewer.css").read_text(encoding="utf-8"),
        view=json.dumps(told).replace("<", "\\u003c"),
        engine=_base64(gzip.compress(engine, 9, mtime=0)),
        data=data,
        reset=_icon("M4 4v6h6 M5 10a8 8 0 1 1-.6 5"),
        whole=_icon("M4 9V4h5 M15 4h5v5 M20 15v5h-5 M9 20H4v-5"),
        viewer=(here / "viewer.js").read_text(encoding="utf-8"),
    )
    with atomic_write(path) as stream:
        stream.write(text.encode())


def write_report_file(path: Path, report: Path) -> None:
    """Write the index.html that `evaluate` wrote beside its pictures as one file; ValueError where one is missing."""
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
        return "data:application/json;base64," + _base64(path.read_bytes())
    with Image.open(path) as picture:
        if getattr(picture, "is_animated", False):
            return f"data:image/{path.suffix[1:].lower()};base64,{_base64(path.read_bytes())}"
        picture.thumbnail((longest_px, longest_px), Image.Resampling.LANCZOS)
        stream = io.BytesIO()
        picture.convert("RGB").save(stream, "WEBP", quality=_QUALITY, method=4)
    return "data:image/webp;base64," + _base64(stream.getvalue())


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


def _icon(path: str) -> str:
    return f'<svg viewBox="0 0 24 24" aria-hidden="true"><path d="{path}"/></svg>'


_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1, viewport-fit=cover">
<title>{title}</title>
<!-- Made by splatgraft. It shows the scene with the PlayCanvas engine:
{licence}
-->
<style>
{style}</style>
</head>
<body data-state="loading">
<canvas id="canvas" tabindex="0" role="img" aria-busy="true" aria-label="{title}. Drag or use the arrow keys to turn,
plus and minus to come nearer, Home to go back."></canvas>
<h1>{title}</h1>
<div class="corner" role="group" aria-label="View">
<button type="button" id="reset" aria-label="Back to the first view" title="Back to the first view">{reset}</button>
<button type="button" id="whole" aria-label="Whole screen" title="Whole screen">{whole}</button>
</div>
<div class="bar" id="scenes" role="group" aria-label="Compare"></div>
<div id="message" role="status"></div>
<noscript>The scene is shown by a script in this page.</noscript>
<script type="application/json" id="view">{view}</script>
<script type="application/octet-stream" id="engine">{engine}</script>
{data}
<script>
{viewer}</script>
</body>
</html>
"""
