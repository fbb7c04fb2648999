"""Selects the Gaussians of an object: by mask value, 3D box and connected component."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.core.gaussians import Gaussians
from splatgraft.segmentation.box import Box

Keep = Literal["substantial", "largest", "all"]


@dataclass(frozen=True)
class SelectOptions:
    """What makes a Gaussian part of the object."""

    threshold: float = 0.75
    """Least feature (paper, Sec. 4: 0.75 after the sigmoid)."""
    box: Box | None = None
    """Where centres must lie, world units."""
    keep: Keep = "substantial"
    """Which connected components stay: those of at least `substantial`, the largest one, or all."""
    substantial: float = 0.05
    """Summed opacity of a component over the largest one's; set by hand."""
    neighbours: int = 16
    """Nearest Gaussians that are tested for contact with each Gaussian."""


def select_object(
    gaussians: Gaussians, feature: Float[Tensor, "n"], options: SelectOptions = SelectOptions()
) -> Bool[Tensor, "n"]:
    """Select the Gaussians of the object by threshold, box and connected piece.

    Args:
        gaussians: n Gaussians of the scene.
        feature: Share of each in the object, in [0, 1], as `lift_masks` gives it.
        options: Threshold, box, and which connected pieces stay.

    Returns:
        True for the object's Gaussians.

    Raises:
        ValueError: No Gaussian reaches the threshold, or none of these is inside the box.
    """
    chosen = feature >= options.threshold
    if not chosen.any():
        raise ValueError(
            f"object: expected Gaussians with a feature of at least {options.threshold}, found at most "
            f"{float(feature.max()) if len(feature) else 0:.2f}; do the masks show what the cameras see?"
        )
    if options.box is not None:
        chosen = chosen & options.box.contains(gaussians.means)
        if not chosen.any():
            raise ValueError("object: expected some of its Gaussians inside the box, found all outside")
    if options.keep == "all":
        return chosen
    opacity = component_opacity(gaussians.select(chosen), options.neighbours)
    least = opacity.max() * (options.substantial if options.keep == "substantial" else 1)
    kept = torch.zeros_like(chosen)
    kept[torch.nonzero(chosen)[:, 0][opacity >= least]] = True
    return kept


def component_opacity(gaussians: Gaussians, neighbours: int = 16) -> Float[Tensor, "n"]:
    """For each Gaussian the sum of opacities of its connected component; two touch if their 2-sigma spheres do.

    Only the `neighbours` nearest of each are tested for contact.
    """
    n = gaussians.count
    if n <= 1:
        return gaussians.opacities.detach()
    means = gaussians.means.detach().double().cpu().numpy()
    # the median scale: a needle is long along one axis only
    radii = 2 * gaussians.scales.detach().double().cpu().numpy().clip(1e-12)
    radii = np.median(radii, axis=1)
    distance, neighbour = KDTree(means).query(means, k=min(neighbours + 1, n))
    neighbour = np.asarray(neighbour)
    near = distance <= radii[:, None] + radii[neighbour]
    rows = np.broadcast_to(np.arange(n)[:, None], near.shape)[near]
    graph = coo_array((np.ones(len(rows), bool), (rows, neighbour[near])), shape=(n, n))
    _, label = connected_components(graph, directed=False)
    opacity = np.bincount(label, weights=gaussians.opacities.detach().double().cpu().numpy())
    return torch.from_numpy(opacity[label]).to(gaussians.means)
