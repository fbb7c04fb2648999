"""Fewer Gaussians for display, so that a browser stays quick; files are never thinned. Knows nothing about browsers."""

import torch
from jaxtyping import Int
from torch import Tensor

from splatgraft.core.gaussians import Gaussians


def shown_indices(gaussians: Gaussians, budget: int) -> Int[Tensor, "m"]:
    """At most `budget` Gaussians, in their order: those that cover most, by opacity times the area of their disc."""
    if gaussians.count <= budget:
        return torch.arange(gaussians.count)
    two_largest = gaussians.log_scales.sort(dim=1).values[:, 1:].sum(1)
    cover = torch.nn.functional.logsigmoid(gaussians.opacity_logits) + two_largest
    return cover.topk(budget).indices.sort().values
