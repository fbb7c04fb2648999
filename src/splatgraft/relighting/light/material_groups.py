"""Groups of Gaussians that likely share one material and one side, by k-means on chromaticity and normals."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatgraft.core.k_means import k_means


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
    chroma = log_chromaticity(brightness.clamp_min(settings.darkest))
    features = torch.cat(
        [chroma / torch.tensor([settings.red_blue, settings.green_magenta]), normals / settings.normal], 1
    )
    generator = torch.Generator().manual_seed(0)
    sample = features[torch.randperm(len(features), generator=generator)[: settings.sample]]
    count = min(settings.groups, max(2, len(sample) // settings.members))
    means = k_means(sample, sample[:count], rounds=settings.rounds)
    return torch.cdist(features, means).argmin(1)


def log_chromaticity(colors: Float[Tensor, "n 3"]) -> Float[Tensor, "n 2"]:
    """log(red / blue) and log(green / sqrt(red blue)) of linear rgb above 0."""
    red, green, blue = colors.log().unbind(1)
    return torch.stack([red - blue, green - 0.5 * (red + blue)], 1)
