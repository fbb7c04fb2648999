"""Points just above a reconstructed surface, from which light is looked for without the surface shadowing itself.

A plain surface is a layer of Gaussians whose centres lie above and below it. In light from low above the horizon the
upper ones would shadow the lower ones (shadow acne), so visibility is tested at the top of the layer.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.gaussians import Gaussians
from splatgraft.relighting.shading.nearest_neighbours import nearest_neighbours


@dataclass(frozen=True)
class SurfaceLayerSettings:
    """How the layer is measured."""

    neighbours: int = 16
    """Gaussians that form the layer around one, as for its normal."""
    level: int = 48
    """Gaussians over whose heights the middle is taken."""
    deviations: float = 3.0
    """Standard deviations of the layer's height between its middle and its top."""


def above_layer(
    gaussians: Gaussians, normals: Float[Tensor, "n 3"], *, settings: SurfaceLayerSettings = SurfaceLayerSettings()
) -> Float[Tensor, "n 3"]:
    """For each Gaussian the point on its normal's line at the top of the layer of its neighbours.

    The height's variance is that of the neighbours' centres and their own mean variance along the normal.

    Args:
        gaussians: n Gaussians.
        normals: Unit, of their surfaces.
        settings: How the layer is measured.
    """
    middle, deviation = _layer(gaussians, normals, settings.neighbours)
    return gaussians.means + (middle + settings.deviations * deviation)[:, None] * normals


def layer_middle(
    gaussians: Gaussians, normals: Float[Tensor, "n 3"], *, settings: SurfaceLayerSettings = SurfaceLayerSettings()
) -> Float[Tensor, "n 3"]:
    """For each Gaussian the point on its normal's line in the middle of the layer of its neighbours.

    Args:
        gaussians: n Gaussians.
        normals: Unit, of their surfaces.
        settings: How the layer is measured.
    """
    return gaussians.means + _layer(gaussians, normals, settings.level)[0][:, None] * normals


def _layer(
    gaussians: Gaussians, normals: Float[Tensor, "n 3"], count: int
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Mean and standard deviation of the layer's height over each Gaussian's centre."""
    if not gaussians.count:
        return torch.zeros(0), torch.zeros(0)
    near = nearest_neighbours(gaussians.means, count=count).long()
    heights = ((gaussians.means[near] - gaussians.means[:, None]) * normals[:, None]).sum(-1)
    own = ((torch.einsum("nij,ni->nj", gaussians.rotations, normals) * gaussians.scales) ** 2).sum(1)
    return heights.mean(1), (heights.var(1, correction=0) + own[near].mean(1)).sqrt()
