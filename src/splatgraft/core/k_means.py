"""k-means on feature vectors, from given initial means; the result is the same on every run."""

import torch
from jaxtyping import Float
from torch import Tensor


def k_means(features: Float[Tensor, "n f"], means: Float[Tensor, "k f"], *, rounds: int) -> Float[Tensor, "k f"]:
    """Move `means` to the centroids of their nearest features, `rounds` times (Lloyd 1982).

    A mean that is nearest to no feature stays.
    """
    for _ in range(rounds):
        label = torch.cdist(features, means).argmin(1)
        sums = torch.zeros_like(means).index_add_(0, label, features)
        sizes = torch.bincount(label, minlength=len(means))[:, None]
        means = torch.where(sizes > 0, sums / sizes.clamp_min(1), means)
    return means
