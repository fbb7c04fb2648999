"""Many lights from one render: light adds, so that pictures by lamp are summed with other strengths and tints."""

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.images import srgb_from_linear
from splatgraft.synthesis.scene import Lamp, Material, Part, Scene, direction

_MID_GREY, _BRIGHTEST, _BRIGHT_SHARE = 0.22, 1.3, 0.97
"""As the renderer exposes: the geometric mean of luminance after exposure, and the most that this quantile may have."""
_LUMINANCE = torch.tensor([0.2126, 0.7152, 0.0722])
_EXPOSURE_SD = 0.4
"""Stops; how far cameras expose otherwise."""
_STRENGTH_SD = {"world": 0.7, "sun": 1.2}
"""Stops; of the strength of a light over what was drawn with the scene."""
_LAMP_SD = 1.5
"""The same of lamps."""
_TINT_SD = 0.2
"""Stops per channel; of each light, and of the camera's white balance half as much."""
_DARK = 2.0**-6
"""Strength of the daylight in the evening."""


@dataclass(frozen=True)
class GroupLight:
    """The light around a place by light group, linear, at the exposure of the pictures."""

    panorama: Float[Tensor, "g h w 3"]
    suns: tuple[dict[str, Any], ...]
    """Entries of suns.json; `group` names the light group."""


def with_more_lamps(scene: Scene, rng: random.Random) -> Scene:
    """Add a sun where a scene has none and no sky with one, and to rooms and pedestals a lamp.

    Args:
        scene: A room, a place outdoors or a pedestal.
        rng: Is advanced.
    """
    lamps, parts = list(scene.lamps), list(scene.parts)
    is_room = scene.kind not in ("garden", "terrace", "square", "stage")
    if scene.world.kind != "sky" and scene.notes.get("mood") not in ("sun", "evening"):
        # a room's window is in its wall towards +y
        azimuth = math.pi / 2 + rng.uniform(-0.7, 0.7) if is_room else rng.uniform(0, 2 * math.pi)
        towards = direction(azimuth, rng.uniform(0.35, 0.85 if is_room else 1.2))
        warm = rng.uniform(0.6, 0.95)
        away = (-towards[0], -towards[1], -towards[2])
        lamps.append(Lamp("sun", (1.0, warm**0.5, warm), rng.uniform(3, 14), (0, 0, 5), away, rng.uniform(0.009, 0.03)))
    warm = (1.0, rng.uniform(0.7, 0.95), rng.uniform(0.45, 0.9))
    if is_room and scene.notes.get("mood") != "evening":
        x, y, z = rng.uniform(-0.9, 0.9), rng.uniform(-0.9, 0.9), scene.bounds[1][2] + 0.2
        shade = Material("plain", warm, warm, 0.6, emission=4.0)
        parts.append(Part("cylinder", (0.34, 0.34, 0.06), (x, y, z + 0.03), shade))
        lamps.append(Lamp("area", warm, rng.uniform(45, 90), (x, y, z - 0.02), (0, 0, -1), 0.32, 0.32))
    if scene.kind == "stage":
        # outside of the cameras' positions, towards the object
        x, y, z = scene.places[0].location
        turn, far, high = rng.uniform(0, 2 * math.pi), rng.uniform(3.3, 5.0), rng.uniform(0.5, 4.0)
        location = (x + far * math.cos(turn), y + far * math.sin(turn), z + high)
        towards_object = (x - location[0], y - location[1], z - location[2])
        side = rng.uniform(0.3, 1.5)
        lamps.append(
            Lamp("area", warm, rng.uniform(150, 600), location, towards_object, side, side * rng.uniform(1, 2))
        )
    return replace(scene, lamps=tuple(lamps), parts=tuple(parts))


def draw_gains(scene: Scene, rng: random.Random) -> Float[Tensor, "g 3"]:
    """Draw what each light group is multiplied by: the world, then the lamps in the scene's order.

    By day there is daylight, a sun in half of the cases, and some lamps are on; else it is evening, and lamps are on.
    """
    kinds = ["world", *(_kind(lamp) for lamp in scene.lamps)]
    lamps = [i for i, kind in enumerate(kinds) if kind == "lamp"]
    evening = bool(lamps) and rng.random() < 0.25
    on = {i for i in lamps if rng.random() < (0.7 if evening else 0.35)}
    if evening and not on:
        on = {rng.choice(lamps)}
    sun = rng.random() < 0.5
    day = 2 ** rng.gauss(0, _STRENGTH_SD["world"]) * (_DARK if evening else 1.0)
    rows = []
    for i, kind in enumerate(kinds):
        strength = {
            "world": day,
            "sun": 2 ** rng.gauss(0, _STRENGTH_SD["sun"]) if sun and not evening else 0.0,
            "lamp": 2 ** rng.gauss(0, _LAMP_SD) if i in on else 0.0,
        }[kind]
        rows.append([strength * 2 ** rng.gauss(0, _TINT_SD) for _ in range(3)])
    return torch.tensor(rows)


def _kind(lamp: Lamp) -> str:
    if lamp.kind == "sun":
        return "sun"
    # the window of a room is an area lamp that shines in from +y
    return "world" if lamp.kind == "area" and lamp.direction[1] < -0.9 else "lamp"


def exposed(gains: Float[Tensor, "g 3"], pictures: Sequence[Float[Tensor, "g h w 3"]], rng: random.Random) -> Tensor:
    """The gains at an exposure and a white balance as a camera might choose them.

    Args:
        gains: Of the light groups.
        pictures: Linear light by group, of some views.
        rng: Is advanced.
    """
    levels = []
    for picture in pictures:
        luminance = mix(gains, picture) @ _LUMINANCE
        levels.append([float((luminance + 1e-4).log().mean().exp()), float(luminance.quantile(_BRIGHT_SHARE))])
    mean, high = torch.tensor(levels).mean(0).tolist()
    exposure = min(_MID_GREY / max(mean, 1e-4), _BRIGHTEST / max(high, 1e-4)) * 2 ** rng.gauss(0, _EXPOSURE_SD)
    balance = torch.tensor([2 ** rng.gauss(0, 0.5 * _TINT_SD) for _ in range(3)])
    return gains * exposure * balance


def mix(gains: Float[Tensor, "g 3"], groups: Float[Tensor, "g h w 3"]) -> Float[Tensor, "h w 3"]:
    """The linear sum."""
    return torch.einsum("gc,ghwc->hwc", gains, groups.float())


def mixed_picture(gains: Float[Tensor, "g 3"], groups: Float[Tensor, "g h w 3"]) -> Float[Tensor, "h w 3"]:
    """As a camera records it: sRGB, clipped, of 8 bits."""
    return (srgb_from_linear(mix(gains, groups).clamp(0, 1)) * 255).round() / 255


def mixed_light(
    gains: Float[Tensor, "g 3"], light: GroupLight, names: Sequence[str]
) -> tuple[Float[Tensor, "h w 3"], list[dict[str, Any]]]:
    """The panorama and the suns of a mixture.

    Args:
        gains: Of the light groups.
        light: By group.
        names: Of the groups.
    """
    suns = []
    for sun in light.suns:
        gain = gains[list(names).index(sun["group"])]
        if float(gain.max()) > 0:
            irradiance = (torch.tensor(sun["irradiance"]) * gain).tolist()
            suns.append({**sun, "irradiance": irradiance})
    return mix(gains, light.panorama), suns
