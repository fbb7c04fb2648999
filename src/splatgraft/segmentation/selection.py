"""Selection of an object's Gaussians by mask value, 3D box, connected component and the user's corrections."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int8
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.core.gaussians import Gaussians

Keep = Literal["substantial", "largest", "all"]

SURFACE_OPACITY = 0.3
"""Opacity above which a Gaussian counts as a surface; set by hand."""
_SUBSTANTIAL = 0.05  # smallest summed opacity of a substantial component, over the largest one's; set by hand
_NEIGHBOURS = 16  # nearest Gaussians that are tested for contact with each Gaussian


@dataclass(frozen=True)
class Box:
    """Axis-aligned box."""

    lower: Float[Tensor, "3"]
    """Smallest x, y, z, world units."""
    upper: Float[Tensor, "3"]
    """Largest x, y, z, world units."""

    def __post_init__(self) -> None:
        """Raise a ValueError if the corners are not in order."""
        if not bool((self.lower < self.upper).all()):
            raise ValueError(f"box: expected lower < upper, found {self.lower.tolist()} and {self.upper.tolist()}")

    def contains(self, points: Float[Tensor, "*n 3"]) -> Bool[Tensor, "*n"]:
        """Test which points lie inside."""
        return ((points >= self.lower.to(points)) & (points <= self.upper.to(points))).all(-1)

    def grown(self, factor: float) -> "Box":
        """Scale the edges by `factor` around the centre."""
        centre, half = (self.lower + self.upper) / 2, (self.upper - self.lower) / 2 * factor
        return Box(centre - half, centre + half)

    @property
    def corners(self) -> Float[Tensor, "8 3"]:
        """The eight corners."""
        choice = torch.cartesian_prod(*[torch.arange(2)] * 3).bool()
        return torch.where(choice, self.upper, self.lower)


@dataclass(frozen=True)
class SelectOptions:
    """Criteria for the object's Gaussians."""

    threshold: float = 0.75
    """Smallest feature (paper, Sec. 4: 0.75 after the sigmoid)."""
    box: Box | None = None
    """Box that must contain the centres, world units; None: no box."""
    keep: Keep = "substantial"
    """Connected components that stay: those with at least a twentieth of the largest one's summed opacity, the largest
    one, or all."""


def select_object(
    gaussians: Gaussians, feature: Float[Tensor, "n"], options: SelectOptions = SelectOptions()
) -> Bool[Tensor, "n"]:
    """Select the Gaussians of the object by threshold, box and connected component.

    Args:
        gaussians: n Gaussians of the scene.
        feature: Share of each Gaussian in the object, in [0, 1] (see `lift_masks`).
        options: Threshold, box and connected components that stay.

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
    opacity = _component_opacity(gaussians.select(chosen))
    least = opacity.max() * (_SUBSTANTIAL if options.keep == "substantial" else 1)
    kept = torch.zeros_like(chosen)
    kept[torch.nonzero(chosen)[:, 0][opacity >= least]] = True
    return kept


def part_shares(object_: Gaussians) -> list[float]:
    """Compute the shares of an object's separate parts in its summed opacity, the largest part first.

    Parts are connected components with at least a twentieth of the largest one's summed opacity.
    """
    label, opacity = _components(object_)
    sums = np.bincount(label, weights=opacity)
    sums = np.sort(sums[sums >= _SUBSTANTIAL * sums.max()])[::-1]
    return [float(one) for one in sums / sums.sum()]


def _component_opacity(gaussians: Gaussians) -> Float[Tensor, "n"]:
    """Compute, for each Gaussian, the summed opacity of its connected component."""
    label, opacity = _components(gaussians)
    return torch.from_numpy(np.bincount(label, weights=opacity)[label]).to(gaussians.means)


def _components(gaussians: Gaussians) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of each Gaussian's connected component, and its opacity; 2-sigma spheres must touch."""
    n, opacity = gaussians.count, gaussians.opacities.detach().double().cpu().numpy()
    if n == 1:
        return np.zeros(1, int), opacity
    means = gaussians.means.detach().double().cpu().numpy()
    # the median scale: a needle is long along one axis only
    radii = np.median(2 * gaussians.scales.detach().double().cpu().numpy().clip(1e-12), axis=1)
    distance, neighbour = KDTree(means).query(means, k=min(_NEIGHBOURS + 1, n))
    neighbour = np.asarray(neighbour)
    near = distance <= radii[:, None] + radii[neighbour]
    rows = np.broadcast_to(np.arange(n)[:, None], near.shape)[near]
    graph = coo_array((np.ones(len(rows), bool), (rows, neighbour[near])), shape=(n, n))
    return connected_components(graph, directed=False)[1], opacity


def apply_corrections(lifted: Bool[Tensor, "n"], corrections: Int8[Tensor, "n"] | None) -> Bool[Tensor, "n"]:
    """Apply the user's corrections to the selection from the masks: 1 adds a Gaussian, -1 removes it, 0 keeps it."""
    if corrections is None:
        return lifted
    if len(corrections) != len(lifted):
        raise ValueError(
            f"corrections: expected one for each of {len(lifted)} Gaussians, found {len(corrections)}; "
            "the scene has changed since"
        )
    corrections = corrections.to(lifted.device)
    return (lifted | (corrections > 0)) & ~(corrections < 0)


def add_correction(
    corrections: Int8[Tensor, "n"] | None, touched: Bool[Tensor, "n"], *, add: bool
) -> Int8[Tensor, "n"]:
    """Add a stroke over the `touched` Gaussians to the corrections; the last stroke over a Gaussian counts."""
    before = torch.zeros(len(touched), dtype=torch.int8) if corrections is None else corrections
    return torch.where(touched, torch.tensor(1 if add else -1, dtype=torch.int8), before)
