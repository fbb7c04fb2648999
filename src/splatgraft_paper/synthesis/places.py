"""Random places: five kinds of furnished rooms, lit by window, sun and lamps, and three outdoors, by sky or map."""

import math
import random
from dataclasses import dataclass, replace
from typing import Literal

from splatgraft_paper.synthesis import furniture
from splatgraft_paper.synthesis.furniture import Palette, Parts, box, linear, placed, tone
from splatgraft_paper.synthesis.scene import (
    Color,
    Lamp,
    Material,
    Number,
    Part,
    Place,
    Scene,
    Vector,
    World,
    add,
    direction,
)

Interior = Literal["living_room", "kitchen", "office", "bathroom", "bedroom"]
INTERIORS: tuple[Interior, ...] = ("living_room", "kitchen", "office", "bathroom", "bedroom")


@dataclass(frozen=True)
class _Shell:
    """Size of the room and position of its window, metres."""

    width: Number
    depth: Number
    height: Number
    window_center: Number
    """Centre along x, on the wall at +y."""
    window_width: Number
    sill: Number
    window_height: Number


class _FloorPlan:
    """Occupied rectangles of the floor."""

    def __init__(self, shell: _Shell):
        self._occupied: list[tuple[float, float, float, float]] = []
        self._shell = shell

    def occupy(self, x: Number, y: Number, width: Number, depth: Number, margin: Number = 0.05) -> bool:
        """Occupy a rectangle; return False, unchanged, if it is not free or leaves the room."""
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
        """Extend all occupied rectangles to boxes on the floor: the first of height `first`, the others of `others`."""
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
    center, wide, high = shell.window_center, shell.window_width, shell.window_height
    middle = shell.sill + high / 2
    bars = [box((0.05, 0.06, high), (center + s * wide / 2, y, middle), frame) for s in (-1, 0, 1)]
    bars += [box((wide, 0.06, 0.05), (center, y, middle + s * high / 2), frame) for s in (-1, 1)]
    ledge = box((wide + 0.1, 0.24, 0.03), (center, d / 2 - 0.03, shell.sill), frame)
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
    """Make the object's support near the middle of the room, and return its parts, place and footprint."""
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


def _daylight(rng: random.Random, shell: _Shell, notes: dict[str, str]) -> tuple[list[Lamp], World]:
    """Draw daylight: an area light before the window and possibly sun, or only a dark sky in the evening."""
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
        size = (shell.window_width, shell.window_height)
        lamps.append(Lamp("area", sky, strength * area, middle, (0, -1, -0.15), *size))
    if mood == "sun":
        elevation, turn = rng.uniform(0.35, 0.85), rng.uniform(-0.7, 0.7)
        x, y, z = towards = direction(math.pi / 2 + turn, elevation)
        warm, power, size = rng.uniform(0.6, 0.95), rng.uniform(6, 16), rng.uniform(0.009, 0.03)
        lamps.append(Lamp("sun", (1.0, warm**0.5, warm), power, (0, 0, 5), (-x, -y, -z), size))
        notes["sun_direction"] = " ".join(f"{c:.5f}" for c in towards)
        notes["sun_power"] = f"{power:.3f}"
    notes["mood"] = mood
    return lamps, world


def interior(seed: int, kind: Interior) -> Scene:
    """Make a furnished room; seed and kind determine it."""
    rng = random.Random(f"{kind}-{seed}")
    palette = Palette(rng)
    widths, depths = ((2.6, 3.2), (2.8, 3.4)) if kind == "bathroom" else ((3.8, 5.4), (4.0, 5.6))
    wide, deep = rng.uniform(*widths), rng.uniform(*depths)
    window = rng.uniform(1.1, min(2.4, wide - 1.2))
    height, sill = rng.uniform(2.4, 2.9), rng.uniform(0.4, 0.95)
    center = rng.uniform(-0.5, 0.5) * (wide - window - 0.4)
    shell = _Shell(wide, deep, height, center, window, sill, rng.uniform(1.0, height - sill - 0.25))
    notes: dict[str, str] = {}
    floor = _FloorPlan(shell)
    centre_parts, place, footprint = _centre(rng, palette, kind)
    yaw = rng.choice([0.0, math.pi / 2]) + rng.gauss(0, 0.08)
    offset = (rng.uniform(-0.3, 0.3), rng.uniform(-0.4, 0.4), 0.0)
    floor.occupy(offset[0], offset[1], max(footprint), max(footprint))
    parts = [*_walls(rng, palette, shell, kind), *placed(centre_parts, offset, yaw)]
    if kind in ("living_room", "bedroom") and rng.random() < 0.7 and place.location[2] > 0.1:
        size = (rng.uniform(1.6, 2.4), rng.uniform(1.3, 1.9), 0.014)
        parts.append(Part("box", size, (offset[0], offset[1], 0.007), palette.rug(), (0, 0, yaw), bevel=0.004))
    parts += _against_walls(rng, palette, kind, shell, floor)
    lamps, world = _daylight(rng, shell, notes)
    if notes["mood"] == "evening" or rng.random() < 0.35:
        made, lamp = furniture.floor_lamp(rng, palette)
        corner = (rng.choice([-1, 1]) * (shell.width / 2 - 0.4), -shell.depth / 2 + 0.45, 0.0)
        if floor.occupy(corner[0], corner[1], 0.4, 0.4):
            parts += placed(made, corner, 0)
            lamps.append(replace(lamp, location=add(lamp.location, corner)))
    if notes["mood"] == "evening":
        x, y, warm = rng.uniform(-0.8, 0.8), rng.uniform(-0.8, 0.8), (1.0, 0.82, 0.62)
        shade = Material("plain", warm, warm, 0.6, emission=4.0)
        parts.append(Part("cylinder", (0.34, 0.34, 0.06), (x, y, height - 0.03), shade))
        lamps.append(Lamp("area", warm, rng.uniform(45, 90), (x, y, height - 0.08), (0, 0, -1), 0.32, 0.32))
        notes["lamp_location"] = " ".join(f"{c:.3f}" for c in (x, y, height - 0.06))
    for _ in range(rng.randint(1, 4)):
        side, y = rng.choice([-1, 1]), rng.uniform(-0.35, 0.35) * deep
        made = furniture.picture(rng, palette)
        parts += placed(made, (side * (wide / 2 - 0.02), y, rng.uniform(1.45, 1.75)), -side * math.pi / 2)
    location = add(place.location, offset)
    x, y = wide / 2 - 0.25, deep / 2 - 0.25
    return Scene(
        name=f"{kind}_{seed:04d}",
        kind=kind,
        parts=tuple(parts),
        lamps=tuple(lamps),
        world=world,
        places=(replace(place, location=location),),
        bounds=((-x, -y, 0.35), (x, y, height - 0.3)),
        obstacles=floor.boxes(location[2] + 0.06, 2.0),
        notes=notes,
    )


Outdoor = Literal["terrace", "garden", "square"]
OUTDOORS: tuple[Outdoor, ...] = ("terrace", "garden", "square")
SUPPLIED_MAPS = tuple(
    f"{name}.exr" for name in ("city", "courtyard", "forest", "sunrise", "sunset", "studio", "interior", "night")
)
"""Names of environment maps that come with Blender."""


def _tree(rng: random.Random) -> Parts:
    height = rng.uniform(2.4, 4.5)
    bark = Material("wood", linear(0.36, 0.27, 0.2), linear(0.2, 0.15, 0.12), 0.9, scale=4.0, bump=0.6)
    green = tone(rng, 0.27, (0.4, 0.75), (0.2, 0.5))
    leaf = Material("grass", green, (green[0] * 0.5, green[1] * 0.55, green[2] * 0.4), 0.8, scale=3.0, bump=0.9)
    trunk = Part("cylinder", (0.22, 0.22, height * 0.6), (0, 0, height * 0.3), bark)
    crowns = []
    for _ in range(rng.randint(5, 8)):
        size = rng.uniform(1.1, 1.9)
        place = (rng.uniform(-0.7, 0.7), rng.uniform(-0.7, 0.7), height * rng.uniform(0.62, 1.0))
        crowns.append(Part("foliage", (size, size, size * 0.85), place, leaf, seed=rng.randrange(10**6)))
    return (trunk, *crowns)


def _hedge(rng: random.Random) -> Parts:
    green = tone(rng, 0.28, (0.4, 0.7), (0.18, 0.4))
    leaf = Material("grass", green, (green[0] * 0.6, green[1] * 0.6, green[2] * 0.5), 0.7, scale=4.0)
    height = rng.uniform(0.9, 1.8)
    sizes = [rng.uniform(0.9, 1.3) for _ in range(5)]
    seeds = [rng.randrange(10**6) for _ in range(2)]
    places = [(0.75 * (i - 2), 0.1 * (size - 1.1), 0.46 * height) for i, size in enumerate(sizes)]
    return tuple(Part("foliage", (1.3, 0.9, height), at, leaf, seed=seeds[i % 2]) for i, at in enumerate(places))


def _meadow(rng: random.Random, lawn: Color) -> Parts:
    """Make tufts of grass around the centre, of four shapes, paler than the ground."""
    paler = (min(0.7, lawn[0] * 1.9), min(0.8, lawn[1] * 1.8), min(0.5, lawn[2] * 1.6))
    blade = Material("plain", paler, lawn, 0.6)
    seeds = [rng.randrange(10**6) for _ in range(4)]
    tufts = []
    for _ in range(900):
        radius, angle = 0.25 + 4.0 * rng.random() ** 0.8, rng.uniform(0, 2 * math.pi)
        kind = rng.randrange(4)
        size = (0.06 + 0.02 * kind, 0.06 + 0.02 * kind, 0.03 + 0.015 * kind)
        place = (radius * math.cos(angle), radius * math.sin(angle), 0.4 * size[2])
        tufts.append(Part("tuft", size, place, blade, (0, 0, rng.choice([0.0, 1.3, 2.9, 4.4])), seed=seeds[kind]))
    return tuple(tufts)


def _house(rng: random.Random, palette: Palette) -> Parts:
    width, height = rng.uniform(4, 9), rng.uniform(3, 7)
    brick = Material("brick", linear(0.6, 0.34, 0.26), linear(0.75, 0.7, 0.65), 0.85, scale=3.2, bump=0.4)
    wall = rng.choice([palette.wall(), brick])
    glass = Material("plain", linear(0.12, 0.14, 0.17), linear(0.1, 0.1, 0.1), 0.05, coat=0.5)
    frame = palette.paint()
    parts = [box((width, 2.0, height), (0, 1.0, height / 2), wall, 0.01)]
    for column in range(int(width / 1.6)):
        for row in range(int(height / 2.4)):
            x, z = (column + 0.5) * 1.6 - int(width / 1.6) * 0.8, 1.5 + 2.4 * row
            parts.append(box((1.0, 0.06, 1.3), (x, -0.01, z), frame))
            parts.append(box((0.86, 0.05, 1.16), (x, -0.03, z), glass, 0))
    return tuple(parts)


def _support(rng: random.Random, palette: Palette) -> tuple[Parts, Place]:
    choice = rng.choice(["table", "ground", "block", "ground"])
    if choice == "table":
        size, height = rng.uniform(0.8, 1.3), rng.uniform(0.5, 0.75)
        return furniture.table(rng, palette, size, size * 0.8, height), Place((0, 0, height), size * 0.27, 1.5)
    if choice == "block":
        side, height = rng.uniform(0.7, 1.1), rng.uniform(0.3, 0.6)
        block = box((side, side, height), (0, 0, height / 2), palette.stone(), 0.02)
        return (block,), Place((0, 0, height), side * 0.3, 1.5)
    return (), Place((0, 0, 0.0), 0.6, 2.0)


def outdoor(seed: int, kind: Outdoor) -> Scene:
    """Make an outdoor place; seed and kind determine it."""
    rng = random.Random(f"{kind}-{seed}")
    palette = Palette(rng)
    stone, joint = tone(rng, 0.08, (0.03, 0.25), (0.4, 0.75)), tone(rng, 0.08, (0.05, 0.2), (0.2, 0.5))
    paving = Material("tiles", stone, joint, 0.75, scale=rng.uniform(1.2, 2.4), bump=0.3)
    green = tone(rng, 0.26, (0.45, 0.75), (0.25, 0.5))
    lawn = Material("grass", green, tone(rng, 0.2, (0.3, 0.6), (0.3, 0.5)), 0.9, bump=0.9)
    ground = {"terrace": palette.wood("planks", 1.2), "garden": lawn, "square": paving}[kind]
    parts: list[Part] = [
        box((60, 60, 0.1), (0, 0, -0.06), lawn if kind != "square" else paving, 0),
        box((7, 7, 0.1), (0, 0, -0.05), ground, 0),
    ]
    support, place = _support(rng, palette)
    parts += placed(support, (0, 0, 0), rng.uniform(0, math.pi))
    if kind == "garden":
        parts += _meadow(rng, green)
    count = rng.randint(8, 11)
    for i in range(count):
        angle = 2 * math.pi * (i + rng.uniform(-0.25, 0.25)) / count
        far, near = rng.uniform(5.5, 10.0), rng.uniform(2.7, 3.2)
        facing = angle - math.pi / 2
        where = (far * math.cos(angle), far * math.sin(angle), 0.0)
        close = (near * math.cos(angle), near * math.sin(angle), 0.0)
        common = {"garden": "hedge", "terrace": "hedge", "square": "house"}[kind]
        what = rng.choice([common, common, "house", "tree", "tree", "near", "wall"])
        if what == "house":
            parts += placed(_house(rng, palette), (where[0] * 1.3, where[1] * 1.3, 0), facing)
        elif what == "tree":
            parts += placed(_tree(rng), where, rng.uniform(0, 6))
        elif what == "hedge":
            parts += placed(_hedge(rng), (where[0] * 0.75, where[1] * 0.75, 0), facing)
        elif what == "wall":
            size, place_of_wall = (4, 0.25, rng.uniform(1, 2.2)), (where[0], where[1], 0.6)
            parts.append(Part("box", size, place_of_wall, palette.wall(), (0, 0, facing), bevel=0.02))
        else:
            thing = rng.choice([
                furniture.plant(rng, palette, rng.uniform(0.7, 1.4)),
                furniture.chair(rng, palette),
                furniture.cabinet(rng, palette, 1.0, 0.45),
            ])  # fmt: skip
            parts += placed(thing, close, facing)
    notes: dict[str, str] = {}
    if rng.random() < 0.7:
        elevation, azimuth = rng.uniform(0.3, 1.1), rng.uniform(0, 2 * math.pi)
        size, haze = rng.uniform(0.0095, 0.03), rng.uniform(0.3, 3.0)
        world = World("sky", (0.0, 0.0, 0.0), 0.12, elevation, azimuth, size, haze)
        notes["sun_direction"] = " ".join(f"{c:.5f}" for c in direction(azimuth, elevation))
        notes["mood"] = "sun"
    else:
        name = rng.choice(["city.exr", "courtyard.exr", "forest.exr", "sunset.exr", "sunrise.exr"])
        world = World("environment", path=name, rotation=rng.uniform(0, 2 * math.pi))
        notes["mood"] = f"environment {name}"
    return Scene(
        name=f"{kind}_{seed:04d}",
        kind=kind,
        parts=tuple(parts),
        lamps=(),
        world=world,
        places=(place,),
        bounds=((-2.6, -2.6, 0.35), (2.6, 2.6, 2.6)),
        obstacles=(((-0.6, -0.6, 0.0), (0.6, 0.6, place.location[2] + 0.4)),),
        notes=notes,
    )


KINDS: tuple[str, ...] = (*INTERIORS, *OUTDOORS)


def make_scene(kind: str, seed: int) -> Scene:
    """Make the scene of a kind and a seed."""
    if kind in INTERIORS:
        return interior(seed, kind)
    if kind in OUTDOORS:
        return outdoor(seed, kind)
    raise ValueError(f"scene kind: expected one of {', '.join(KINDS)}, found '{kind}'")
