"""The light of what is placed, as the step `relight` makes it, and drafts of it that are there sooner.

Knows nothing about pictures and browsers.
"""

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from jaxtyping import Bool
from torch import Tensor

from splatgraft.core.composite import Composite
from splatgraft.core.gaussians import Gaussians
from splatgraft.editor.previews.draft_preview import (
    OBJECT_BUDGET,
    TARGET_BUDGET,
    Thinned,
    carried_over,
    thinned,
    thinned_composite,
)
from splatgraft.editor.session.edit_state import EditState
from splatgraft.editor.session.scene_cache import Scenes
from splatgraft.relighting import Light, Relit, SourceScene, relight
from splatgraft.relighting.gain_transfer import relight_by_gain
from splatgraft.runtime.memo import Memo


class Transfers:
    """Of one project; what a move or another light leaves unchanged is kept."""

    def __init__(self, scenes: Scenes) -> None:
        """Nothing made yet."""
        self._scenes = scenes
        self._cache, self._draft_cache = Memo(), Memo()
        self._kept = Memo()
        self.work = threading.RLock()
        """Held by whoever makes what is kept, so that two threads do not make it twice."""

    def composite(self, state: EditState) -> Composite:
        """The target with what is placed in it; the same object for the same decisions.

        Raises: ValueError where a file is missing.
        """
        inputs = (self._scenes.gaussians(self._scenes.files.target_scene), state.objects, state.erased)
        return self._kept.get("composite", inputs, lambda: self._scenes.composite(state))

    def is_lit(self, state: EditState) -> bool:
        """Whether the light of this state is there already, or takes no time."""
        return not self._scenes.files.transfers_light or self._kept.peek("relit", self._inputs(state)) is not None

    def relit(self, state: EditState) -> Relit:
        """The light transfer of this state, in layers.

        Raises: ValueError where a file is missing.
        """
        return self._made_alone("relit", state, self._relight)

    def drafted(self, state: EditState) -> Relit:
        """The same in a fraction of the time: shadows have coarse edges, and at first the object keeps its brightness.

        Raises: ValueError where a file is missing.
        """
        return self._made_alone("draft", state, self._draft)

    def soonest(self, state: EditState) -> Relit:
        """The whole transfer where it is there, else a draft.

        Raises: ValueError where a file is missing.
        """
        return self.relit(state) if self.is_lit(state) else self.drafted(state)

    def scene(self, state: EditState, *, draft: bool = False) -> Gaussians:
        """What the step `relight` would write, or a draft of it.

        Raises: ValueError where a file is missing.
        """
        composite, light_by = self.composite(state), self._scenes.files.light_by
        if light_by == "off":
            return self.pasted(composite)[0]
        if light_by == "gain":
            return self._kept.get("gained", (composite,), lambda: self._gained(composite, state))
        relit = self.soonest(state) if draft else self.relit(state)
        return self._kept.get("scene", (relit, state.weights), lambda: relit.bake(state.weights)[0])

    def pasted(self, composite: Composite) -> tuple[Gaussians, Bool[Tensor, "n"]]:
        """What the step `compose` would write."""
        return self._kept.get("pasted", (composite,), composite.bake)

    def note(self) -> str:
        """What `Light transfer` shows where project.toml asks for less than the physical one."""
        light_by = self._scenes.files.light_by
        what = {"gain": "exposure and white balance of the object alone", "off": "nothing: the object as captured"}
        return (
            "" if light_by == "transfer" else f"{what[light_by]}, as project.toml asks ([relight] light = {light_by})"
        )

    def _gained(self, composite: Composite, state: EditState) -> Gaussians:
        cameras, sources = self._scenes.cameras(self._scenes.files.target_cameras), self._scenes.source_scenes(state)
        adjusted, _ = relight_by_gain(composite, cameras, sources=sources)
        return adjusted.bake()[0]

    def _made_alone(self, name: str, state: EditState, make: Callable[[EditState], Relit]) -> Relit:
        inputs = self._inputs(state)
        # what is there already must not wait for what another thread makes
        found = self._kept.peek(name, inputs)
        if found is None:
            with self.work:
                found = self._kept.get(name, inputs, lambda: make(state))
        return found

    def _inputs(self, state: EditState) -> tuple[Any, ...]:
        return (self.composite(state), state.light, repr(self._scenes.files.relighting))

    def _relight(self, state: EditState) -> Relit:
        composite, sources = self.composite(state), self._scenes.source_scenes(state)
        draft: Relit | None = self._kept.peek("draft", self._inputs(state))
        if state.light is not None or draft is None or draft.light is None or _is_large(composite):
            return self._transferred(composite, sources, light=state.light)
        # a draft of all Gaussians looked for the light as the step will, at this very place
        relit = self._transferred(composite, sources, light=draft.light)
        return replace(relit, report=(*draft.report[:1], *relit.report[1:]))

    def _draft(self, state: EditState) -> Relit:
        composite, sources = self.composite(state), self._scenes.source_scenes(state)
        if not self._kept.has("relit"):
            # where the object comes from takes half of the first time
            sources = [None] * len(sources)
        if not _is_large(composite):
            return self._transferred(composite, sources, light=state.light, is_draft=True)
        target = self._thinned_target(composite)
        objects = [self._thinned_object(i, one.gaussians) for i, one in enumerate(composite.objects)]
        few = thinned_composite(composite, target, objects)
        origins = [None if source is None else self._thinned_source(source) for source in sources]
        relit = self._transferred(few, origins, light=state.light, is_draft=True)
        return carried_over(relit, composite, [target, *objects])

    def _transferred(
        self,
        composite: Composite,
        sources: Sequence[SourceScene | None],
        *,
        light: Light | None,
        is_draft: bool = False,
    ) -> Relit:
        cameras, options = self._scenes.cameras(self._scenes.files.target_cameras), self._scenes.files.relighting
        options = replace(options, most_added=0.0) if is_draft else options
        own = self._scenes.gaussians(self._scenes.files.target_scene)
        cache = self._cache if composite.target is own else self._draft_cache
        return relight(composite, cameras, sources=sources, light=light, options=options, cache=cache)

    def _thinned_target(self, composite: Composite) -> Thinned:
        def make() -> Thinned:
            return thinned(composite.target.select(~composite.erased), TARGET_BUDGET)

        return self._kept.get("thin target", (composite.target, composite.erased), make)

    def _thinned_object(self, index: int, gaussians: Gaussians) -> Thinned:
        return self._kept.get(f"thin object {index}", (gaussians,), lambda: thinned(gaussians, OBJECT_BUDGET))

    def _thinned_source(self, source: SourceScene) -> SourceScene:
        def make() -> SourceScene:
            return replace(source, gaussians=thinned(source.gaussians, TARGET_BUDGET).gaussians)

        return self._kept.get("thin source", (source,), make)


def _is_large(composite: Composite) -> bool:
    objects = [one.gaussians.count for one in composite.objects]
    return composite.kept_count > TARGET_BUDGET or max(objects, default=0) > OBJECT_BUDGET
