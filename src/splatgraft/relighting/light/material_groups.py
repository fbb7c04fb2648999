"""Groups of Gaussians that are likely one material on one side of things. Knows nothing about light sources."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

_GROUPS = 20
_SAMPLE = 6000
_ROUNDS = 8


def group_materials(brightness: Float[Tensor, "m 3"], normals: Float[Tensor, "m 3"]) -> Int[Tensor, "m"]:
    """k-means on chromaticity of linear `brightness` and on normals; brightness itself would part lit and shaded.

    For the same reason the blue-orange axis counts little: there sun and sky differ (Finlayson 2006); green-magenta
    tells materials apart.
    """
    red, green, blue = brightness.clamp_min(1e-3).log().unbind(1)
    chroma = torch.stack([(red - blue) / 1.0, (green - 0.5 * (red + blue)) / 0.25], 1)
    features = torch.cat([chroma, normals / 0.6], 1)
    generator = torch.Generator().manual_seed(0)
    sample = features[torch.randperm(len(features), generator=generator)[:_SAMPLE]]
    count = min(_GROUPS, max(2, len(sample) // 60))
    middles = sample[:count]
    for _ in range(_ROUNDS):
        label = torch.cdist(sample, middles).argmin(1)
        sums = torch.zeros_like(middles).index_add_(0, label, sample)
        middles = sums / torch.bincount(label, minlength=count).clamp_min(1)[:, None]
    return torch.cdist(features, middles).argmin(1)
