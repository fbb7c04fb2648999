"""The edited scene with transferred light for pictures: the result of the step `relight`, and faster drafts of it.

A draft relights a subset of the Gaussians; the others get the layers of the nearest one.
"""

import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import torch
from jaxtyping import Int
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.compositing.composite import Composite
from splatgraft.core.gaussians import Gaussians
from splatgraft.editor.scene_cache import SceneCache
from splatgraft.editor.state import EditState
from splatgraft.relighting import Relit
from splatgraft.relighting.transfer import TransferValues
from splatgraft.runtime.memo import Memo

T = TypeVar("T")
TARGET_BUDGET, OBJECT_BUDGET = 30_000, 8_000
"""Numbers of Gaussians; relighting this many after a change of the light takes about a second on one core."""


@dataclass(frozen=True)
class CoarseGaussians:
    """A subset of a scene's Gaussians, with the nearest member of the subset for each Gaussian of the scene."""

    gaussians: Gaussians
    """The m Gaussians with the largest coverage."""
    nearest: Int[Tensor, "n"]
    """Index into `gaussians` of the nearest one, for each of the scene's n Gaussians."""


def coarsen(gaussians: Gaussians, budget: int) -> CoarseGaussians:
    """Reduce a scene to at most `budget` Gaussians; keep the same object if it has no more."""
    if gaussians.count <= budget:
        return CoarseGaussians(gaussians, torch.arange(gaussians.count))
    subset = gaussians.select(largest_coverage_indices(gaussians, budget))
    nearest = KDTree(subset.means.double().numpy()).query(gaussians.means.double().numpy())[1]
    return CoarseGaussians(subset, torch.from_numpy(nearest).long())


@dataclass(frozen=True)
class Draft:
    """Light of a coarse composite, and its use for all Gaussians."""

    relit: Relit
    """Layers of the m coarse Gaussians."""
    nearest: Int[Tensor, "n"]
    """Index of the coarse Gaussian whose layers each of the composite's n Gaussians gets; none is split."""

    def of_all(self, composite: Composite) -> Relit:
        """Copy the layers to all Gaussians of `composite`."""
        gaussians, is_object = composite.merged()
        names = ("shade", "shadow", "bounce", "slope", "gloss", "bands_replaced")
        return replace(
            self.relit,
            gaussians=gaussians,
            is_object=is_object,
            origin=torch.arange(gaussians.count),
            objects=tuple(placed.in_target() for placed in composite.objects),
            **{name: getattr(self.relit, name)[self.nearest] for name in names},
        )


def coarse_draft(relit: Relit, parts: Sequence[CoarseGaussians]) -> Draft:
    """Return the draft of a scene from the light of its coarse target, without erased Gaussians, and coarse objects."""
    counts = [part.gaussians.count for part in parts]
    assert relit.gaussians.count == sum(counts)
    starts = torch.tensor([0, *counts[:-1]]).cumsum(0).tolist()
    nearest = torch.cat([part.nearest + start for part, start in zip(parts, starts, strict=True)])
    # slopes are valid over the width of a coarse Gaussian only
    return Draft(replace(relit, slope=torch.zeros_like(relit.slope)), nearest)


def largest_coverage_indices(gaussians: Gaussians, budget: int) -> Int[Tensor, "m"]:
    """Return the ascending indices of at most `budget` Gaussians with the largest opacity times disc area."""
    if gaussians.count <= budget:
        return torch.arange(gaussians.count)
    two_largest = gaussians.log_scales.sort(dim=1).values[:, 1:].sum(1)
    log_coverage = torch.nn.functional.logsigmoid(gaussians.opacity_logits) + two_largest
    return log_coverage.topk(budget).indices.sort().values


class RelitPreview:
    """Relit scenes of one project; intermediate results are memoised by their inputs."""

    def __init__(self, scenes: SceneCache) -> None:
        """Start with empty memos."""
        self._scenes = scenes
        self._full_values, self._draft_values = (TransferValues(scenes.target_clock) for _ in range(2))
        self._memo = Memo()
        self._full_lock, self._draft_lock = threading.RLock(), threading.RLock()

    def is_relit(self, state: EditState) -> bool:
        """Return whether this state's light is memoised, or project.toml selects no physical light transfer."""
        return not self._scenes.files.transfers_light or self._memo.peek("relit", self._inputs(state)) is not None

    def relit(self, state: EditState) -> Relit:
        """Compute the layers of this state's full light transfer, as the step does."""
        # as in the step, sources and shadow maps are those of this placement
        return self._make_once("relit", state, lambda: self._transfer(state), lock=self._full_lock)

    def draft(self, state: EditState) -> Draft:
        """Compute a draft with coarse shadow edges; the first draft omits the light of the source scene."""
        # a draft must not wait for the final light; for a small scene both share the transfer's values
        lock = self._draft_lock if _is_large(self._scenes.composite(state)) else self._full_lock
        return self._make_once("draft", state, lambda: self._draft(state), lock=lock)

    def prepare_drafts(self, state: EditState) -> None:
        """Compute once what the first draft and the first full light after a move share with later ones."""
        composite, sources = self._scenes.composite(state), self._scenes.source_scenes(state)
        if self._scenes.files.transfers_light and (_is_large(composite) or not self._memo.has("relit")):
            with self._full_lock:
                self._full_values.capture_objects(composite, self._scenes.cameras("target"), sources)
            with self._draft_lock if _is_large(composite) else self._full_lock:
                shared = (composite.target, composite.erased, *sources)
                self._memo.get("drafts prepared", shared, lambda: self._draft(state, with_sources=True))

    def _make_once(
        self, name: str, state: EditState, make: Callable[[], T], *, lock: AbstractContextManager[object]
    ) -> T:
        inputs = self._inputs(state)
        # a memoised result must not wait for a computation in another thread
        found = self._memo.peek(name, inputs)
        if found is None:
            with lock:
                found = self._memo.get(name, inputs, make)
        return found

    def _inputs(self, state: EditState) -> tuple[Any, ...]:
        return (self._scenes.composite(state), state.light, repr(self._scenes.files.relight.options))

    def _transfer(self, state: EditState) -> Relit:
        return self._full_values.relight(
            self._scenes.composite(state),
            self._scenes.cameras("target"),
            sources=self._scenes.source_scenes(state),
            light=state.light,
            options=self._scenes.files.relight.options,
            exact=True,
        )

    def _draft(self, state: EditState, *, with_sources: bool = False) -> Draft:
        composite = self._scenes.composite(state)
        sources = self._scenes.source_scenes(state)
        if not (with_sources or self._memo.has("relit") or self._memo.has("drafts prepared")):
            # analysing the source scene takes half of the time of the first result
            sources = [None] * len(sources)
        values, drawn, parts, memo = self._full_values, composite, [], self._memo
        if _is_large(composite):
            kept = (composite.target, composite.erased)
            target = memo.get("coarse target", kept, lambda: coarsen(kept[0].select(~kept[1]), TARGET_BUDGET))
            # duplicates of an object share its coarse Gaussians, and thereby the light at its old place
            given = [one.gaussians for one in composite.objects]
            first = [next(i for i, other in enumerate(given) if other is one) for one in given]
            objects = [
                memo.get(f"coarse object {i}", (given[i],), lambda i=i: coarsen(given[i], OBJECT_BUDGET)) for i in first
            ]
            values, parts, coarse = self._draft_values, [target, *objects], target.gaussians
            for i, source in enumerate(sources):
                if source is not None:
                    pair = (objects[i].gaussians, source)
                    values.share_source_light(pair, self._full_values, (given[i], source))
            drawn = Composite(
                target=coarse,
                objects=tuple(
                    replace(one, gaussians=part.gaussians) for one, part in zip(composite.objects, objects, strict=True)
                ),
                erased=memo.get("none erased", (coarse,), lambda: torch.zeros(coarse.count, dtype=torch.bool)),
            )
        options = replace(self._scenes.files.relight.options, most_added=0.0, fitted_views=0)
        relit = values.relight(
            drawn, self._scenes.cameras("target"), sources=sources, light=state.light, options=options, exact=False
        )
        return coarse_draft(relit, parts) if parts else Draft(relit, torch.arange(relit.gaussians.count))


def _is_large(composite: Composite) -> bool:
    objects = [one.gaussians.count for one in composite.objects]
    return composite.kept_count > TARGET_BUDGET or max(objects, default=0) > OBJECT_BUDGET
