"""Light: what was found as arrows that can be dragged, and how strong each layer is. Knows nothing about estimation."""

from __future__ import annotations

import html
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
import viser

from splatgraft.editor.page.place_phase import NO_NAMES, hide_target, show_target
from splatgraft.editor.previews.light_handles import aimed, arrow_points, ring_points
from splatgraft.editor.session.edit_state import EditState
from splatgraft.relighting import LayerWeights, Light

if TYPE_CHECKING:
    from splatgraft.editor.page.page import Page

_LAYERS = (("shade", "Shade"), ("shadow", "Shadow"), ("bounce", "Bounce"), ("gloss", "Gloss"))
_SHOWN = 4


class LightPhase:
    """The controls of the fourth step, and the lights in 3D."""

    def __init__(self, page: Page) -> None:
        """Build them."""
        self._page, gui = page, page.gui
        self._inside = False
        self._text = gui.add_html("")
        self._find = gui.add_button("Find the light", icon=viser.Icon.SUN)
        self._which = gui.add_dropdown("Aim", NO_NAMES, initial_value=NO_NAMES[0], visible=False)
        self._strength = gui.add_slider("Its strength", 0.0, 3.0, 0.05, 1.0, visible=False)
        self._sliders = {key: gui.add_slider(label, 0.0, 2.0, 0.05, 1.0) for key, label in _LAYERS}
        self._estimate = gui.add_button("Back to the estimate", color="gray")
        self._handle: viser.TransformControlsHandle | None = None
        self._aiming: Light | None = None
        self._start: Light | None = None
        act = page.act
        self._find.on_click(act(lambda _: self._found()))
        self._which.on_update(act(lambda _: self._remove_handle()))
        self._strength.on_update(act(lambda _: self._strengthen()))
        self._estimate.on_click(act(lambda _: self._to_estimate()))
        for slider in self._sliders.values():
            slider.on_update(act(lambda _: self._weigh()))

    def enter(self) -> None:
        """Show the target and the lights."""
        self._inside = True
        session = self._page.session
        if session is not None and session.files.target_scene.is_file():
            show_target(self._page)
        self.refresh()

    def leave(self) -> None:
        """Take them away."""
        self._inside = False
        hide_target(self._page)
        self._remove_handle()
        self._hide_arrows()

    def refresh(self) -> None:
        """Lights, sentences and strengths as they are now."""
        session = self._page.session
        if session is None or not self._inside:
            return
        weights = session.state.weights
        for key, slider in self._sliders.items():
            slider.value = float(getattr(weights, key))
        light = self._light()
        ready = light is not None and bool(session.objects())
        self._find.visible = session.files.transfers_light and not ready and bool(session.objects())
        self._estimate.disabled = session.state.light is None
        self._which.visible = self._strength.visible = ready and bool(light and light.sources)
        if light is None or not session.objects():
            self._text.content = _box(html.escape(self._why_none()))
            return
        names = tuple(f"{i + 1}: {s.name}" for i, s in enumerate(light.sources[:_SHOWN]))
        if names and tuple(self._which.options) != names:
            self._which.options = names
        self._text.content = _box(html.escape(_sentences(session.state, light, self._page.need().up())))
        self._draw(light)

    def _light(self) -> Light | None:
        """As given by hand, else as the last preview found it."""
        session = self._page.session
        if session is None or not session.objects():
            return None
        if session.state.light is not None:
            return session.state.light
        state = session.placed_state()
        return session.transfers.relit(state).light if session.transfers.is_lit(state) else None

    def _why_none(self) -> str:
        session = self._page.need()
        if not session.files.transfers_light:
            return f"The light is no physical transfer: {session.transfers.note()}. There is nothing to aim."
        if not session.objects():
            return "No object is placed yet: see step 3."
        state = session.placed_state()
        return (
            " ".join(session.transfers.relit(state).report)
            if session.transfers.is_lit(state)
            else "Looking for the light."
        )

    def _found(self) -> None:
        session = self._page.need()
        relit = session.transfers.relit(session.placed_state())
        for sentence in relit.report[:1]:
            self._page.say(sentence)

    def _weigh(self) -> None:
        session = self._page.need()
        weights = LayerWeights(**{key: float(slider.value) for key, slider in self._sliders.items()})
        session.change(replace(session.state, weights=weights))
        self._page.preview.ask()

    def _to_estimate(self) -> None:
        session = self._page.need()
        session.change(replace(session.state, light=None))

    def _index(self) -> int:
        return list(self._which.options).index(self._which.value)

    def _strengthen(self) -> None:
        session, light = self._page.need(), self._light()
        if light is None:
            return
        index, factor = self._index(), float(self._strength.value)
        source = light.sources[index]
        r, g, b = (factor * value for value in source.irradiance)
        sources = (*light.sources[:index], replace(source, irradiance=(r, g, b)), *light.sources[index + 1 :])
        session.change(replace(session.placed_state(), light=replace(light, sources=sources)))
        self._strength.value = 1.0

    # arrows

    def _centre(self) -> torch.Tensor:
        session = self._page.need()
        base = session.placeable(0).base
        return session.objects()[0].target_from_object.points(base.point + 0.5 * base.height * base.up)

    def _reach(self) -> float:
        session = self._page.need()
        base, scale = session.placeable(0).base, session.objects()[0].target_from_object.scale
        return 4.0 * scale * max(base.height, base.radius)

    def _draw(self, light: Light) -> None:
        centre, reach, scene = self._centre(), self._reach(), self._page.server.scene
        self._hide_arrows(keep=len(light.sources[:_SHOWN]))
        brightest = max((s.luminance for s in light.sources), default=1.0)
        for index, source in enumerate(light.sources[:_SHOWN]):
            thick = 0.25 + 0.75 * (source.luminance / max(brightest, 1e-9)) ** 0.5
            color = np.array(source.irradiance) / max(*source.irradiance, 1e-9)
            rgb = tuple(int(255 * float(c)) for c in color.clip(0, 1) ** (1 / 2.2))
            scene.add_arrows(
                f"/light/{index}/arrow",
                points=arrow_points(source, centre, reach).numpy()[None],
                colors=(rgb[0], rgb[1], rgb[2]),
                shaft_radius=0.012 * reach * thick,
                head_radius=0.035 * reach * thick,
                head_length=0.1 * reach,
            )
            scene.add_line_segments(
                f"/light/{index}/doubt",
                points=ring_points(source, centre, reach).numpy(),
                colors=(rgb[0], rgb[1], rgb[2]),
            )
        if light.sources and self._aiming is None:
            self._show_handle(light)

    def _show_handle(self, light: Light) -> None:
        index = min(self._index(), len(light.sources) - 1)
        position = arrow_points(light.sources[index], self._centre(), self._reach())[0].numpy()
        if self._handle is None:
            self._handle = self._page.server.scene.add_transform_controls(
                "/light/handle", scale=0.45 * self._reach(), disable_rotations=True, position=position
            )
            self._handle.on_update(self._dragged)
        else:
            self._handle.position = position

    def _remove_handle(self) -> None:
        if self._handle is not None:
            self._handle.remove()
            self._handle = None

    def _hide_arrows(self, keep: int = 0) -> None:
        for index in range(keep, _SHOWN):
            for part in ("arrow", "doubt"):
                self._page.view.remove(f"/light/{index}/{part}")

    async def _dragged(self, event: viser.TransformControlsEvent) -> None:
        session, handle, light = self._page.session, self._handle, self._aiming or self._light()
        if session is None or handle is None or light is None or event.phase == "start":
            return
        towards = torch.tensor(np.asarray(handle.position), dtype=torch.float32) - self._centre()
        self._aiming = aimed(light, self._index(), towards)
        ended = event.phase == "end"
        after = replace(session.placed_state(), light=self._aiming)
        self._draw(self._aiming)
        if ended:
            self._aiming = None
            self._page.act(lambda _: session.change(after))(None)
        self._page.preview.moving(None if ended else after)


def _sentences(state: EditState, light: Light, up: torch.Tensor) -> str:
    return ("As you aimed it: " if state.light is not None else "Found: ") + light.describe(up)


def _box(text: str) -> str:
    return f'<div class="sg-light" style="font-size:.85em;line-height:1.5;padding:2px 12px">{text}</div>'
