"""A light transfer on fewer Gaussians, carried over to all: what makes a large scene as quick to light as a small one.

Knows nothing about light itself, and nothing about files.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Int
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.core.composite import Composite
from splatgraft.core.gaussians import Gaussians
from splatgraft.editor.previews.level_of_detail import shown_indices
from splatgraft.relighting import Relit

TARGET_BUDGET, OBJECT_BUDGET = 30_000, 8_000
"""Gaussians with which a light that is aimed takes about a second of work on one core."""


@dataclass(frozen=True)
class Thinned:
    """Some Gaussians of a scene, and which of them stands for each of its Gaussians."""

    gaussians: Gaussians
    """Those that cover most."""
    nearest: Int[Tensor, "n"]
    """For every Gaussian of the scene the position of the nearest of `gaussians`."""

    @cached_property
    def none(self) -> Bool[Tensor, "m"]:
        """That none of `gaussians` is erased; always the same tensor, by which caches know that nothing changed."""
        return torch.zeros(self.gaussians.count, dtype=torch.bool)


def thinned(gaussians: Gaussians, budget: int) -> Thinned:
    """At most `budget` Gaussians; the very same ones where they are no more."""
    if gaussians.count <= budget:
        return Thinned(gaussians, torch.arange(gaussians.count))
    few = gaussians.select(shown_indices(gaussians, budget))
    nearest = KDTree(few.means.double().numpy()).query(gaussians.means.double().numpy())[1]
    return Thinned(few, torch.from_numpy(nearest).long())


def thinned_composite(composite: Composite, target: Thinned, objects: Sequence[Thinned]) -> Composite:
    """The composite of what was left of its kept target and of its objects."""
    placed = zip(composite.objects, objects, strict=True)
    return Composite(
        target=target.gaussians,
        objects=tuple(replace(one, gaussians=few.gaussians) for one, few in placed),
        erased=target.none,
    )


def carried_over(relit: Relit, composite: Composite, parts: Sequence[Thinned]) -> Relit:
    """The light of the thinned composite on all of `composite`; `parts` are its kept target, then its objects.

    `relit` must have split nothing.
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
        slope=torch.zeros_like(relit.slope[row]),  # holds for the width of the thinned only
        gloss=relit.gloss[row],
        objects=tuple(placed.in_target() for placed in composite.objects),
        light=relit.light,
        report=relit.report,
    )
