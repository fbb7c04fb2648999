"""Random objects to insert: turned, extruded and blob shapes, single or stacked, of many materials, on z = 0."""

import math
import random
from dataclasses import replace

from splatgraft_paper.synthesis.furniture import Palette, tone
from splatgraft_paper.synthesis.scene import Material, Number, Part, Pattern, Place, Shape, add, rotate_z


def _profile(rng: random.Random) -> tuple[tuple[float, float], ...]:
    """Draw a smooth vase-like profile, closed at the bottom, open at the top."""
    waves = [(rng.uniform(0.05, 0.28), rng.uniform(1, 5), rng.uniform(0, 6.3)) for _ in range(3)]
    radii = [0.6 + sum(a * math.sin(f * i / 12 * math.pi + p) for a, f, p in waves) for i in range(13)]
    radii = [max(0.18, r) for r in radii]
    top = max(radii)
    outer = [(r / top, i / 12) for i, r in enumerate(radii)]
    rim = outer[-1][0]
    return ((0.0, 0.0), (outer[0][0] * 0.96, 0.0), *outer, (rim * 0.9, 0.985), (rim * 0.82, 0.8), (0.0, 0.75))


def _outline(rng: random.Random) -> tuple[tuple[float, float], ...]:
    """Draw a star-like or rounded polygon."""
    corners, depth, phase = rng.randint(3, 9), rng.uniform(0.0, 0.35), rng.uniform(0, 6.3)
    count = corners * 4
    points = []
    for i in range(count):
        angle = 2 * math.pi * i / count
        r = 0.5 * (1 - depth * (0.5 - 0.5 * math.cos(corners * angle + phase)))
        points.append((r * math.cos(angle), r * math.sin(angle)))
    return tuple(points)


def _surface(rng: random.Random, palette: Palette) -> Material:
    """Draw a material: metal, glossy, matt, wood, stone or patterned."""
    kind = rng.choice(["metal", "glossy", "matt", "pattern", "pattern", "wood", "stone"])
    a, b = tone(rng, rng.random(), (0.15, 0.85), (0.25, 0.9)), tone(rng, rng.random(), (0.1, 0.7), (0.3, 0.95))
    if kind == "metal":
        return replace(palette.metal(), roughness=rng.uniform(0.08, 0.5))
    if kind == "glossy":
        return Material("plain", a, a, rng.uniform(0.05, 0.25), coat=rng.choice([0.0, 0.8]))
    if kind == "matt":
        return Material("plaster", a, b, rng.uniform(0.6, 0.95), scale=rng.uniform(2, 6), bump=rng.uniform(0, 0.5))
    if kind == "wood":
        return palette.wood(scale=rng.uniform(2, 5))
    if kind == "stone":
        return replace(palette.stone(), scale=rng.uniform(3, 7))
    patterns: list[Pattern] = ["speckle", "stripes", "checker", "rug", "painting", "brick"]
    pattern = rng.choice(patterns)
    finer = 4 if pattern in ("rug", "painting", "brick") else 1
    scale = rng.uniform(1.0, 2.5) * finer
    return Material(pattern, a, b, rng.uniform(0.15, 0.9), scale=scale, bump=rng.uniform(0, 0.4))


def _primitive(rng: random.Random, palette: Palette, width: Number, height: Number) -> Part:
    shapes: list[Shape] = ["turned", "turned", "extruded", "blob", "box", "sphere", "cylinder", "cushion"]
    shape = rng.choice(shapes)
    material, size, at = _surface(rng, palette), (width, width, height), (0.0, 0.0, height / 2)
    if shape == "turned":
        return Part("turned", size, at, material, profile=_profile(rng))
    if shape == "extruded":
        return Part("extruded", size, at, material, profile=_outline(rng), bevel=0.04 * width)
    if shape == "blob":
        return Part("blob", (width, width, height), (0, 0, height * 0.46), material, seed=rng.randrange(10**6))
    if shape == "sphere":
        return Part("sphere", (width, width, height), at, material)
    return Part(
        shape, (width, width * rng.uniform(0.6, 1.0), height), at, material, bevel=0.05 * width, seed=rng.randrange(99)
    )


def _handle(rng: random.Random, palette: Palette, width: Number, height: Number) -> Part:
    turn = rng.uniform(0, 2 * math.pi)
    place = rotate_z((width * 0.52, 0, height * 0.5), turn)
    size = (height * 0.45, height * 0.45, width * 0.09)
    return Part("torus", size, place, _surface(rng, palette), (math.pi / 2, 0, turn), bevel=0.16)


def make(seed: int, place: Place) -> tuple[Part, ...]:
    """Make an object of one to three stacked pieces, possibly with a handle, standing at the origin."""
    rng = random.Random(f"object-{seed}")
    palette = Palette(rng)
    total = min(place.height * 0.6, rng.uniform(0.16, 0.55))
    pieces = rng.choice([1, 1, 2, 3])
    widths = [min(1.8 * place.radius, rng.uniform(0.35, 0.95) * total)]
    widths += [widths[0] * rng.uniform(0.45, 0.85) for _ in range(pieces - 1)]
    shares = [rng.uniform(0.6, 1.4) for _ in range(pieces)]
    parts: list[Part] = []
    base = 0.0
    for width, share in zip(widths, shares, strict=True):
        height = total * share / sum(shares)
        part = _primitive(rng, palette, width, height)
        parts.append(replace(part, location=add(part.location, (0, 0, base))))
        base += height * (0.93 if part.shape in ("blob", "sphere", "cushion") else 1.0)
    if rng.random() < 0.4:
        parts.append(_handle(rng, palette, widths[0], total * shares[0] / sum(shares)))
    return tuple(parts)
