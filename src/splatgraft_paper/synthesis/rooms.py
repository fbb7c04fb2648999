"""Random furnished interiors: five kinds of room, lit by window, sun and lamps."""

import math
import random
from dataclasses import dataclass, replace
from typing import Literal

from splatgraft_paper.synthesis import furniture
from splatgraft_paper.synthesis.furniture import Parts, box, placed
from splatgraft_paper.synthesis.palette import Palette
from splatgraft_paper.synthesis.scene import Lamp, Material, Number, Part, Place, Scene, Vector, World, add, direction

Interior = Literal["living_room", "kitchen", "office", "bathroom", "bedroom"]
INTERIORS: tuple[Interior, ...] = ("living_room", "kitchen", "office", "bathroom", "bedroom")


@dataclass(frozen=True)
class _Shell:
    """Size of the room and position of its window, metres."""

    width: Number
    depth: Number
    height: Number
    window_center: Number
    """Along x, on the wall at +y."""
    window_width: Number
    sill: Number
    window_height: Number


class _FloorPlan:
    """The occupied rectangles of the floor."""

    def __init__(self, shell: _Shell):
        self._occupied: list[tuple[float, float, float, float]] = []
        self._shell = shell

    def occupy(self, x: Number, y: Number, width: Number, depth: Number, margin: Number = 0.05) -> bool:
        """Occupy a rectangle; False, and unchanged, where it is not free or leaves the room."""
        low_x, high_x, low_y, high_y = x - width / 2, x + width / 2, y - depth / 2, y + depth / 2
        half_w, half_d = self._shell.width / 2, self._shell.depth / 2
        if low_x < -half_w or high_x > half_w or low_y < -half_d or high_y > half_d:
            return False
        for a, b, c, d in self._occupied:
            if low_x - margin < b and high_x + margin > a and low_y - margin < d and high_y + margin > c:
                return False
        self._occupied.append((low_x, high_x, low_y, high_y))
        return True

    def boxes(self, first: Number, others: Number) -> tuple[tuple[Vector, Vector], ...]:
        """All occupied rectangles as boxes on the floor: the first one of height `first`, the others of `others`."""
        return tuple(((a, c, 0.0), (b, d, others if i else first)) for i, (a, b, c, d) in enumerate(self._occupied))


def _walls(rng: random.Random, palette: Palette, shell: _Shell, kind: str) -> Parts:
    wall, other = palette.wall(), palette.wall() if rng.random() < 0.35 else None
    w, d, h, t = shell.width, shell.depth, shell.height, 0.12
    left = shell.window_center - shell.window_width / 2 + w / 2
    right = w - left - shell.window_width
    top = h - shell.sill - shell.window_height
    y = d / 2 + t / 2
    far = [
        box((left, t, h), (-w / 2 + left / 2, y, h / 2), wall, 0),
        box((right, t, h), (w / 2 - right / 2, y, h / 2), wall, 0),
        box((shell.window_width, t, shell.sill), (shell.window_center, y, shell.sill / 2), wall, 0),
        box((shell.window_width, t, top), (shell.window_center, y, h - top / 2), wall, 0),
    ]
    frame_color = ((0.8, 0.8, 0.78), (0.2, 0.13, 0.08), (0.03, 0.03, 0.03))[rng.randrange(3)]
    frame = Material("plain", frame_color, frame_color, 0.35)
    middle = shell.sill + shell.window_height / 2
    bars = [
        box((0.05, 0.06, shell.window_height), (shell.window_center + s * shell.window_width / 2, y, middle), frame)
        for s in (-1, 0, 1)
    ]
    bars += [
        box((shell.window_width, 0.06, 0.05), (shell.window_center, y, middle + s * shell.window_height / 2), frame)
        for s in (-1, 1)
    ]
    ledge = box((shell.window_width + 0.1, 0.24, 0.03), (shell.window_center, d / 2 - 0.03, shell.sill), frame)
    skirting = palette.paint()
    return (
        box((w + 2 * t, d + 2 * t, 0.1), (0, 0, -0.05), palette.floor(kind), 0),
        box((w + 2 * t, d + 2 * t, 0.1), (0, 0, h + 0.05), palette.ceiling(), 0),
        box((t, d + 2 * t, h), (-w / 2 - t / 2, 0, h / 2), other or wall, 0),
        box((t, d + 2 * t, h), (w / 2 + t / 2, 0, h / 2), wall, 0),
        box((w, t, h), (0, -d / 2 - t / 2, h / 2), wall, 0),
        *far,
        *bars,
        ledge,
        box((w, 0.02, 0.08), (0, d / 2 - 0.01, 0.04), skirting),
        box((0.02, d, 0.08), (-w / 2 + 0.01, 0, 0.04), skirting),
        box((0.02, d, 0.08), (w / 2 - 0.01, 0, 0.04), skirting),
    )


def _centre(rng: random.Random, palette: Palette, kind: Interior) -> tuple[Parts, Place, tuple[float, float]]:
    """The support of the object near the middle of the room, its place, and its footprint."""
    if kind == "bedroom" and rng.random() < 0.5:
        rug = Part("box", (1.7, 1.3, 0.015), (0, 0, 0.008), palette.rug(), bevel=0.005)
        return (rug,), Place((0, 0, 0.016), 0.5, 1.6), (0.9, 0.9)
    if kind == "bathroom":
        stool = (
            Part("cylinder", (0.42, 0.42, 0.04), (0, 0, 0.43), palette.wood(), bevel=0.008),
            *furniture.legs(0.3, 0.3, 0.41, 0.035, palette.wood()),
        )
        return stool, Place((0, 0, 0.45), 0.16, 1.2), (0.5, 0.5)
    sizes = {
        "living_room": (rng.uniform(0.9, 1.3), rng.uniform(0.55, 0.8), rng.uniform(0.36, 0.48)),
        "kitchen": (rng.uniform(1.0, 1.6), rng.uniform(0.75, 0.95), rng.uniform(0.72, 0.92)),
        "office": (rng.uniform(1.2, 1.7), rng.uniform(0.65, 0.85), rng.uniform(0.7, 0.76)),
        "bedroom": (rng.uniform(0.7, 0.9), rng.uniform(0.5, 0.7), rng.uniform(0.4, 0.55)),
    }
    width, depth, height = sizes[kind]
    parts = furniture.table(rng, palette, width, depth, height)
    small = placed(furniture.tabletop(rng, palette, parts[0]), (0, 0, height), 0)
    return (*parts, *small), Place((0, 0, height), min(width, depth) * 0.3, 1.2), (width, depth)


def _against_walls(rng: random.Random, palette: Palette, kind: Interior, shell: _Shell, floor: _FloorPlan) -> Parts:
    main = {
        "living_room": [lambda: (furniture.sofa(rng, palette, rng.uniform(1.6, 2.3)), 2.3, 0.95)],
        "kitchen": [lambda: (furniture.counter(rng, palette, 2.2), 2.25, 0.68)],
        "office": [lambda: (furniture.shelf(rng, palette, 1.1), 1.15, 0.4)],
        "bathroom": [
            lambda: (furniture.bathtub(rng, palette), 1.75, 0.8),
            lambda: (furniture.basin(rng, palette), 0.95, 0.55),
        ],
        "bedroom": [lambda: (furniture.bed(rng, palette), 1.6, 2.15)],
    }
    others = [
        lambda: (furniture.shelf(rng, palette, rng.uniform(0.6, 1.1), rng.uniform(0.9, 2.0)), 1.15, 0.4),
        lambda: (furniture.cabinet(rng, palette, rng.uniform(0.6, 1.4), rng.uniform(0.5, 1.1)), 1.45, 0.55),
        lambda: (furniture.plant(rng, palette, rng.uniform(0.6, 1.3)), 0.6, 0.6),
        lambda: (furniture.chair(rng, palette), 0.5, 0.5),
        lambda: (furniture.cabinet(rng, palette, 0.5, 0.5, 0.4), 0.55, 0.5),
    ]
    parts: list[Part] = []
    makers = main[kind] + [rng.choice(others) for _ in range(rng.randint(3, 6))]
    for make in makers:
        made, wide, deep = make()
        for _ in range(12):
            side = rng.choice(["left", "right", "near", "far"])
            yaw = {"far": 0.0, "near": math.pi, "left": math.pi / 2, "right": -math.pi / 2}[side]
            along, across = (wide, deep) if side in ("far", "near") else (deep, wide)
            x = rng.uniform(-1, 1) * (shell.width - along) / 2
            y = rng.uniform(-1, 1) * (shell.depth - across) / 2
            gap = 0.03
            if side in ("far", "near"):
                y = (1 if side == "far" else -1) * ((shell.depth - across) / 2 - gap)
            else:
                x = (1 if side == "right" else -1) * ((shell.width - along) / 2 - gap)
            if floor.occupy(x, y, along, across):
                parts += placed(made, (x, y, 0), yaw)
                break
    return tuple(parts)


def _daylight(rng: random.Random, shell: _Shell, notes: dict[str, str]) -> tuple[tuple[Lamp, ...], World]:
    """Sky and possibly sun through the window with an area light in front of it; in the evening only a dark sky."""
    middle = (shell.window_center, shell.depth / 2 + 0.25, shell.sill + shell.window_height / 2)
    mood = rng.choice(["sun", "sun", "sun", "overcast", "evening"])
    lamps: list[Lamp] = []
    area = shell.window_width * shell.window_height
    if mood == "evening":
        world = World("color", color=(0.02, 0.03, 0.06), strength=1.0)
    else:
        blue = rng.uniform(0.0, 0.35)
        sky = (0.9 - 0.5 * blue, 0.95 - 0.2 * blue, 1.0)
        strength = rng.uniform(60, 130)
        world = World("color", color=sky, strength=2.2)
        lamps.append(
            Lamp("area", sky, strength * area, middle, (0, -1, -0.15), shell.window_width, shell.window_height)
        )
    if mood == "sun":
        elevation, turn = rng.uniform(0.35, 0.85), rng.uniform(-0.7, 0.7)
        towards = direction(math.pi / 2 + turn, elevation)
        warm = rng.uniform(0.6, 0.95)
        power = rng.uniform(6, 16)
        lamps.append(
            Lamp(
                "sun",
                (1.0, warm**0.5, warm),
                power,
                (0, 0, 5),
                (-towards[0], -towards[1], -towards[2]),
                size=rng.uniform(0.009, 0.03),
            )
        )
        notes["sun_direction"] = " ".join(f"{c:.5f}" for c in towards)
        notes["sun_power"] = f"{power:.3f}"
    notes["mood"] = mood
    return tuple(lamps), world


def interior(seed: int, kind: Interior) -> Scene:
    """Make a furnished room; the same seed and kind give the same room."""
    rng = random.Random(f"{kind}-{seed}")
    palette = Palette(rng)
    wide, deep = (
        (rng.uniform(2.6, 3.2), rng.uniform(2.8, 3.4))
        if kind == "bathroom"
        else (rng.uniform(3.8, 5.4), rng.uniform(4.0, 5.6))
    )
    window = rng.uniform(1.1, min(2.4, wide - 1.2))
    height = rng.uniform(2.4, 2.9)
    sill = rng.uniform(0.4, 0.95)
    shell = _Shell(
        width=wide,
        depth=deep,
        height=height,
        window_center=rng.uniform(-0.5, 0.5) * (wide - window - 0.4),
        window_width=window,
        sill=sill,
        window_height=rng.uniform(1.0, height - sill - 0.25),
    )
    notes: dict[str, str] = {}
    floor = _FloorPlan(shell)
    centre_parts, place, footprint = _centre(rng, palette, kind)
    yaw = rng.choice([0.0, math.pi / 2]) + rng.gauss(0, 0.08)
    offset = (rng.uniform(-0.3, 0.3), rng.uniform(-0.4, 0.4), 0.0)
    reach = max(footprint)
    floor.occupy(offset[0], offset[1], reach, reach)
    parts = [*_walls(rng, palette, shell, kind), *placed(centre_parts, offset, yaw)]
    if kind in ("living_room", "bedroom") and rng.random() < 0.7 and place.location[2] > 0.1:
        size = (rng.uniform(1.6, 2.4), rng.uniform(1.3, 1.9), 0.014)
        parts.append(Part("box", size, (offset[0], offset[1], 0.007), palette.rug(), (0, 0, yaw), bevel=0.004))
    parts += _against_walls(rng, palette, kind, shell, floor)
    lamps, world = _daylight(rng, shell, notes)
    all_lamps = list(lamps)
    if notes["mood"] == "evening" or rng.random() < 0.35:
        made, lamp = furniture.floor_lamp(rng, palette)
        corner = (rng.choice([-1, 1]) * (shell.width / 2 - 0.4), -shell.depth / 2 + 0.45, 0.0)
        if floor.occupy(corner[0], corner[1], 0.4, 0.4):
            parts += placed(made, corner, 0)
            all_lamps.append(replace(lamp, location=add(lamp.location, corner)))
    if notes["mood"] == "evening":
        spot = (rng.uniform(-0.8, 0.8), rng.uniform(-0.8, 0.8), shell.height - 0.06)
        warm = (1.0, 0.82, 0.62)
        shade = Material("plain", warm, warm, 0.6, emission=4.0)
        parts.append(Part("cylinder", (0.34, 0.34, 0.06), (spot[0], spot[1], shell.height - 0.03), shade))
        all_lamps.append(
            Lamp("area", warm, rng.uniform(45, 90), (spot[0], spot[1], shell.height - 0.08), (0, 0, -1), 0.32, 0.32)
        )
        notes["lamp_location"] = " ".join(f"{c:.3f}" for c in spot)
    for _ in range(rng.randint(1, 4)):
        side = rng.choice([-1, 1])
        place_y = rng.uniform(-0.35, 0.35) * shell.depth
        parts += placed(
            furniture.picture(rng, palette),
            (side * (shell.width / 2 - 0.02), place_y, rng.uniform(1.45, 1.75)),
            -side * math.pi / 2,
        )
    location = add(place.location, offset)
    return Scene(
        name=f"{kind}_{seed:04d}",
        kind=kind,
        parts=tuple(parts),
        lamps=tuple(all_lamps),
        world=world,
        places=(replace(place, location=location),),
        bounds=(
            (-shell.width / 2 + 0.25, -shell.depth / 2 + 0.25, 0.35),
            (shell.width / 2 - 0.25, shell.depth / 2 - 0.25, shell.height - 0.3),
        ),
        obstacles=floor.boxes(location[2] + 0.06, 2.0),
        notes=notes,
    )
