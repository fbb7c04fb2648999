"""The step `Light`: drag lights on a picture of the sky or in the view, set a sun by two clicks, set strengths."""

import base64
import html
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.editor.drag import Corner, on_canvas
from splatgraft.editor.form import Form
from splatgraft.editor.panel import Panel, Pointer
from splatgraft.editor.stream import View
from splatgraft.relighting import Light, LightSource
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.light.sun import Point, direction_through, set_sun, with_sun

_FIRST = (
    ("exposure", "Brightness", (-2.0, 2.0), "Of the object, in stops; 0 is as computed"),
    ("warmth", "Warmth", (-2.0, 2.0), "Of the object's colours; 0 is as computed"),
    ("shadow", "Shadow strength", (0.0, 2.0), "1 is as computed"),
)
_LAYERS = (
    ("shade", "Light and dark sides", (0.0, 2.0), "Of the object; 1 is as computed"),
    ("tint", "Colour of the light", (0.0, 4.0), "Change of the object's colour by the new light; 1 is as computed"),
    ("bounce", "Light onto the place", (0.0, 2.0), "That the object reflects onto its surroundings; 1 is as computed"),
    ("gloss", "Reflections", (0.0, 2.0), "On the object; 1 is as computed"),
)
"""Fields of `LayerWeights`, with label, ends of the slider and hint."""
_SOFTNESS = (0.3, 30.0)  # degrees; the sun's is 0.27
_MAX_SOURCES = 4
_UNSEEN = 0.5  # share of unphotographed directions overhead above which the panel warns
_MARK = "#ffc83c"

_RADIUS, _SIDE = 90.0, 100.0
"""Radius of the horizon, and half the side of the picture."""
_SKY_PIXELS = 64
"""Side of the picture of the ambient light."""
_LOWEST, _HIGH = 25.0, 55.0
"""Degrees above the horizon below which a light is low, and above which it is high."""


class LightPanel(Panel):
    """Controls of the light, and the lights in the view."""

    _chosen, _sets_sun = 0, False
    _points: tuple[Point, ...] = ()
    _set_light: Light | None = None
    """Light when the last point was added; if it was replaced, for example by undo, pairs begin anew."""
    _full: tuple[tuple[float, float, float], ...] = ()
    """Irradiance of each source at a strength of 1, before the slider changed it."""
    _scaled: tuple[LightSource, ...] | None = None
    """Sources after the last change by the slider."""
    _dome: "SkyDome | None" = None
    """Orientation of the picture of the sky."""
    _handle: tuple[int, Corner] | None = None

    def leave(self) -> None:
        """End drags and clicks for the sun."""
        self._sets_sun, self._handle = False, None

    def build(self, form: Form) -> None:
        """Add the controls of the light and its strengths."""
        session, light = self.session, self._light()
        if light is None:
            form.note(self._missing(), name="light")
        else:
            hint = "On what casts a shadow, then on the same point of its shadow"
            form.check("sun", "Set the sun by two clicks", self._sets_sun, self._toggle_sun, hint=hint)
            self._build_sky(form, light)
        self._build_weights(form, _FIRST)
        if light is not None and light.sources:
            softness = round(min(_SOFTNESS[1], max(_SOFTNESS[0], light.sources[self._chosen].angular_radius_deg)), 1)
            hint = "Degrees that the chosen light seems wide"
            form.slider("softness", "Shadow softness", softness, (*_SOFTNESS, 0.1), self._soften, hint=hint)
        is_set, forget = session.state.light is not None, lambda: session.change(replace(session.state, light=None))
        form.button("estimate", "Back to the estimate", forget, disabled=not is_set)
        form.more()
        if light is not None and light.sources:
            self._build_sources(form, light)
        self._build_weights(form, _LAYERS)

    def _build_sky(self, form: Form, light: Light) -> None:
        session = self.session
        view = self.editor.editing()
        orbit = None if view is None else self.editor.orbit(view)
        ahead = torch.tensor([0.0, 1.0, 0.0]) if orbit is None else torch.tensor(orbit.forward).float()
        dome = self._dome = SkyDome.seen_along(ahead, session.up())
        form.drawing("sky", dome.svg(light), self._drag_on_sky)
        named = [f"{s.name.partition(' set by hand')[0]} {dome.words(s)}" for s in light.sources[:_MAX_SOURCES]]
        by = "Estimated" if session.state.light is None else "Set by hand"
        found = "; ".join(named) if named else "even light without a clear source"
        doubt = " Nobody photographed the ceiling: light from above is a guess." if light.unseen_up > _UNSEEN else ""
        form.note(f"{by}: {found}.{doubt}", name="light")

    def _build_sources(self, form: Form, light: Light) -> None:
        numbers = {f"{i + 1}: {source.name}": i for i, source in enumerate(light.sources)}
        form.choice("source", "Light", self._chosen, numbers, self._sets("_chosen"))
        if light.sources != self._scaled:
            self._full, self._scaled = tuple(source.irradiance for source in light.sources), light.sources
        now, full = max(light.sources[self._chosen].irradiance), max(self._full[self._chosen])
        strength = min(3.0, round(now / full, 2)) if full > 0 else 1.0
        form.slider("strength", "Strength", strength, (0.0, 3.0, 0.05), self._scale)

    def _build_weights(self, form: Form, layers: Sequence[tuple[str, str, tuple[float, float], str]]) -> None:
        """Add the sliders of layers' weights."""
        for name, label, ends, hint in layers:
            weight = getattr(self.session.state.weights, name)
            form.slider(name, label, weight, (*ends, 0.05), partial(self._set_weight, name), hint=hint)
            form.while_dragged(name, partial(self._show_weight, name))

    def _light(self) -> Light | None:
        """Return the light of a drag, the light set by hand, or the last estimate."""
        session = self.session
        if not session.objects() or not session.files.transfers_light:
            return None
        state = self.editor.shown_state()
        relit = self.session.pictures.lit.relit(state)
        light = state.light if state.light is not None or relit is None else relit.light
        self._chosen = 0 if light is None else min(self._chosen, max(0, len(light.sources) - 1))
        return light

    def _missing(self) -> str:
        """Return the reason why no light is shown."""
        session = self.session
        if not session.files.transfers_light:
            return "The light transfer is off in project.toml: the object is shown as it was captured."
        if not session.objects():
            return "No object is placed yet: see Place."
        relit = self.session.pictures.lit.relit(session.placed_state())
        return "Estimating the light." if relit is None else " ".join(one.text for one in relit.report)

    # strengths

    def _show_weight(self, name: str, value: float) -> None:
        weights = replace(self.session.state.weights, **{name: float(value)})
        self.editor.show_live(replace(self.session.placed_state(), weights=weights))

    def _set_weight(self, name: str, value: float) -> None:
        session = self.session
        session.change(replace(session.state, weights=replace(session.state.weights, **{name: float(value)})))

    def _soften(self, value: float) -> None:
        self._change(angular_radius_deg=float(value), uncertainty_deg=0.0)

    def _scale(self, value: float) -> None:
        r, g, b = (float(value) * part for part in self._full[self._chosen])
        self._change(irradiance=(r, g, b))

    def _change(self, **fields: Any) -> None:
        """Change fields of the chosen source; strengths stay relative to `_full`."""
        light = self._light()
        if light is not None and light.sources:
            edited = with_source(light, self._chosen, replace(light.sources[self._chosen], **fields))
            self._scaled = edited.sources
            self._set(edited)

    def _set(self, light: Light, *, live: bool = False) -> None:
        """Save a light in one undo step, or only show it during a drag."""
        edited = replace(self.session.placed_state(), light=light)
        if live:
            self.editor.show_live(edited)
        else:
            self.editor.live = None
            self.session.change(edited)

    # directions

    def _drag_on_sky(self, given: tuple[int, float, float, bool]) -> None:
        """Move a light on the picture of the sky, to x and y in units of the horizon's radius."""
        index, x, y, is_end = given
        light, dome = self._light(), self._dome
        if dome is None or light is None or not 0 <= index < len(light.sources):
            raise ValueError("There is no such light.")
        self._chosen = index
        self._set(with_direction(light, index, dome.direction(x, y)), live=not is_end)

    def overlay(self, view: View, camera: Cameras) -> dict[str, Any]:
        """Describe the arrows of the lights and the points that set the sun."""
        light = self._light()
        if light is None or self.editor.kind != "lit":
            return {}
        centre, length = self._centre_and_length()
        lines, dots = [], []
        for index, source in enumerate(light.sources[:_MAX_SOURCES]):
            color = color_of(source)
            tail, head = on_canvas(arrow_points(source, centre, length), camera)
            if tail is not None and head is not None:
                width = 6 if index == self._chosen else 3
                lines.append({"points": [tail, head], "color": color, "width": width, "arrow": True})
                dots.append({"at": tail, "color": color, "id": f"light:{index}"})
        if self._sets_sun:
            at = on_canvas(torch.tensor(self._kept()).reshape(-1, 3), camera)
            dots += [{"at": point, "color": _MARK} for point in at if point is not None]
            lines += [{"points": [a, b], "color": _MARK} for a, b in zip(at[::2], at[1::2], strict=False) if a and b]
        return {"lines": lines, "dots": dots}

    def _centre_and_length(self) -> tuple[Float[Tensor, "3"], float]:
        """Return the arrows' target, and the distance of their tails from it."""
        base, placed = self.session.placeable_object(0).base, self.session.objects()[0].target_from_object
        length = 3.0 * placed.scale * max(base.height, base.radius)
        return placed.points(base.point + 0.5 * base.height * base.up), length

    def pointer(self, view: View, pointer: Pointer) -> None:
        """Drag an arrow's tail, or set the sun."""
        if pointer.on.startswith("light:") and pointer.what == "down":
            index, light = int(pointer.on.removeprefix("light:")), self._light()
            if light is not None and 0 <= index < len(light.sources):
                self._chosen = index
                tail = arrow_points(light.sources[index], *self._centre_and_length())[0]
                self._handle = (index, Corner(tail, self.camera(view)))
        elif self._handle is not None and pointer.what in ("move", "up", "cancel"):
            (index, corner), light = self._handle, self._light()
            if pointer.what != "move":
                self._handle = None
            if pointer.what == "cancel" or light is None:
                self.editor.show_live(None)
            else:
                towards = corner.at(pointer.place) - self._centre_and_length()[0]
                self._set(with_direction(light, index, towards), live=pointer.what != "up")
        elif pointer.what == "click" and self._sets_sun:
            self._add_point(view, pointer)

    def key(self, view: View, key: str) -> bool:
        """End the clicks for the sun on Escape."""
        if key == "escape":
            self._sets_sun = False
        return key == "escape"

    # the sun by two clicks

    def _kept(self) -> tuple[Point, ...]:
        """Return the points set under the current light."""
        return self._points if self.session.state.light is self._set_light else ()

    def _toggle_sun(self, value: bool) -> None:
        self._sets_sun = value
        if value:
            self.editor.say("click what casts a shadow in the scene, such as the corner of a table")

    def _add_point(self, view: View, pointer: Pointer) -> None:
        session, state = self.session, self.session.placed_state()
        scene = self.session.pictures.lit.place(state)
        x, y, z = self.surface_under(pointer, view, scene)[0].tolist()
        points = (*self._kept(), (x, y, z))
        if len(points) % 2:
            self._points, self._set_light = points, session.state.light
            self.editor.say("now click the same point of its shadow")
            return
        self._points, light = points[:-2], self._light()
        if light is None:
            raise ValueError(self._missing())
        cameras = session.scenes.cameras("target")
        captured = CapturedScene(scene, cameras, session.scenes.target_clock())
        sun = set_sun(points, captured)
        session.change(replace(state, light=with_sun(light, sun)))
        self._points, self._set_light = points, session.state.light
        pairs = "one pair of points" if len(points) == 2 else f"{len(points) // 2} pairs of points"
        if sun.ratio is None:
            self.editor.say(
                f"the sun by {pairs}; no edge of a shadow is seen there, so its strength is estimated; "
                "click another pair beside a clear shadow"
            )
            return
        moved_deg = math.degrees(math.acos(min(1.0, float(sun.direction @ direction_through(points, captured.up)[0]))))
        moved = f", moved {moved_deg:.0f}° to fit the shadows there" if moved_deg > 1 else ""
        self.editor.say(f"the sun by {pairs}{moved}; its strength is as the shadow's edge shows")


def arrow_points(source: LightSource, centre: Float[Tensor, "3"], length: float) -> Float[Tensor, "2 3"]:
    """Return tail and head of a source's arrow, at distances `length` and 0.3 `length` from `centre`."""
    direction = torch.tensor(source.direction)
    return torch.stack([centre + length * direction, centre + 0.3 * length * direction])


def with_direction(light: Light, index: int, towards: Float[Tensor, "3"]) -> Light:
    """Set one source's direction by hand, which removes its uncertainty and measured blockers."""
    length = float(towards.norm())
    if length < 1e-9:
        return light
    x, y, z = (towards / length).tolist()
    moved = {"direction": (x, y, z), "uncertainty_deg": 0.0, "confidence": 1.0, "blockers_within": math.inf}
    source = replace(light.sources[index], **moved)
    return with_source(light, index, source)


def with_source(light: Light, index: int, source: LightSource) -> Light:
    """Return the light with one source replaced."""
    return replace(light, sources=(*light.sources[:index], source, *light.sources[index + 1 :]))


@dataclass(frozen=True)
class SkyDome:
    """A picture of the sky seen from below: the middle is overhead, the rim is the horizon.

    The lower end is the viewer's side, so that a light there comes from behind the camera.
    """

    up: Float[Tensor, "3"]
    """Unit up direction of the world."""
    forward: Float[Tensor, "3"]
    """Unit direction of view at a right angle to `up`; it is the picture's upper end."""

    @staticmethod
    def seen_along(direction: Float[Tensor, "3"], up: Float[Tensor, "3"]) -> "SkyDome":
        """Return the picture for a viewer who looks along a direction."""
        level = direction - (direction @ up) * up
        if float(level.norm()) < 1e-6:
            level = torch.eye(3)[int(up.abs().argmin())]
            level = level - (level @ up) * up
        return SkyDome(up, torch.nn.functional.normalize(level, dim=0))

    @property
    def right(self) -> Float[Tensor, "3"]:
        """Unit direction of the picture's right."""
        return torch.linalg.cross(self.forward, self.up)

    def point(self, direction: Float[Tensor, "3"]) -> tuple[float, float]:
        """Project a direction to right and down in the picture, over the horizon's radius, at most 1."""
        height = math.asin(max(-1.0, min(1.0, float(direction @ self.up))))
        radius = min(1.0, (math.pi / 2 - height) / (math.pi / 2))
        x, y = float(direction @ self.right), -float(direction @ self.forward)
        length = max(math.hypot(x, y), 1e-9)
        return radius * x / length, radius * y / length

    def direction(self, x: float, y: float) -> Float[Tensor, "3"]:
        """Return the unit direction of a point of the picture, not below the horizon."""
        return self._directions(torch.tensor([[x, y]]))[0]

    def words(self, source: LightSource) -> str:
        """Describe a light's direction, such as 'from the left, high'."""
        direction = torch.tensor(source.direction)
        height = math.degrees(math.asin(max(-1.0, min(1.0, float(direction @ self.up)))))
        x, y = self.point(direction)
        sides = ("from behind you" if y > 0 else "from the back", "from the right" if x > 0 else "from the left")
        side = sides[abs(x) > abs(y)]
        if height > 80:
            return "from overhead"
        return f"{side}, {'low' if height < _LOWEST else 'half high' if height < _HIGH else 'high'}"

    def svg(self, light: Light) -> str:
        """Draw the picture as SVG; sources are dots sized by their share, with numbers as `data-source`."""
        dots = []
        for index, source in enumerate(light.sources):
            x, y = (_RADIUS * value for value in self.point(torch.tensor(source.direction)))
            # share of the light on a surface that faces the source, as in `describe_light`
            share = sum(source.irradiance) / float(light.irradiance(torch.tensor(source.direction)[None]).sum())
            dots.append(
                f'<circle class="light" data-source="{index}" cx="{x:.1f}" cy="{y:.1f}" '
                f'r="{5 + 16 * math.sqrt(share):.1f}" fill="{color_of(source)}" stroke="#222" stroke-width="2">'
                f"<title>{html.escape(source.name)}, {self.words(source)}</title></circle>"
            )
        return (
            f'<svg class="dome" viewBox="{-_SIDE} {-_SIDE} {2 * _SIDE} {2 * _SIDE}" '
            'xmlns="http://www.w3.org/2000/svg"><defs><clipPath id="sky-clip">'
            f'<circle r="{_RADIUS}"/></clipPath></defs><image href="{self._ambient(light)}" x="{-_RADIUS}" '
            f'y="{-_RADIUS}" width="{2 * _RADIUS}" height="{2 * _RADIUS}" clip-path="url(#sky-clip)"/>'
            f'<circle r="{_RADIUS}" fill="none" stroke="#888"/><circle r="{_RADIUS / 2}" fill="none" stroke="#8886"/>'
            f'{"".join(dots)}<text y="-92">far side</text><text y="99">you</text></svg>'
        )

    def _directions(self, points: Float[Tensor, "n 2"]) -> Float[Tensor, "n 3"]:
        radius = points.norm(dim=1, keepdim=True)
        height = math.pi / 2 * (1 - radius.clamp_max(1))
        level = (points[:, :1] * self.right - points[:, 1:] * self.forward) / radius.clamp_min(1e-9)
        return height.sin() * self.up + height.cos() * level

    def _ambient(self, light: Light) -> str:
        """Encode the ambient light of the upper half as a data URL, relative to its maximum."""
        axis = (torch.arange(_SKY_PIXELS) + 0.5) / _SKY_PIXELS * 2 - 1
        y, x = torch.meshgrid(axis, axis, indexing="ij")
        radiance = light.ambient_radiance(self._directions(torch.stack([x.ravel(), y.ravel()], 1)))
        picture = (radiance / radiance.max().clamp_min(1e-9)) ** (1 / 2.2) * 0.8
        pixels = (255 * picture.reshape(_SKY_PIXELS, _SKY_PIXELS, 3)).round().byte().numpy()
        encoded = cv2.imencode(".png", np.ascontiguousarray(pixels[..., ::-1]))[1]
        return f"data:image/png;base64,{base64.b64encode(encoded.tobytes()).decode()}"


def color_of(source: LightSource) -> str:
    """Return a light's colour at full brightness, in CSS."""
    peak = max(*source.irradiance, 1e-9)
    r, g, b = (round(255 * max(0.0, value / peak) ** (1 / 2.2)) for value in source.irradiance)
    return f"rgb({r},{g},{b})"
