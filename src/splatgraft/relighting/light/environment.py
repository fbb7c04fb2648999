"""The ambient light at a place as an equirectangular panorama: an environment map for programs that light meshes.

What cameras photographed is what the scene shows there, in full resolution; the rest is the estimate's radiance, which
has 320 directions. The estimate's sources are left out: their directions are as bright as what is around them.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.images import LUMINANCE
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.light.estimate import EstimatedLight
from splatgraft.relighting.light.panorama import (
    DIRECTIONS,
    NEAREST,
    cube_pixels,
    nearest_directions,
    render_panorama,
)

_SMOOTH_RAD = math.radians(8.0)
"""Width of the kernel that interpolates between the estimate's directions, which are 11 degrees apart; set by hand."""
_CHUNK = 65_536
"""Directions that are interpolated at a time."""


def equirectangular_directions(height: int) -> Float[Tensor, "h w 3"]:
    """Unit directions of an environment map's pixels, twice as wide as high, as Blender's world has them.

    The top row looks along +z, the middle column along +x, and columns to the right turn towards -y, as seen from
    inside.
    """
    polar = math.pi * (torch.arange(height) + 0.5)[:, None] / height
    azimuth = 2 * math.pi * (0.5 - (torch.arange(2 * height) + 0.5) / (2 * height))[None]
    return torch.stack([polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos() + 0 * azimuth], -1)


def environment_radiance(
    found: EstimatedLight, captured: CapturedScene, place: BoundingSphere, directions: Float[Tensor, "h w 3"]
) -> Float[Tensor, "h w 3"]:
    """Linear rgb radiance at a place without the sources of the estimate's light, at least 0.

    Args:
        found: The estimate at `place`.
        captured: The scene without the object.
        place: What is nearer than half of its radius is left out.
        directions: Unit, world frame.
    """
    height, width, _ = directions.shape
    flat, face = directions.reshape(-1, 3), max(height, 1)
    cube = render_panorama(captured.usable.gaussians, place.center, size=face, nearest=NEAREST * place.radius)
    shown = cube.radiance.reshape(-1, 3)[cube_pixels(flat, face)]
    around, rest = found.evidence.around, found.rest()
    # a source that was photographed is cut down to what is around it
    is_cut = (rest < around.radiance).any(1, keepdim=True)
    limit = torch.where(is_cut, rest, math.inf)[nearest_directions(flat)]
    smooth = _interpolated(torch.cat([around.seen[:, None], _hidden(found, rest)], 1), flat)
    radiance = torch.minimum(smooth[:, :1] * shown, limit) + smooth[:, 1:]
    return radiance.reshape(height, width, 3)


def _hidden(found: EstimatedLight, rest: Float[Tensor, "k 3"]) -> Float[Tensor, "k 3"]:
    """What of `rest` no camera recorded.

    A sun that shadows show dims the ambient light, so that the surface is as bright as before. Here that dims only what
    no camera recorded, by as much as gives the surface the same ambient irradiance, but not below 0.
    """
    seen = found.evidence.around.radiance
    hidden = (rest - seen).clamp_min(0)
    up = found.evidence.up if found.sun is None else found.sun.normal.to(DIRECTIONS)
    dimming = float(found.light.ambient.norm() / found.mean.ambient.norm().clamp_min(1e-9))
    cosine = (DIRECTIONS @ up).clamp_min(0)
    by_all, by_seen, by_hidden = (cosine @ (part @ LUMINANCE) for part in (rest, torch.minimum(rest, seen), hidden))
    return hidden * ((dimming * by_all - by_seen) / by_hidden.clamp_min(1e-9)).clamp_min(0)


def _interpolated(values: Float[Tensor, "k c"], directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n c"]:
    """`values` of all `DIRECTIONS`, smoothly interpolated."""
    parts = []
    for part in directions.split(_CHUNK):
        weights = ((part @ DIRECTIONS.T - 1) / _SMOOTH_RAD**2).exp()
        parts.append(weights @ values / weights.sum(1, keepdim=True))
    return torch.cat(parts)
