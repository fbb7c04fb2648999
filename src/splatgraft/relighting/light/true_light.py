"""The true light at a place of a synthetic scene: a rendered panorama and the suns that it leaves out."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.relighting.light.light import Light, LightSource
from splatgraft.relighting.light.panorama import Panorama, cube_directions
from splatgraft.relighting.light.panorama_sources import light_from_panorama

_FACE = 64
"""Pixels; width of a face of the cube map."""


def light_from_probe(panorama: Float[Tensor, "h w 3"], suns: list[dict]) -> Light:
    """A light from a rendered panorama and a list of suns.

    Args:
        panorama: Equirectangular linear radiance; row 0 is up (+z), the middle column +x, to the right -y.
        suns: Entries of suns.json: direction (unit, towards the sun), irradiance (linear rgb) and angular_radius
            (radians).
    """
    directions, solid_angles = cube_directions(_FACE)
    cube = Panorama(
        radiance=_sampled(panorama, directions),
        alpha=torch.ones(6, _FACE, _FACE),
        directions=directions,
        solid_angles=solid_angles,
    )
    captured = light_from_panorama(cube, torch.tensor([0.0, 0.0, 1.0]))
    sources = [
        LightSource(
            direction=_triple(sun["direction"]),
            irradiance=_triple(sun["irradiance"]),
            angular_radius_deg=math.degrees(sun["angular_radius"]),
            name="sun",
        )
        for sun in suns
    ]
    patches = [replace(source, uncertainty_deg=0.0) for source in captured.sources]
    ordered = sorted([*sources, *patches], key=lambda source: -source.luminance)
    return Light(sources=tuple(ordered), ambient=captured.ambient, coverage=1.0, unseen_up=0.0)


def _sampled(panorama: Float[Tensor, "h w 3"], directions: Float[Tensor, "6 s s 3"]) -> Float[Tensor, "6 s s 3"]:
    x, y, z = directions.unbind(-1)
    across, down = -torch.atan2(y, x) / math.pi, -torch.asin(z.clamp(-1, 1)) / (math.pi / 2)
    # one column repeated on both sides, so that the seam at -x is interpolated too
    wide = torch.cat([panorama[:, -1:], panorama, panorama[:, :1]], 1).permute(2, 0, 1)[None]
    across = across * panorama.shape[1] / (panorama.shape[1] + 2)
    grid = torch.stack([across, down], -1).reshape(1, 6 * directions.shape[1], directions.shape[2], 2)
    values = torch.nn.functional.grid_sample(wide, grid, padding_mode="border", align_corners=False)
    return values[0].permute(1, 2, 0).reshape(directions.shape).contiguous()


def _triple(values: list[float]) -> tuple[float, float, float]:
    x, y, z = values
    return (x, y, z)
