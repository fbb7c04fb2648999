"""One HTML file that holds scenes and a viewer for them, and loads nothing from anywhere.

The scenes are SOG, the viewer is `viewer/viewer.js` on the PlayCanvas engine (MIT; its licence is part of the page). A
content security policy in the page forbids every request.
"""

import base64
import gzip
import json
from collections.abc import Mapping
from html import escape
from importlib.resources import files
from pathlib import Path

from splatgraft.core.gaussians import Gaussians
from splatgraft.exports.first_view import FirstView
from splatgraft.formats.scenes.scene_file import SceneMetadata
from splatgraft.formats.scenes.sog import encode_sog
from splatgraft.runtime.files import atomic_write

_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' blob:; worker-src blob:; "
    "style-src 'unsafe-inline'; img-src blob: data:; connect-src blob:"
)


def write_viewer_page(
    path: Path, scenes: Mapping[str, Gaussians], view: FirstView, *, title: str, background: float = 0.0
) -> None:
    """Write the page.

    Args:
        path: A file that ends in .html.
        scenes: Label of the button to scene, in one frame; the last one is shown first. No buttons for a single one.
        view: Where the camera starts.
        title: Of the page.
        background: Grey behind the scene, sRGB.

    Raises:
        ValueError: A scene has no Gaussians, or some that are not finite.
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
