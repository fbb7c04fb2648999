"""HTML files without any request to the network: scenes with a viewer, and the report of `evaluate`.

The scenes are SOG, the viewer is `viewer/viewer.js` on the PlayCanvas engine (MIT; its licence is part of the page).
The page shows a still of the opening view until the engine has drawn. A content security policy in the page forbids
every request. Pictures of a report are made smaller and put into the page.
"""

import base64
import gzip
import io
import json
import math
import re
from collections.abc import Mapping
from dataclasses import replace
from html import escape
from importlib.resources import files
from pathlib import Path

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from splatgraft.core.gaussians import Gaussians
from splatgraft.exports.export_source import FirstView
from splatgraft.formats.scenes.scene_file import SceneMetadata
from splatgraft.formats.scenes.sog import encode_sog
from splatgraft.rendering import render
from splatgraft.runtime.files import atomic_write

_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' blob:; worker-src blob:; "
    "style-src 'unsafe-inline'; img-src blob: data:; connect-src blob:"
)
_LONGEST_PX = 1200
_QUALITY = 80
_THUMBNAIL_PX = 240  # twice the width at which the page shows them
_DATA = re.compile(r'(<script type="application/json" id="views">)(.*?)(</script>)', re.DOTALL)
_LOCAL = re.compile(r'(<(?:img|a)\b[^>]*?\b(?:src|href)=")([^":#]+)(")')
_NOTE = "The page needs only the files in its folder; it loads nothing from the network."
_SPLIT = 0.5  # first position of the divider between two scenes, share of the width
_WIDEST = 2.0
"""Largest factor on the tangent of half the vertical field of view: a page narrower than the first view widens it to
show the view's whole width."""
_STILL_ASPECT = 1.2
"""Width over height of the still; with the height of the narrowest page it covers pages of an aspect up to 2.4."""
_STILL_PX = 1600  # width of the still; a page of 1280 x 800 pixels shows 1067 of them
_STILL_QUALITY = 60
_NOTHING = "data:image/gif;base64,R0lGODlhAQABAAAAACH5BAEKAAEALAAAAAABAAEAAAICTAEAOw=="
"""Empty picture, shown until the page's script sets the pictures of a view."""


def write_viewer_page(
    path: Path, scenes: Mapping[str, Gaussians], view: FirstView, *, title: str, background: float = 0.0
) -> None:
    """Write a page that shows one scene, or two with a divider between them; the first is left of it.

    `scenes` has finite Gaussians by label. `background` is the grey behind the scene, sRGB.
    """
    here = files("splatgraft.exports") / "viewer"
    engine = (here / "playcanvas.js").read_bytes()
    distance = sum((a - b) ** 2 for a, b in zip(view.eye, view.center, strict=True)) ** 0.5
    viewer_options = {
        "scenes": list(scenes),
        "split": _SPLIT if len(scenes) > 1 else 0,
        "eye": view.eye,
        "center": view.center,
        "up": view.up,
        "fov_deg": view.fov_deg,
        "aspect": view.aspect,
        "widest": _WIDEST,
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
        still=_base64(_still(list(scenes.values()), view, background)),
        still_width=f"{100 * _WIDEST / view.aspect:.2f}vw",
        split=round(100 * _SPLIT),
        hidden="" if len(scenes) > 1 else " hidden",
        still_tallest=f"{100 * _WIDEST:g}%",
        view=json.dumps(viewer_options).replace("<", "\\u003c"),
        engine=_base64(gzip.compress(engine, 9, mtime=0)),
        data=data,
        reset=_icon("M4 4v6h6 M5 10a8 8 0 1 1-.6 5"),
        divider=_icon("M9 6l-6 6 6 6 M15 6l6 6-6 6"),
        whole=_icon("M4 9V4h5 M15 4h5v5 M20 15v5h-5 M9 20H4v-5"),
        viewer=(here / "viewer.js").read_text(encoding="utf-8"),
    )
    with atomic_write(path) as stream:
        stream.write(text.encode())


def _still(scenes: list[Gaussians], view: FirstView, background: float) -> bytes:
    """Draw the opening view as WebP, with margins for pages of other shapes; two scenes share it at the divider."""
    tangent = _WIDEST * math.tan(math.radians(view.fov_deg) / 2)
    wider = replace(view, fov_deg=2 * math.degrees(math.atan(tangent)), aspect=_STILL_ASPECT)
    camera = wider.camera(_STILL_PX)
    pictures: list[Float[Tensor, "h w 3"]] = []
    for scene in scenes:
        drawn = render(scene, camera)
        pictures.append(drawn.color[0] + background * (1 - drawn.alpha[0])[..., None])
    if len(pictures) > 1:
        at = round(_SPLIT * _STILL_PX)
        pictures = [torch.cat([pictures[0][:, :at], pictures[1][:, at:]], 1)]
    pixels = (pictures[0].detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "WEBP", quality=_STILL_QUALITY, method=4)
    return stream.getvalue()


def write_report_file(path: Path, report: Path) -> None:
    """Write the report of `evaluate` (index.html and its pictures) to one file; ValueError if a file is missing."""
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
            return tag + _NOTHING + found[3]  # the page's script, which has the same picture, sets it
        if name.endswith(".json"):  # browsers save data addresses, but do not open them
            tag = tag.replace("<a ", f'<a download="{name}" ')
        small = name.startswith("views/")
        return tag + (_embedded(folder / name, _THUMBNAIL_PX) if small else whole(name)) + found[3]

    text = _LOCAL.sub(local, text)
    text = _DATA.sub(views, text).replace(_NOTE, "All is in this file; it loads nothing from the network.")
    with atomic_write(path) as stream:
        stream.write(text.encode())


def _embedded(path: Path, longest_px: int) -> str:
    """Encode a file as a data address; pictures are reduced to `longest_px`, animations and JSON are kept."""
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
<div id="still"><img alt="" decoding="sync" style="height: clamp(100%, {still_width}, {still_tallest})"
src="data:image/webp;base64,{still}"></div>
<div id="divider" role="slider" tabindex="0" aria-label="Share of the picture before the change" aria-valuemin="0"
aria-valuemax="100" aria-valuenow="{split}" style="left: {split}%"{hidden}>{divider}</div>
<h1>{title}</h1>
<div class="corner" role="group" aria-label="View">
<button type="button" id="reset" aria-label="Back to the first view" title="Back to the first view">{reset}</button>
<button type="button" id="whole" aria-label="Full screen" title="Full screen">{whole}</button>
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
