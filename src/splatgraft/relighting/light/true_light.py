"""The light of a rendered panorama and of the suns that were left out of it. Knows no scene and no files."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.relighting.light.light import Light, LightSource
from splatgraft.relighting.light.panorama import Panorama, cube_directions
from splatgraft.relighting.light.panorama_sources import light_from_panorama

_FACE = 64


def light_from_probe(panorama: Float[Tensor, "h w 3"], suns: list[dict]) -> Light:
    """The light of an equirectangular panorama (row 0 up, the middle column +x, then to the right) and of suns."""
    directions, solid_angles = cube_directions(_FACE)
    cube = Panorama(
        radiance=_looked_up(panorama, directions),
        alpha=torch.ones(6, _FACE, _FACE),
        directions=directions,
        solid_angles=solid_angles,
    )
    seen = light_from_panorama(cube, torch.tensor([0.0, 0.0, 1.0]))
    sources = [
        LightSource(
            direction=_triple(sun["direction"]),
            irradiance=_triple(sun["irradiance"]),
            angular_radius_deg=math.degrees(sun["angular_radius"]),
            name="sun",
        )
        for sun in suns
    ]
    patches = [replace(source, uncertainty_deg=0.0) for source in seen.sources]
    ordered = sorted([*sources, *patches], key=lambda source: -source.luminance)
    return Light(sources=tuple(ordered), ambient=seen.ambient, coverage=1.0, unseen_up=0.0)


def _looked_up(panorama: Float[Tensor, "h w 3"], directions: Float[Tensor, "6 s s 3"]) -> Float[Tensor, "6 s s 3"]:
    x, y, z = directions.unbind(-1)
    across, down = -torch.atan2(y, x) / math.pi, -torch.asin(z.clamp(-1, 1)) / (math.pi / 2)
    # one column repeated on both sides, so that the seam at -x is interpolated too
    wide = torch.cat([panorama[:, -1:], panorama, panorama[:, :1]], 1).permute(2, 0, 1)[None]
    across = across * panorama.shape[1] / (panorama.shape[1] + 2)
    grid = torch.stack([across, down], -1).reshape(1, 6 * directions.shape[1], directions.shape[2], 2)
    found = torch.nn.functional.grid_sample(wide, grid, padding_mode="border", align_corners=False)
    return found[0].permute(1, 2, 0).reshape(directions.shape).contiguous()


def _triple(values: list[float]) -> tuple[float, float, float]:
    x, y, z = values
    return (x, y, z)
