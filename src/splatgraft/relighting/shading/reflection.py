"""Reflections on an object, turned from the old light to the new one. Knows nothing about shadows or scenes.

What an object's higher bands share with the old light in mirrored directions is taken for a broad reflection; it is
replaced by the same share of the new light (after Ramamoorthi and Hanrahan 2001: a degree-2 lobe is a rough gloss).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.directions import even_directions
from splatgraft.core.gaussians import Gaussians
from splatgraft.relighting.light.light import Light
from splatgraft.relighting.shading.normals import Normals

_VIEWS = 64
_STRONGEST = 0.25  # share of the light that a reflection may carry: beyond is a mirror, which no low band holds
_LOWEST = 0.25  # cosine of the flattest view that is asked
_CHUNK = 4096


def gloss_layer(
    gaussians: Gaussians, normals: Normals, before: Light, after: Light, *, ratio: Float[Tensor, "n 3"]
) -> Float[Tensor, "n k 3"]:
    """What to add to harmonics that `ratio` has scaled; zero where higher bands do not follow the old light."""
    out = torch.zeros_like(gaussians.sh)
    if gaussians.sh_degree == 0:
        return out
    views = even_directions(_VIEWS)  # from a camera towards the Gaussian, as the harmonics are seen
    basis = spherical_harmonics.basis(views, gaussians.sh_degree)
    old, new = _blurred(before), _blurred(after)
    for start in range(0, gaussians.count, _CHUNK):
        rows = slice(start, start + _CHUNK)
        facing = normals.vectors[rows]
        cosine = -(facing @ views.T)
        mirrored = views[None] + 2 * cosine[..., None] * facing[:, None]
        lobes = spherical_harmonics.basis(mirrored, 2)
        weight = (cosine > _LOWEST).float()
        weight = weight / weight.sum(1, keepdim=True).clamp_min(1)

        def centred(values: Tensor, weight: Tensor = weight) -> Tensor:
            return values - (weight[..., None] * values).sum(1, keepdim=True)

        was, now = centred(lobes @ old), centred(lobes @ new)
        bands = centred(torch.einsum("vk,nkc->nvc", basis[:, 1:], gaussians.sh[rows, 1:]))
        x, y = was.mean(-1), bands.mean(-1)
        xx, xy, yy = ((weight * p).sum(1) for p in (x * x, x * y, y * y))
        share = (xy / (xx + 1e-4)).clamp(0, _STRONGEST)
        # the squared correlation says how much of the bands the old light explains: as much is believed
        believed = (xy.clamp_min(0) ** 2 / (xx * yy + 1e-8)).clamp(0, 1) * normals.confidence[rows]
        scaled = ratio[rows, None].clamp_max(1)
        change = (share * believed)[:, None, None] * (now - scaled * was) * (cosine > _LOWEST)[..., None]
        out[rows, 1:] = torch.einsum("vk,nvc->nkc", basis[:, 1:], change) * (4 * torch.pi / _VIEWS)
    return out


def _blurred(light: Light) -> Float[Tensor, "9 3"]:
    """All of a light as degree-2 radiance: sources as lobes, softened so that they do not ring."""
    soften = torch.tensor([1.0] + [2 / 3] * 3 + [1 / 4] * 5)
    total = light.ambient.clone()
    for source in light.sources:
        lobe = spherical_harmonics.basis(torch.tensor([source.direction]), 2)[0]
        total += source.confidence * lobe[:, None] * torch.tensor(source.irradiance)
    return soften[:, None] * total
