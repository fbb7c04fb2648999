"""Broad reflections on an object, exchanged for those of the new light.

The part of an object's higher bands that correlates with the old light in mirrored directions is taken for a broad
reflection and replaced by the same share of the new light, blurred to degree 2, a rough gloss (reflection as
convolution, Ramamoorthi and Hanrahan 2001).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.directions import even_directions
from splatgraft.core.gaussians import Gaussians
from splatgraft.relighting.light.light import Light
from splatgraft.relighting.shading.normals import Normals

_CHUNK = 4096
"""Gaussians at a time; bounds memory."""


@dataclass(frozen=True)
class ReflectionSettings:
    """How reflections are found and limited, all set by hand."""

    views: int = 64
    """View directions over the sphere."""
    strongest: float = 0.25
    """Most share of the light that is reflected; more is a mirror, which low bands cannot hold."""
    lowest_cosine: float = 0.25
    """Between normal and view; flatter views are left out."""
    radiance_ridge: float = 1e-4
    """Added to the variance of the old light in the regression: little variation gives no share."""


def gloss_layer(
    gaussians: Gaussians,
    normals: Normals,
    source_light: Light,
    target_light: Light,
    *,
    ratio: Float[Tensor, "n 3"],
    settings: ReflectionSettings = ReflectionSettings(),
) -> Float[Tensor, "n k 3"]:
    """Coefficients that exchange an object's reflections, to be added after shading.

    Args:
        gaussians: The object, target's frame.
        normals: Of its Gaussians.
        source_light: At the old place, target's frame.
        target_light: At the new place.
        ratio: Factor on linear rgb that shading applies.
        settings: Limits.

    Returns:
        Coefficients of all bands; zero where higher bands do not correlate with the old light.
    """
    out = torch.zeros_like(gaussians.sh)
    if gaussians.sh_degree == 0:
        return out
    views = even_directions(settings.views)  # from a camera to the Gaussian, as harmonics are evaluated
    basis = spherical_harmonics.basis(views, gaussians.sh_degree)
    old, new = _blurred(source_light), _blurred(target_light)
    for start in range(0, gaussians.count, _CHUNK):
        rows = slice(start, start + _CHUNK)
        facing = normals.vectors[rows]
        cosine = -(facing @ views.T)
        mirrored = views[None] + 2 * cosine[..., None] * facing[:, None]
        lobes = spherical_harmonics.basis(mirrored, 2)
        weight = (cosine > settings.lowest_cosine).float()
        weight = weight / weight.sum(1, keepdim=True).clamp_min(1)

        def centred(values: Tensor, weight: Tensor = weight) -> Tensor:
            return values - (weight[..., None] * values).sum(1, keepdim=True)

        reflected_old, reflected_new = centred(lobes @ old), centred(lobes @ new)
        bands = centred(torch.einsum("vk,nkc->nvc", basis[:, 1:], gaussians.sh[rows, 1:]))
        x, y = reflected_old.mean(-1), bands.mean(-1)
        xx, xy, yy = ((weight * p).sum(1) for p in (x * x, x * y, y * y))
        share = (xy / (xx + settings.radiance_ridge)).clamp(0, settings.strongest)
        # the squared correlation is the share of the bands that the old light explains
        explained = (xy.clamp_min(0) ** 2 / (xx * yy + 1e-8)).clamp(0, 1) * normals.confidence[rows]
        scaled = ratio[rows, None].clamp_max(1)
        visible = (cosine > settings.lowest_cosine)[..., None]
        change = (share * explained)[:, None, None] * (reflected_new - scaled * reflected_old) * visible
        out[rows, 1:] = torch.einsum("vk,nvc->nkc", basis[:, 1:], change) * (4 * torch.pi / settings.views)
    return out


def _blurred(light: Light) -> Float[Tensor, "9 3"]:
    """A light as radiance of degree 2: sources as lobes, windowed against ringing."""
    window = torch.tensor([1.0] + [2 / 3] * 3 + [1 / 4] * 5)
    total = light.ambient.clone()
    for source in light.sources:
        lobe = spherical_harmonics.basis(torch.tensor([source.direction]), 2)[0]
        total += source.confidence * lobe[:, None] * torch.tensor(source.irradiance)
    return window[:, None] * total
