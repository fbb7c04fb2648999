"""Where a scene looks as if its dominant light reached it: what is already in the shade of things never captured.

Sun that falls through a window lights a patch of the table; no depth map knows the window's frame, but the table does.
Brightness is compared within groups of one material, then smoothed. Knows nothing about objects or files.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import linear_from_srgb
from splatgraft.core.spherical_harmonics import rgb_from_dc
from splatgraft.relighting.light.material_groups import group_materials
from splatgraft.relighting.shading.nearest_neighbours import nearest_neighbours
from splatgraft.relighting.shading.normals import Normals

_NEIGHBOURS = 24
_CONTRAST = 0.5  # the light must bring at least this share of the rest, or brightness cannot tell


def observed_sun_visibility(
    gaussians: Gaussians, normals: Normals, *, rest: Float[Tensor, "m"], light: Float[Tensor, "m"]
) -> Float[Tensor, "m"]:
    """How much of `light`, the dominant light's irradiance by geometry, `gaussians` show, in [0, 1]; 1 where untold.

    `rest` is the irradiance of all other light, in the same units.
    """
    share = torch.ones(gaussians.count)
    brightness = linear_from_srgb(rgb_from_dc(gaussians.sh[:, 0]).clamp(0.01, 1))
    asked = (light > _CONTRAST * rest) & normals.seen & (gaussians.opacities > 0.1)
    index = asked.nonzero()[:, 0]
    if len(index) < 500:
        return share
    groups = group_materials(brightness[index], normals.vectors[index])
    value = brightness[index].mean(1)
    full, without = (rest + light)[index], rest[index]
    albedo = value / full
    # a group's brightest quarter is taken to be lit: if none of it is, nothing is claimed
    lit_albedo = torch.zeros(int(groups.max()) + 1)
    for group in range(len(lit_albedo)):
        inside = groups == group
        if bool(inside.any()):
            lit_albedo[group] = albedo[inside].quantile(0.75)
    shown = ((value / lit_albedo[groups].clamp_min(1e-6) - without) / (full - without)).clamp(0, 1)
    neighbours = nearest_neighbours(gaussians.means[index], count=_NEIGHBOURS)
    smooth = shown[neighbours.long()].median(1).values
    certain = ((smooth - 0.2) / 0.4).clamp(0, 1)
    share[index] = certain
    return share
