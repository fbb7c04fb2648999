"""Level of detail: the subset of a scene's Gaussians that covers most, for display and draft relighting."""

import torch
from jaxtyping import Int
from torch import Tensor

from splatgraft.core.gaussians import Gaussians


def largest_coverage_indices(gaussians: Gaussians, budget: int) -> Int[Tensor, "m"]:
    """Indices of the at most `budget` Gaussians with the largest opacity times disc area, in ascending order."""
    if gaussians.count <= budget:
        return torch.arange(gaussians.count)
    two_largest = gaussians.log_scales.sort(dim=1).values[:, 1:].sum(1)
    log_coverage = torch.nn.functional.logsigmoid(gaussians.opacity_logits) + two_largest
    return log_coverage.topk(budget).indices.sort().values
