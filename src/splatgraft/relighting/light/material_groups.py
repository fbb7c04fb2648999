"""Groups of Gaussians that likely share one material and one side, by k-means on chromaticity and normals."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class MaterialGroupSettings:
    """k-means and its features, all set by hand."""

    groups: int = 20
    """Most groups."""
    members: int = 60
    """Gaussians of the sample per group, at least; fewer make fewer groups, but two."""
    sample: int = 6000
    """Gaussians on which the means are fitted, chosen at random with a fixed seed."""
    rounds: int = 8
    """Iterations of k-means."""
    red_blue: float = 1.0
    """Unit of log(red / blue): large, as sun and sky differ along this axis (Finlayson 2006)."""
    green_magenta: float = 0.25
    """Unit of log(green / sqrt(red blue))."""
    normal: float = 0.6
    """Unit of normals."""
    darkest: float = 1e-3
    """Linear light; darker channels count as this."""


def group_materials(
    brightness: Float[Tensor, "m 3"],
    normals: Float[Tensor, "m 3"],
    *,
    settings: MaterialGroupSettings = MaterialGroupSettings(),
) -> Int[Tensor, "m"]:
    """Group index of each Gaussian, by chromaticity and normal but not by brightness, which parts lit from shaded.

    Args:
        brightness: Linear rgb of the m Gaussians.
        normals: Unit.
        settings: Features and number of groups.
    """
    red, green, blue = brightness.clamp_min(settings.darkest).log().unbind(1)
    chroma = torch.stack([(red - blue) / settings.red_blue, (green - 0.5 * (red + blue)) / settings.green_magenta], 1)
    features = torch.cat([chroma, normals / settings.normal], 1)
    generator = torch.Generator().manual_seed(0)
    sample = features[torch.randperm(len(features), generator=generator)[: settings.sample]]
    count = min(settings.groups, max(2, len(sample) // settings.members))
    means = sample[:count]
    for _ in range(settings.rounds):
        label = torch.cdist(sample, means).argmin(1)
        sums = torch.zeros_like(means).index_add_(0, label, sample)
        means = sums / torch.bincount(label, minlength=count).clamp_min(1)[:, None]
    return torch.cdist(features, means).argmin(1)
