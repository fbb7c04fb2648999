"""Pictures of values (PNG) and frames with pages for notebooks."""

import html
import io
from dataclasses import replace
from functools import singledispatch
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image
from torch import Tensor

from splatgraft.capture import MIN_VIEWS, VirtualCameraOptions, place_virtual_cameras
from splatgraft.capture.virtual_cameras import dense_part
from splatgraft.compositing.composite import Composite
from splatgraft.core.bounds import bounding_sphere
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import resize, srgb_from_linear
from splatgraft.core.posed_images import PosedImages
from splatgraft.exports.export_source import ExportSource, first_view
from splatgraft.formats import SceneMetadata
from splatgraft.relighting import Light, Relit
from splatgraft.relighting.light.environment import equirectangular_directions
from splatgraft.relighting.report import mark_source
from splatgraft.rendering import render

_WIDTH = 640  # pixels of a picture
_CELL_HEIGHT, _COLUMNS = 120, 4  # photographs in the picture of a capture, in two rows
_NEAR = 6.0  # largest distance from the objects' middle, in their radii; they fill a third of the picture
_ALONE = 2.0  # radius of all over that of the dense part below which a scene is one thing; captured places have more
_WHOLE_FOV_DEG = 60.0  # at the first view's distance the bounding sphere spans 54 degrees
_LIGHT_HEIGHT = 256  # rows of a panorama


@singledispatch
def picture_of(value: Any) -> bytes | None:
    """Draw a value as a PNG; None if it has no picture."""
    return None


@picture_of.register
def _scene(scene: Gaussians) -> bytes | None:
    return _from_virtual_cameras(scene, None)


@picture_of.register
def _with_objects(value: Composite | Relit) -> bytes | None:
    return _from_virtual_cameras(*value.bake())


def _from_virtual_cameras(scene: Gaussians, is_object: Bool[Tensor, "n"] | None) -> bytes | None:
    """Draw a scene towards its middle, or from near its objects; a thing without surroundings is drawn whole."""
    try:
        options = VirtualCameraOptions(views=MIN_VIEWS, picture_width=_WIDTH)
        place = scene if is_object is None else scene.select(~is_object)
        cameras = place_virtual_cameras(place, options)[0].cameras
    except ValueError:  # too few solid Gaussians
        return None
    x, y, z = estimate_up(cameras).tolist()
    source = ExportSource(scene, "", is_object, cameras=cameras, metadata=SceneMetadata((x, y, z)))
    view, _ = first_view(source)
    if is_object is not None and bool(is_object.any()):
        away, reach = (
            torch.tensor(view.eye) - torch.tensor(view.center),
            bounding_sphere(scene.select(is_object)).radius,
        )
        x, y, z = (torch.tensor(view.center) + away * min(1.0, _NEAR * reach / float(away.norm()))).tolist()
        view = replace(view, eye=(x, y, z))
    elif is_object is None and bounding_sphere(scene).radius < _ALONE * dense_part(scene.means)[1]:
        view = replace(first_view(replace(source, cameras=None))[0], fov_deg=_WHOLE_FOV_DEG)
    return _png(render(scene, view.camera(_WIDTH)).color[0])


@picture_of.register
def _export(source: ExportSource) -> bytes:
    return _png(render(source.scene, first_view(source)[0].camera(_WIDTH)).color[0])


@picture_of.register
def _capture(capture: PosedImages) -> bytes | None:
    """Draw up to 8 photographs side by side."""
    count = min(2 * _COLUMNS, len(capture.image_paths))
    if not count:
        return None
    width = round(_CELL_HEIGHT * float((capture.cameras.sizes[:, 0] / capture.cameras.sizes[:, 1]).median()))
    small, chosen = capture.limited(2 * width), torch.linspace(0, len(capture) - 1, count).round().int().tolist()
    cells = [resize(small.reduced_image(index), width, _CELL_HEIGHT) for index in chosen]
    cells += [torch.ones_like(cells[0])] * (-count % min(count, _COLUMNS))
    return _png(torch.cat([torch.cat(cells[i : i + _COLUMNS], 1) for i in range(0, len(cells), _COLUMNS)]))


@picture_of.register
def _light(light: Light) -> bytes:
    """Draw the ambient light as `splatgraft light` writes it, top +z, middle +x, with circles around the sources."""
    directions = equirectangular_directions(_LIGHT_HEIGHT)
    radiance = light.ambient_radiance(directions.reshape(-1, 3)).reshape(directions.shape)
    canvas = (srgb_from_linear(radiance).clamp(0, 1) * 255).byte().numpy()
    for source in light.sources:
        mark_source(canvas, source, torch.diag(torch.tensor([1.0, -1.0, 1.0])))
    return _png(torch.from_numpy(canvas) / 255)


def _png(pixels: Float[Tensor, "h w 3"]) -> bytes:
    stream, stored = io.BytesIO(), (pixels.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
    Image.fromarray(np.ascontiguousarray(stored)).save(stream, "PNG")
    return stream.getvalue()


def frame_of(page: Path, *, height: int) -> str:
    """Return the HTML of a frame, `height` pixels high, that holds a whole page."""
    content = html.escape(page.read_text("utf-8"))
    return f'<iframe srcdoc="{content}" style="width: 100%; height: {height}px; border: 0"></iframe>'
