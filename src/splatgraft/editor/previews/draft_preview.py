"""Draft relighting: relight a reduced level of detail and copy the layers to the nearest full-detail Gaussians."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Int
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.core.composite import Composite
from splatgraft.core.gaussians import Gaussians
from splatgraft.editor.previews.level_of_detail import largest_coverage_indices
from splatgraft.relighting import Relit

TARGET_BUDGET, OBJECT_BUDGET = 30_000, 8_000
"""Numbers of Gaussians; relighting this many after a change of the light takes about a second on one core."""


@dataclass(frozen=True)
class CoarseGaussians:
    """A subset of a scene's Gaussians, with the nearest member of the subset for each Gaussian of the scene."""

    gaussians: Gaussians
    """The m Gaussians that cover most."""
    nearest: Int[Tensor, "n"]
    """For each of the scene's n Gaussians the index of the nearest of `gaussians`."""

    @cached_property
    def none_erased(self) -> Bool[Tensor, "m"]:
        """All False; always the same tensor, so that memos compare it by identity."""
        return torch.zeros(self.gaussians.count, dtype=torch.bool)


def coarsen(gaussians: Gaussians, budget: int) -> CoarseGaussians:
    """Reduce a scene to at most `budget` Gaussians; the same object where it has no more."""
    if gaussians.count <= budget:
        return CoarseGaussians(gaussians, torch.arange(gaussians.count))
    subset = gaussians.select(largest_coverage_indices(gaussians, budget))
    nearest = KDTree(subset.means.double().numpy()).query(gaussians.means.double().numpy())[1]
    return CoarseGaussians(subset, torch.from_numpy(nearest).long())


def coarse_composite(composite: Composite, target: CoarseGaussians, objects: Sequence[CoarseGaussians]) -> Composite:
    """The composite of the coarse target, from which the erased Gaussians are removed, and the coarse objects."""
    placed = zip(composite.objects, objects, strict=True)
    return Composite(
        target=target.gaussians,
        objects=tuple(replace(one, gaussians=coarse.gaussians) for one, coarse in placed),
        erased=target.none_erased,
    )


def upsample_light(relit: Relit, composite: Composite, parts: Sequence[CoarseGaussians]) -> Relit:
    """Copy the layers of a relit coarse composite to all Gaussians of `composite`, from the nearest coarse Gaussian.

    Args:
        relit: Result on the coarse composite; no Gaussian of it may have been split.
        composite: The full composite.
        parts: The coarse target, then the coarse objects.
    """
    counts = [part.gaussians.count for part in parts]
    assert relit.gaussians.count == sum(counts)
    starts = torch.tensor([0, *counts[:-1]]).cumsum(0).tolist()
    row = torch.cat([part.nearest + start for part, start in zip(parts, starts, strict=True)])
    gaussians, is_object = composite.merged()
    return Relit(
        gaussians=gaussians,
        is_object=is_object,
        origin=torch.arange(gaussians.count),
        shade=relit.shade[row],
        shadow=relit.shadow[row],
        bounce=relit.bounce[row],
        # valid over the width of a coarse Gaussian only
        slope=relit.slope.new_zeros(len(row), *relit.slope.shape[1:]),
        gloss=relit.gloss[row],
        bands_replaced=relit.bands_replaced[row],
        objects=tuple(placed.in_target() for placed in composite.objects),
        light=relit.light,
        report=relit.report,
    )
