"""The phase `Light`: light sources as draggable arrows, a sun set by two clicks, and the strength of each layer of the
light transfer.
"""

import html
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
import viser
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.directions import tangents
from splatgraft.editor.page.context import PageContext, Phase, SceneClicks, note
from splatgraft.editor.page.handles import add_handle
from splatgraft.editor.page.preview_panel import PreviewPanel
from splatgraft.editor.page.scene_view import direction_from_viser, ray_from_viser
from splatgraft.editor.picking import first_surface_hit
from splatgraft.editor.session import Session
from splatgraft.editor.sky_dome import SkyDome
from splatgraft.relighting import LayerWeights, Light, LightSource
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.light.sun import Point, direction_through, set_sun, with_sun

_FIRST = (
    ("exposure", "Brightness", (-2.0, 2.0), "Of the object, in stops; 0 is as computed"),
    ("warmth", "Warmth", (-2.0, 2.0), "Of the object's colours; 0 is as computed"),
    ("shadow", "Shadow strength", (0.0, 2.0), "1 is as computed"),
)
_LAYERS = (
    ("shade", "Shade", (0.0, 2.0), "Light and dark sides of the object; 1 is as computed"),
    ("tint", "Tint", (0.0, 4.0), "Change of the object's colour by the new light; 1 is as computed"),
    ("bounce", "Bounce", (0.0, 2.0), "Light that the object reflects onto its surroundings; 1 is as computed"),
    ("gloss", "Gloss", (0.0, 2.0), "Reflections on the object; 1 is as computed"),
)
"""Field of `LayerWeights`, label, range of the slider and hint."""
_SOFTNESS = (0.3, 30.0)
"""Degrees; the sun's own is .27."""
_SEEN_AFTER = 0.05
"""Change of a direction from which on the picture of the sky is turned."""
Float3 = tuple[float, float, float]
_NO_NAMES: tuple[str, ...] = ("1",)
_MAX_SOURCES = 4
_UNSEEN = 0.5
"""Share of the directions overhead that were not photographed, from which on the panel says so."""
_HANDLE_PX = 70.0
"""Length of the handle's arrows on the screen, pixels."""
_RING_SEGMENTS = 48
_MARK = (255, 200, 60)
"""Color of the points that set the sun."""


class LightPhase(Phase):
    """The controls of the phase, and the light sources in the 3D view."""

    def __init__(self, context: PageContext, preview: PreviewPanel) -> None:
        """Build the controls."""
        self._context, self._preview, gui = context, preview, context.gui
        self._sun_clicks = SunClicks(context, self._light)
        self._sky = gui.add_html("", visible=False)
        self._text = gui.add_html("")
        usual = LayerWeights()

        def sliders(layers: tuple[tuple[str, str, tuple[float, float], str], ...]) -> dict[str, Any]:
            return {
                key: gui.add_slider(label, *ends, 0.05, float(getattr(usual, key)), hint=hint)
                for key, label, ends, hint in layers
            }

        self._sliders = sliders(_FIRST)
        self._softness = gui.add_slider(
            "Shadow softness", *_SOFTNESS, 0.1, 1.0, hint="Degrees that the chosen light seems wide", visible=False
        )
        self._reset = context.on(gui.add_button("Back to the estimate", color="gray"), self._reset_to_estimate)
        with context.more_of("Light"):
            self._source_choice = context.on(gui.add_dropdown("Source", _NO_NAMES, visible=False), self._remove_handle)
            self._strength = context.on(
                gui.add_slider("Strength", 0.0, 3.0, 0.05, 1.0, visible=False), self._scale_source
            )
            self._sliders |= sliders(_LAYERS)
        self._handle: viser.TransformControlsHandle | None = None
        self._dragged_light: Light | None = None
        self._dome: SkyDome | None = None
        """How the picture of the sky is turned."""
        self._full: tuple[Float3, ...] = ()
        """Irradiance of each source at a strength of 1: what it was before the slider changed it."""
        self._scaled: tuple[LightSource, ...] | None = None
        """The sources that the slider made last."""
        context.on(self._softness, self._soften)
        for slider in self._sliders.values():
            context.on(slider, self._set_weights)
        context.guarded.hands["light"] = self._drag_on_sky

    def leave(self) -> None:
        """Hide the light sources."""
        self._remove_handle()
        self._hide_arrows()
        self._sun_clicks.leave()

    def enter(self) -> None:
        """Show the light transfer, which follows the edits."""
        self._preview.show_edits()

    def refresh(self) -> None:
        """Update the target, the arrows, description and strengths."""
        session = self._context.session
        if session is None:
            return
        self._context.show_target()
        for key, slider in self._sliders.items():
            slider.value = float(getattr(session.state.weights, key))
        objects = session.objects()
        # the arrows stand at the object
        light = self._light(session) if objects and session.scenes.at_hand(session.scenes.base_files(objects)) else None
        self._reset.disabled = session.state.light is None
        self._sun_clicks.refresh(light)
        for control in (self._source_choice, self._strength, self._softness):
            control.visible = light is not None and bool(light.sources)
        self._sky.visible = light is not None
        if light is None:
            self._text.content = note(html.escape(_missing_reason(session)), kind="light")
            return
        names = tuple(f"{i + 1}: {s.name}" for i, s in enumerate(light.sources[:_MAX_SOURCES]))
        if names and tuple(self._source_choice.options) != names:
            self._source_choice.options = names
        if light.sources != self._scaled:
            self._full, self._scaled = tuple(source.irradiance for source in light.sources), light.sources
        if light.sources:
            index = min(self._index(), len(light.sources) - 1)
            now, full = max(light.sources[index].irradiance), max(self._full[index])
            self._strength.value = round(now / full, 2) if full > 0 else 1.0
            self._softness.value = round(
                min(_SOFTNESS[1], max(_SOFTNESS[0], light.sources[index].angular_radius_deg)), 1
            )
        self._show_sky(session, light)
        self._draw(session, light)

    def view_shown(self, camera: Cameras) -> None:
        """Turn the picture of the sky with the view."""
        session = self._context.session
        if session is None or not session.objects():
            return
        dome, light = SkyDome.seen_along(camera.world_from_camera[0, :3, 2], session.up()), self._light(session)
        is_turned = self._dome is None or float((dome.forward - self._dome.forward).norm()) > _SEEN_AFTER
        if light is not None and is_turned:
            self._dome = dome
            self._show_sky(session, light)

    def _show_sky(self, session: Session, light: Light) -> None:
        """The picture of the sky with its lights, and the same in words."""
        if self._dome is None:
            window = self._context.guarded.editing()
            away = torch.tensor([0.0, 1.0, 0.0]) if window is None else direction_from_viser(window.camera)
            self._dome = SkyDome.seen_along(away, session.up())
        self._sky.content = self._dome.svg(light)
        named = [f"{s.name.partition(' set by hand')[0]} {self._dome.words(s)}" for s in light.sources[:_MAX_SOURCES]]
        by = "Estimated" if session.state.light is None else "Set by hand"
        found = "; ".join(named) if named else "even light without a clear source"
        doubt = " What is overhead was not photographed." if light.unseen_up > _UNSEEN else ""
        self._text.content = note(html.escape(f"{by}: {found}.{doubt}"), kind="light")

    def _light(self, session: Session) -> Light | None:
        """The light set by hand, else the last estimate of the preview."""
        if session.state.light is not None:
            return session.state.light
        state = session.placed_state()
        is_known = session.files.transfers_light and session.relighting.is_relit(state)
        return session.relighting.relit(state).light if is_known else None

    def _set_weights(self) -> None:
        session = self._context.require_session()
        weights = LayerWeights(**{key: float(slider.value) for key, slider in self._sliders.items()})
        session.change(replace(session.state, weights=weights))

    def _reset_to_estimate(self) -> None:
        session = self._context.require_session()
        session.change(replace(session.state, light=None))

    def _index(self) -> int:
        return list(self._source_choice.options).index(self._source_choice.value)

    def _scale_source(self) -> None:
        factor = float(self._strength.value)

        def scaled(source: LightSource, index: int) -> LightSource:
            r, g, b = (factor * value for value in self._full[index])
            return replace(source, irradiance=(r, g, b))

        self._change_source(scaled)

    def _soften(self) -> None:
        degrees = float(self._softness.value)
        self._change_source(lambda source, _: replace(source, angular_radius_deg=degrees, uncertainty_deg=0.0))

    def _change_source(self, change: Callable[[LightSource, int], LightSource]) -> None:
        """Change the chosen source, given with its number; the strengths stay relative to what they were."""
        session = self._context.require_session()
        light = self._light(session) if session.objects() else None
        if light is None or not light.sources:
            return
        index = min(self._index(), len(light.sources) - 1)
        edited = _with_source(light, index, change(light.sources[index], index))
        self._scaled = edited.sources
        session.change(replace(session.placed_state(), light=edited))

    def _drag_on_sky(self, query: Mapping[str, str]) -> None:
        """Move a light on the picture of the sky, to x and y over the horizon's radius."""
        session, dome = self._context.require_session(), self._dome
        light = self._dragged_light or (self._light(session) if session.objects() else None)
        x, y, index = float(query["x"]), float(query["y"]), int(query["source"])
        if self._context.phase != "Light" or dome is None or light is None or not 0 <= index < len(light.sources):
            raise ValueError("light: expected a light of the picture of the sky, found none")
        if not math.hypot(x, y) < 2:
            raise ValueError(f"light: expected a place in the picture of the sky, found {x:g}, {y:g}")
        if index < len(self._source_choice.options):
            self._source_choice.value = self._source_choice.options[index]
        self._move_light(session, with_direction(light, index, dome.direction(x, y)), ended=query.get("end") == "1")

    def _move_light(self, session: Session, light: Light, *, ended: bool) -> None:
        """Show a light whose source is being dragged, and save it at the end, as one undo step."""
        self._dragged_light = light
        edited = replace(session.placed_state(), light=light)
        self._draw(session, light)
        if ended:
            self._dragged_light = None
            self._context.callback(lambda _: session.change(edited))(None)
        self._preview.set_dragged_state(None if ended else edited)

    # arrows

    def _centre_and_length(self, session: Session) -> tuple[Float[Tensor, "3"], float]:
        """Where the arrows point, and how far away they begin."""
        base, placed = session.placeable_object(0).base, session.objects()[0].target_from_object
        length = 4.0 * placed.scale * max(base.height, base.radius)
        return placed.points(base.point + 0.5 * base.height * base.up), length

    def _draw(self, session: Session, light: Light) -> None:
        (centre, length), scene = self._centre_and_length(session), self._context.server.scene
        sources = light.sources[:_MAX_SOURCES]
        self._hide_arrows(keep=len(sources))
        brightest = max((s.luminance for s in light.sources), default=1.0)
        for index, source in enumerate(sources):
            thickness = 0.25 + 0.75 * (source.luminance / max(brightest, 1e-9)) ** 0.5
            color = np.array(source.irradiance) / max(*source.irradiance, 1e-9)
            r, g, b = (int(255 * float(c)) for c in color.clip(0, 1) ** (1 / 2.2))
            scene.add_arrows(
                f"/light/{index}/arrow",
                points=arrow_points(source, centre, length).numpy()[None],
                colors=(r, g, b),
                shaft_radius=0.012 * length * thickness,
                head_radius=0.035 * length * thickness,
                head_length=0.1 * length,
            )
            ring = uncertainty_ring_points(source, centre, length).numpy()
            scene.add_line_segments(f"/light/{index}/uncertainty", points=ring, colors=(r, g, b))
        if light.sources and self._dragged_light is None:
            index = min(self._index(), len(light.sources) - 1)
            tail = arrow_points(light.sources[index], centre, length)[0]
            if self._handle is None:
                self._handle = add_handle(self._context.server, "/light/handle", tail, size_px=_HANDLE_PX)
                self._handle.on_update(self._dragged)
            else:
                self._handle.position = tail.numpy()

    def _remove_handle(self) -> None:
        if self._handle is not None:
            self._handle.remove()
            self._handle = None

    def _hide_arrows(self, keep: int = 0) -> None:
        for index in range(keep, _MAX_SOURCES):
            for part in ("arrow", "uncertainty"):
                self._context.view.remove(f"/light/{index}/{part}")

    async def _dragged(self, event: viser.TransformControlsEvent) -> None:
        session, handle = self._context.session, self._handle
        if session is None or handle is None or event.phase == "start":
            return
        light = self._dragged_light or self._light(session)
        if light is None:
            return
        position = torch.tensor(np.asarray(handle.position), dtype=torch.float32)
        towards = position - self._centre_and_length(session)[0]
        self._move_light(session, with_direction(light, self._index(), towards), ended=event.phase == "end")


class SunClicks:
    """While active, two clicks set the sun: on what casts a shadow, then on the same point of its shadow."""

    def __init__(self, context: PageContext, light_of: Callable[[Session], Light | None]) -> None:
        """Start inactive; `light_of` gives the light whose sun is replaced."""
        self._context, self._light_of = context, light_of
        self._is_active = context.on(
            context.gui.add_checkbox(
                "Set the sun by two clicks",
                False,
                visible=False,
                hint="Click what casts a shadow in the scene, then the same point of its shadow",
            ),
            self._toggle,
        )
        self._points: tuple[Point, ...] = ()
        self._set_light: Light | None = None
        """The light when the last point was added; under another one, as after undo, pairs begin anew."""
        self._clicks = SceneClicks(context, self._add)

    def refresh(self, light: Light | None) -> None:
        """Take clicks while it is active and there is a light, and show the points."""
        self._is_active.visible = light is not None
        self._clicks.listen(self._is_active.value and light is not None)
        points, scene = self._kept() if self._clicks.is_listening else (), self._context.server.scene
        for name in ("points", "pairs"):
            self._context.view.remove(f"/light/{name}")
        if points:
            at, size = np.array(points, np.float32), 0.012 * self._context.scene_scale()
            scene.add_point_cloud("/light/points", at, _MARK, point_size=size, point_shape="circle")
            pairs = at[: len(at) // 2 * 2].reshape(-1, 2, 3)
            scene.add_line_segments("/light/pairs", points=pairs, colors=_MARK)

    def leave(self) -> None:
        """Take no more clicks, and hide the points."""
        self._is_active.value = False
        self.refresh(None)

    def _kept(self) -> tuple[Point, ...]:
        """The points that still hold."""
        return self._points if self._context.require_session().state.light is self._set_light else ()

    def _toggle(self) -> None:
        self._clicks.listen(self._is_active.value)
        if self._is_active.value:
            self._context.say("click what casts a shadow in the scene, such as the corner of a table")

    def _add(self, event: viser.SceneClickEvent) -> None:
        session, ray = self._context.require_session(), ray_from_viser(event)
        state, files = session.placed_state(), session.files
        scene = session.scenes.gaussians(files.target_scene)
        if state.erased is not None:
            scene = scene.select(~state.erased)
        hit = first_surface_hit(scene, ray.origin, ray.direction)
        if hit is None:
            raise ValueError("click: expected a surface of the scene under the pointer, found none")
        x, y, z = hit.tolist()
        points = (*self._kept(), (x, y, z))
        if len(points) % 2:
            self._points, self._set_light = points, session.state.light
            self._context.say("now click the same point of its shadow")
            return
        self._points, light = points[:-2], self._light_of(session)
        assert light is not None
        cameras, clock = session.scenes.cameras(files.target_cameras), session.scenes.target_clock()
        captured = CapturedScene(scene, cameras, clock)
        sun = set_sun(points, captured)
        session.change(replace(state, light=with_sun(light, sun)))
        self._points, self._set_light = points, session.state.light
        pairs = "one pair of points" if len(points) == 2 else f"{len(points) // 2} pairs of points"
        if sun.ratio is None:
            self._context.say(
                f"the sun by {pairs}; no edge of a shadow is seen there, so its strength is estimated; "
                "click another pair beside a clear shadow"
            )
            return
        moved_deg = math.degrees(math.acos(min(1.0, float(sun.direction @ direction_through(points, captured.up)[0]))))
        moved = f", moved {moved_deg:.0f}° to fit the shadows there" if moved_deg > 1 else ""
        self._context.say(f"the sun by {pairs}{moved}; its strength is as the shadow's edge shows")


def arrow_points(source: LightSource, centre: Float[Tensor, "3"], length: float) -> Float[Tensor, "2 3"]:
    """Tail and head of the arrow of a source: from `length` away towards `centre`, ending at 0.3 `length`."""
    direction = torch.tensor(source.direction)
    return torch.stack([centre + length * direction, centre + 0.3 * length * direction])


def uncertainty_ring_points(source: LightSource, centre: Float[Tensor, "3"], length: float) -> Float[Tensor, "s 2 3"]:
    """Line segments of a circle around the arrow's tail; its angular radius is the uncertainty of the direction."""
    direction = torch.tensor(source.direction)
    across, along = tangents(direction)
    radius = length * math.tan(math.radians(min(60.0, max(0.5, source.uncertainty_deg))))
    angle = torch.linspace(0, 2 * math.pi, _RING_SEGMENTS + 1)
    points = centre + length * direction + radius * (angle.cos()[:, None] * across + angle.sin()[:, None] * along)
    return torch.stack([points[:-1], points[1:]], 1)


def with_direction(light: Light, index: int, towards: Float[Tensor, "3"]) -> Light:
    """The light with one source's direction set by hand, hence without uncertainty."""
    length = float(towards.norm())
    if length < 1e-9:
        return light
    x, y, z = (towards / length).tolist()
    source = replace(light.sources[index], direction=(x, y, z), uncertainty_deg=0.0, confidence=1.0)
    return _with_source(light, index, source)


def _with_source(light: Light, index: int, source: LightSource) -> Light:
    return replace(light, sources=(*light.sources[:index], source, *light.sources[index + 1 :]))


def _missing_reason(session: Session) -> str:
    """Why there is no light to show."""
    state = session.placed_state()
    if not session.scenes.at_hand(session.scenes.base_files(session.objects())):
        return "The object is being read."
    if not session.files.transfers_light:
        return f"The physical light transfer is off: {session.relighting.light_mode_note()}."
    if not session.objects():
        return "No object is placed yet: see Place."
    if not session.relighting.is_relit(state):
        return "Estimating the light."
    return " ".join(one.text for one in session.relighting.relit(state).report)
