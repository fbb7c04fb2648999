"""Pictures of the estimated lights."""

import math

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.directions import tangents
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import srgb_from_linear
from splatgraft.relighting.light.estimate import EstimatedLight
from splatgraft.relighting.light.light import LightSource
from splatgraft.relighting.light.panorama import cube_pixels, nearest_directions, render_panorama

_HEIGHT = 256  # pixels of the panorama, which is twice as wide
_FACE = 128  # pixels; face width of the cube map
_UNSEEN = torch.tensor([0.35, 0.35, 0.38])  # sRGB of directions that were not photographed
_STOPS = 2.0  # residual of full colour: red if a surface is brighter than explained, blue if it is darker
_RED, _WHITE, _BLUE = torch.tensor([[0.8, 0.1, 0.1], [0.92, 0.92, 0.92], [0.1, 0.25, 0.8]])


def draw_light(found: EstimatedLight, scene: Gaussians, center: Float[Tensor, "3"]) -> Float[Tensor, "h w 3"]:
    """Draw the panorama at a place with circled sources, and beside it the surfaces from above coloured by residual.

    Args:
        found: The estimate.
        scene: All Gaussians, without the object.
        center: Middle of the place, world units.

    Returns:
        sRGB in [0, 1].
    """
    frame = torch.stack([*tangents(found.evidence.up), found.evidence.up])
    return torch.cat([_panorama(found, scene, center, frame), _surfaces(found, center, frame)], 1)


def _panorama(
    found: EstimatedLight, scene: Gaussians, center: Float[Tensor, "3"], frame: Float[Tensor, "3 3"]
) -> Float[Tensor, "h w 3"]:
    height = math.pi * (0.5 - (torch.arange(_HEIGHT) + 0.5) / _HEIGHT)[:, None]
    turn = 2 * math.pi * ((torch.arange(2 * _HEIGHT) + 0.5) / (2 * _HEIGHT) - 0.5)[None]
    flat = torch.stack([height.cos() * turn.cos(), height.cos() * turn.sin(), height.sin() + 0 * turn], -1)
    directions = (flat @ frame).reshape(-1, 3)
    points = found.evidence.surfaces.points
    nearest = 0.25 * float((points - center).norm(dim=1).median()) if len(points) else 0.0
    cube = render_panorama(scene, center, size=_FACE, nearest=nearest)
    shown = srgb_from_linear(cube.radiance.reshape(-1, 3)[cube_pixels(directions, _FACE)].clamp(0, 1))
    seen = found.evidence.around.seen[nearest_directions(directions)][:, None]
    image = (seen * shown + (1 - seen) * _UNSEEN).reshape(_HEIGHT, 2 * _HEIGHT, 3)
    canvas = np.ascontiguousarray((image * 255).byte().numpy())
    for source in found.light.sources:
        mark_source(canvas, source, frame)
    return torch.from_numpy(canvas).float() / 255


def mark_source(canvas: np.ndarray, source: LightSource, frame: Float[Tensor, "3 3"]) -> None:
    """Draw a circle with a source's name in a panorama of 256 rows, uint8, whose axes are the rows of `frame`."""
    x, y, z = (frame @ torch.tensor(source.direction)).tolist()
    column = (math.atan2(y, x) / (2 * math.pi) + 0.5) * 2 * _HEIGHT
    row = (0.5 - math.asin(max(-1.0, min(1.0, z))) / math.pi) * _HEIGHT
    extent = math.hypot(source.angular_radius_deg, source.uncertainty_deg)
    at, radius = (round(column), round(row)), max(4, round(extent / 180 * _HEIGHT))
    cv2.circle(canvas, at, radius, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.circle(canvas, at, radius, (255, 220, 60), 1, cv2.LINE_AA)
    cv2.putText(canvas, source.name, (at[0] + radius + 3, at[1] + 4), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 220, 60), 1)


def _surfaces(found: EstimatedLight, center: Float[Tensor, "3"], frame: Float[Tensor, "3 3"]) -> Float[Tensor, "h h 3"]:
    canvas = np.full((_HEIGHT, _HEIGHT, 3), 30, np.uint8)
    points = found.evidence.surfaces.points
    if not len(points):
        return torch.from_numpy(canvas).float() / 255
    places = (points - center) @ frame.T
    reach = float(places[:, :2].abs().max())
    stops = (found.hidden.residual / math.log(2) / _STOPS).clamp(-1, 1)[:, None]
    colors = torch.where(stops > 0, _WHITE + stops * (_RED - _WHITE), _WHITE - stops * (_BLUE - _WHITE))
    pixels = ((places[:, :2] / reach * 0.48 + 0.5) * _HEIGHT).round().int()
    for i in places[:, 2].argsort().tolist():
        x, y = pixels[i].tolist()
        cv2.circle(canvas, (x, _HEIGHT - 1 - y), 3, (colors[i] * 255).tolist(), -1, cv2.LINE_AA)
    return torch.from_numpy(canvas).float() / 255
