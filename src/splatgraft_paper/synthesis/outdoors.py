"""Random outdoor places: terraces, gardens and squares under a Nishita sky or an environment map."""

import math
import random
from typing import Literal

from splatgraft_paper.synthesis import furniture
from splatgraft_paper.synthesis.furniture import Parts, box, placed
from splatgraft_paper.synthesis.palette import Palette, linear, tone
from splatgraft_paper.synthesis.scene import Color, Material, Part, Place, Scene, World, direction

Outdoor = Literal["terrace", "garden", "square"]
OUTDOORS: tuple[Outdoor, ...] = ("terrace", "garden", "square")
SUPPLIED_MAPS = (
    "city.exr",
    "courtyard.exr",
    "forest.exr",
    "sunrise.exr",
    "sunset.exr",
    "studio.exr",
    "interior.exr",
    "night.exr",
)
"""Environment maps that come with Blender."""


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
    return tuple(
        Part(
            "foliage", (1.3, 0.9, height), (0.75 * (i - 2), 0.1 * (size - 1.1), 0.46 * height), leaf, seed=seeds[i % 2]
        )
        for i, size in enumerate(sizes)
    )


def _meadow(rng: random.Random, lawn: Color) -> Parts:
    """Tufts of grass around the centre, of four shapes, paler than the ground."""
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
    wall = rng.choice(
        [palette.wall(), Material("brick", linear(0.6, 0.34, 0.26), linear(0.75, 0.7, 0.65), 0.85, scale=3.2, bump=0.4)]
    )
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
        size = rng.uniform(0.8, 1.3)
        height = rng.uniform(0.5, 0.75)
        return furniture.table(rng, palette, size, size * 0.8, height), Place((0, 0, height), size * 0.27, 1.5)
    if choice == "block":
        side, height = rng.uniform(0.7, 1.1), rng.uniform(0.3, 0.6)
        return (box((side, side, height), (0, 0, height / 2), palette.stone(), 0.02),), Place(
            (0, 0, height), side * 0.3, 1.5
        )
    return (), Place((0, 0, 0.0), 0.6, 2.0)


def outdoor(seed: int, kind: Outdoor) -> Scene:
    """Make an outdoor place; the same seed and kind give the same place."""
    rng = random.Random(f"{kind}-{seed}")
    palette = Palette(rng)
    paving = Material(
        "tiles",
        tone(rng, 0.08, (0.03, 0.25), (0.4, 0.75)),
        tone(rng, 0.08, (0.05, 0.2), (0.2, 0.5)),
        0.75,
        scale=rng.uniform(1.2, 2.4),
        bump=0.3,
    )
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
            parts.append(
                Part(
                    "box",
                    (4, 0.25, rng.uniform(1, 2.2)),
                    (where[0], where[1], 0.6),
                    palette.wall(),
                    (0, 0, facing),
                    bevel=0.02,
                )
            )
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
        world = World(
            "sky",
            strength=0.12,
            sun_elevation=elevation,
            sun_azimuth=azimuth,
            sun_size=rng.uniform(0.0095, 0.03),
            haze=rng.uniform(0.3, 3.0),
        )
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
