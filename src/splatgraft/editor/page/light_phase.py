"""The phase `Light`: light sources as draggable arrows, and the strength of each layer of the light transfer."""

from __future__ import annotations

import html
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
import viser

from splatgraft.editor.page.place_phase import NO_NAMES, hide_target, show_target
from splatgraft.editor.previews.light_handles import arrow_points, uncertainty_ring_points, with_direction
from splatgraft.editor.session.edit_state import EditState
from splatgraft.relighting import LayerWeights, Light

if TYPE_CHECKING:
    from splatgraft.editor.page.page import Page

_LAYERS = (
    ("shade", "Shade", (0.0, 2.0), "Light and dark sides of the object; 1 is as computed"),
    ("tint", "Tint", (0.0, 4.0), "Change of the object's colour by the new light; 1 is as computed"),
    ("exposure", "Exposure", (-2.0, 2.0), "Stops by which the object is brighter; 0 is as computed"),
    ("shadow", "Shadow", (0.0, 2.0), "Light that the object takes from its surroundings; 1 is as computed"),
    ("bounce", "Bounce", (0.0, 2.0), "Light that the object reflects onto its surroundings; 1 is as computed"),
    ("gloss", "Gloss", (0.0, 2.0), "Reflections on the object; 1 is as computed"),
)
"""Field of `LayerWeights`, label, range of the slider and hint."""
_MAX_SOURCES = 4
_HANDLE_PX = 70.0
"""Length of the handle's arrows on the screen, pixels."""


class LightPhase:
    """The controls of the phase, and the light sources in the 3D view."""

    def __init__(self, page: Page) -> None:
        """Build the controls."""
        self._page, gui = page, page.gui
        self._is_active = False
        self._text = gui.add_html("")
        self._estimate_button = gui.add_button("Estimate the light", icon=viser.Icon.SUN)
        self._source_choice = gui.add_dropdown("Source", NO_NAMES, initial_value=NO_NAMES[0], visible=False)
        self._strength = gui.add_slider("Strength", 0.0, 3.0, 0.05, 1.0, visible=False)
        usual = LayerWeights()
        self._sliders = {
            key: gui.add_slider(label, *ends, 0.05, float(getattr(usual, key)), hint=hint)
            for key, label, ends, hint in _LAYERS
        }
        self._reset = gui.add_button("Back to the estimate", color="gray")
        self._handle: viser.TransformControlsHandle | None = None
        self._dragged_light: Light | None = None
        callback = page.callback
        self._estimate_button.on_click(callback(lambda _: self._show_estimate()))
        self._source_choice.on_update(callback(lambda _: self._remove_handle()))
        self._strength.on_update(callback(lambda _: self._scale_source()))
        self._reset.on_click(callback(lambda _: self._reset_to_estimate()))
        for slider in self._sliders.values():
            slider.on_update(callback(lambda _: self._set_weights()))

    def enter(self) -> None:
        """Show the target and the light sources."""
        self._is_active = True
        session = self._page.session
        if session is not None and session.files.target_scene.is_file():
            show_target(self._page)
        self.refresh()

    def leave(self) -> None:
        """Hide them."""
        self._is_active = False
        hide_target(self._page)
        self._remove_handle()
        self._hide_arrows()

    def refresh(self) -> None:
        """Update arrows, description and strengths."""
        session = self._page.session
        if session is None or not self._is_active:
            return
        weights = session.state.weights
        for key, slider in self._sliders.items():
            slider.value = float(getattr(weights, key))
        # the arrows stand at the object
        is_read = self._page.loading.has(session, session.scenes.base_files(session.objects()))
        light = self._light() if is_read else None
        is_known = light is not None and bool(session.objects())
        self._estimate_button.visible = session.files.transfers_light and not is_known and bool(session.objects())
        self._reset.disabled = session.state.light is None
        self._source_choice.visible = self._strength.visible = is_known and bool(light and light.sources)
        if light is None or not session.objects():
            self._text.content = _box(html.escape(self._missing_reason()))
            return
        names = tuple(f"{i + 1}: {s.name}" for i, s in enumerate(light.sources[:_MAX_SOURCES]))
        if names and tuple(self._source_choice.options) != names:
            self._source_choice.options = names
        self._text.content = _box(html.escape(_description(session.state, light, self._page.require_session().up())))
        self._draw(light)

    def _light(self) -> Light | None:
        """The light set by hand, else the last estimate of the preview."""
        session = self._page.session
        if session is None or not session.objects():
            return None
        if session.state.light is not None:
            return session.state.light
        state = session.placed_state()
        return session.relighting.relit(state).light if session.relighting.is_relit(state) else None

    def _missing_reason(self) -> str:
        session = self._page.require_session()
        if not self._page.loading.has(session, session.scenes.base_files(session.objects())):
            return "The object is being read."
        if not session.files.transfers_light:
            return f"The physical light transfer is off: {session.relighting.light_mode_note()}."
        if not session.objects():
            return "No object is placed yet: see Place."
        state = session.placed_state()
        return (
            " ".join(session.relighting.relit(state).report)
            if session.relighting.is_relit(state)
            else "Estimating the light."
        )

    def _show_estimate(self) -> None:
        session = self._page.require_session()
        relit = session.relighting.relit(session.placed_state())
        for sentence in relit.report[:1]:
            self._page.say(sentence)

    def _set_weights(self) -> None:
        session = self._page.require_session()
        weights = LayerWeights(**{key: float(slider.value) for key, slider in self._sliders.items()})
        session.change(replace(session.state, weights=weights))
        self._page.preview.update()

    def _reset_to_estimate(self) -> None:
        session = self._page.require_session()
        session.change(replace(session.state, light=None))

    def _index(self) -> int:
        return list(self._source_choice.options).index(self._source_choice.value)

    def _scale_source(self) -> None:
        session, light = self._page.require_session(), self._light()
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
        session = self._page.require_session()
        base = session.placeable_object(0).base
        return session.objects()[0].target_from_object.points(base.point + 0.5 * base.height * base.up)

    def _arrow_length(self) -> float:
        session = self._page.require_session()
        base, scale = session.placeable_object(0).base, session.objects()[0].target_from_object.scale
        return 4.0 * scale * max(base.height, base.radius)

    def _draw(self, light: Light) -> None:
        centre, length, scene = self._centre(), self._arrow_length(), self._page.server.scene
        self._hide_arrows(keep=len(light.sources[:_MAX_SOURCES]))
        brightest = max((s.luminance for s in light.sources), default=1.0)
        for index, source in enumerate(light.sources[:_MAX_SOURCES]):
            thickness = 0.25 + 0.75 * (source.luminance / max(brightest, 1e-9)) ** 0.5
            color = np.array(source.irradiance) / max(*source.irradiance, 1e-9)
            rgb = tuple(int(255 * float(c)) for c in color.clip(0, 1) ** (1 / 2.2))
            scene.add_arrows(
                f"/light/{index}/arrow",
                points=arrow_points(source, centre, length).numpy()[None],
                colors=(rgb[0], rgb[1], rgb[2]),
                shaft_radius=0.012 * length * thickness,
                head_radius=0.035 * length * thickness,
                head_length=0.1 * length,
            )
            scene.add_line_segments(
                f"/light/{index}/uncertainty",
                points=uncertainty_ring_points(source, centre, length).numpy(),
                colors=(rgb[0], rgb[1], rgb[2]),
            )
        if light.sources and self._dragged_light is None:
            self._show_handle(light)

    def _show_handle(self, light: Light) -> None:
        index = min(self._index(), len(light.sources) - 1)
        position = arrow_points(light.sources[index], self._centre(), self._arrow_length())[0].numpy()
        if self._handle is None:
            self._handle = self._page.server.scene.add_transform_controls(
                "/light/handle",
                scale=_HANDLE_PX,
                fixed=True,
                depth_test=False,
                disable_rotations=True,
                position=position,
            )
            self._handle.on_update(self._dragged)
        else:
            self._handle.position = position

    def _remove_handle(self) -> None:
        if self._handle is not None:
            self._handle.remove()
            self._handle = None

    def _hide_arrows(self, keep: int = 0) -> None:
        for index in range(keep, _MAX_SOURCES):
            for part in ("arrow", "uncertainty"):
                self._page.view.remove(f"/light/{index}/{part}")

    async def _dragged(self, event: viser.TransformControlsEvent) -> None:
        session, handle, light = self._page.session, self._handle, self._dragged_light or self._light()
        if session is None or handle is None or light is None or event.phase == "start":
            return
        towards = torch.tensor(np.asarray(handle.position), dtype=torch.float32) - self._centre()
        self._dragged_light = with_direction(light, self._index(), towards)
        ended = event.phase == "end"
        edited = replace(session.placed_state(), light=self._dragged_light)
        self._draw(self._dragged_light)
        if ended:
            self._dragged_light = None
            self._page.callback(lambda _: session.change(edited))(None)
        self._page.preview.set_dragged_state(None if ended else edited)


def _description(state: EditState, light: Light, up: torch.Tensor) -> str:
    return ("Set by hand: " if state.light is not None else "Estimated: ") + light.describe(up)


def _box(text: str) -> str:
    return f'<div class="sg-light" style="font-size:.85em;line-height:1.5;padding:2px 12px">{text}</div>'
