"""Where a scene's dominant light is visibly blocked by what was never captured, from the scene's own brightness.

Sunlight through a window lights a patch of a table; the depth maps lack the window's frame, but the table's colours
show the patch. Brightness is compared within groups of one material, then smoothed over neighbours.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import linear_from_srgb
from splatgraft.core.spherical_harmonics import rgb_from_dc
from splatgraft.relighting.light.material_groups import group_materials
from splatgraft.relighting.shading.nearest_neighbours import nearest_neighbours
from splatgraft.relighting.shading.normals import Normals


@dataclass(frozen=True)
class SunVisibilitySettings:
    """When brightness shows whether the light arrives, all set by hand."""

    neighbours: int = 24
    """Gaussians over which the median is taken."""
    contrast: float = 0.5
    """Least irradiance of the light over that of the rest; with less, brightness shows nothing."""
    faintest: float = 0.1
    """Opacity below which a Gaussian is left out."""
    fewest: int = 500
    """Gaussians; with fewer nothing is estimated."""
    darkest: float = 0.01
    """sRGB; darker channels count as this."""
    lit_quantile: float = 0.75
    """Of apparent albedo in a group of one material: a Gaussian of this brightness is taken to be fully lit."""
    ramp: tuple[float, float] = (0.2, 0.4)
    """Start and width of the ramp from 0 to 1 over the measured visibility: little light counts as none."""


def observed_sun_visibility(
    gaussians: Gaussians,
    normals: Normals,
    *,
    rest: Float[Tensor, "m"],
    light: Float[Tensor, "m"],
    settings: SunVisibilitySettings = SunVisibilitySettings(),
) -> Float[Tensor, "m"]:
    """Share of the dominant light that is visible in the colours of m Gaussians, in [0, 1]; 1 where unknown.

    Args:
        gaussians: Of the scene.
        normals: Of their surfaces.
        rest: Gray irradiance of all other light.
        light: Gray irradiance of the dominant light by geometry, in the same unit.
        settings: Thresholds.
    """
    share = torch.ones(gaussians.count)
    brightness = linear_from_srgb(rgb_from_dc(gaussians.sh[:, 0]).clamp(settings.darkest, 1))
    usable = (light > settings.contrast * rest) & normals.seen & (gaussians.opacities > settings.faintest)
    index = usable.nonzero()[:, 0]
    if len(index) < settings.fewest:
        return share
    groups = group_materials(brightness[index], normals.vectors[index])
    value = brightness[index].mean(1)
    full, without = (rest + light)[index], rest[index]
    albedo = value / full
    # a group without any lit Gaussian gets visibility 1 this way: no evidence
    lit_albedo = torch.zeros(int(groups.max()) + 1)
    for group in range(len(lit_albedo)):
        inside = groups == group
        if bool(inside.any()):
            lit_albedo[group] = albedo[inside].quantile(settings.lit_quantile)
    measured = ((value / lit_albedo[groups].clamp_min(1e-6) - without) / (full - without)).clamp(0, 1)
    neighbours = nearest_neighbours(gaussians.means[index], count=settings.neighbours)
    smooth = measured[neighbours.long()].median(1).values
    start, width = settings.ramp
    share[index] = ((smooth - start) / width).clamp(0, 1)
    return share
