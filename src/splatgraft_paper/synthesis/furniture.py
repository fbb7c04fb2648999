"""Random materials of a place, drawn around a few shared hues, and furniture made of these materials.

Each piece stands on the floor at the origin, its front towards -y.
"""

import colorsys
import math
import random
from dataclasses import replace

from splatgraft_paper.synthesis.scene import Color, Lamp, Material, Number, Part, Pattern, Vector, add, rotate_z


def linear(red: Number, green: Number, blue: Number) -> Color:
    """Convert sRGB values in [0, 1] to linear RGB."""

    def one(value: Number) -> float:
        return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4

    return (one(red), one(green), one(blue))


def tone(rng: random.Random, hue: Number, saturation: tuple[float, float], value: tuple[float, float]) -> Color:
    """Draw a colour near a hue (in turns), with saturation and value from ranges (HSV of sRGB)."""
    shifted = (hue + rng.gauss(0, 0.02)) % 1.0
    return linear(*colorsys.hsv_to_rgb(shifted, rng.uniform(*saturation), rng.uniform(*value)))


class Palette:
    """Materials of one place: woods, walls, cloth and accents that share a few hues."""

    def __init__(self, rng: random.Random):
        """Draw the shared hues."""
        self._rng = rng
        self.accent_hue = rng.random()
        self.second_hue = (self.accent_hue + rng.choice([0.08, 0.33, 0.5, 0.6])) % 1.0
        self.wood_value = rng.uniform(0.28, 0.82)

    def _tone(self, hues: list[float], saturation: tuple[float, float], value: tuple[float, float]) -> Color:
        """Draw a colour near one of several hues."""
        return tone(self._rng, self._rng.choice(hues), saturation, value)

    def wall(self) -> Material:
        """Make painted plaster, mostly pale."""
        if self._rng.random() < 0.25:
            color = tone(self._rng, self.accent_hue, (0.12, 0.4), (0.45, 0.75))
        else:
            color = self._tone([0.08, 0.12, 0.55, self.second_hue], (0.02, 0.14), (0.72, 0.9))
        return Material("plaster", color, (color[0] * 0.8, color[1] * 0.8, color[2] * 0.78), 0.85, bump=0.05)

    def ceiling(self) -> Material:
        """Make nearly white paint."""
        return Material("plaster", (0.78, 0.77, 0.74), (0.6, 0.6, 0.6), 0.9)

    def floor(self, kind: str) -> Material:
        """Make planks, tiles or stone, by the kind of room."""
        rng = self._rng
        wet: list[Pattern] = ["tiles", "marble", "tiles"]
        dry: list[Pattern] = ["planks", "planks", "planks", "tiles"]
        pattern = rng.choice(wet if kind in ("bathroom", "kitchen") else dry)
        if pattern == "planks":
            return self.wood("planks", scale=rng.uniform(0.9, 1.6))
        pale = self._tone([0.07, 0.1, 0.58], (0.03, 0.25), (0.4, 0.85))
        joint = tone(rng, 0.1, (0.02, 0.1), (0.25, 0.7))
        return Material(pattern, pale, joint, rng.uniform(0.08, 0.5), scale=rng.uniform(1.6, 3.5), bump=0.15)

    def wood(self, pattern: Pattern = "wood", scale: Number = 1.0) -> Material:
        """Make oak to walnut, varnished or oiled."""
        rng = self._rng
        value = min(0.9, max(0.18, self.wood_value + rng.gauss(0, 0.06)))
        color = tone(rng, 0.075, (0.4, 0.62), (value, value))
        dark: Color = (color[0] * 0.5, color[1] * 0.45, color[2] * 0.4)
        roughness = rng.uniform(0.22, 0.6)
        return Material(pattern, color, dark, roughness, scale=scale, bump=0.12, coat=rng.choice([0.0, 0.0, 0.4]))

    def cloth(self, pattern: Pattern | None = None) -> Material:
        """Make cloth for upholstery, curtains or bedding."""
        color = self._tone([self.accent_hue, self.second_hue, 0.09], (0.08, 0.6), (0.25, 0.85))
        second = tone(self._rng, self.second_hue, (0.05, 0.4), (0.4, 0.9))
        patterns: list[Pattern] = ["fabric", "fabric", "fabric", "stripes", "checker"]
        return Material(pattern or self._rng.choice(patterns), color, second, 0.9, bump=0.35)

    def rug(self) -> Material:
        """Make a rug's pattern."""
        rng = self._rng
        color = tone(rng, self.accent_hue, (0.2, 0.65), (0.3, 0.7))
        second = tone(rng, self.second_hue, (0.1, 0.5), (0.5, 0.9))
        pattern: Pattern = rng.choice(["rug", "rug", "stripes", "speckle"])
        return Material(pattern, color, second, 0.95, bump=0.5, scale=rng.uniform(0.7, 1.6))

    def paint(self) -> Material:
        """Make lacquer for furniture."""
        color = self._tone([self.accent_hue, self.second_hue, 0.1], (0.02, 0.55), (0.25, 0.95))
        return Material("plain", color, color, self._rng.uniform(0.15, 0.5), coat=self._rng.choice([0.0, 0.6]))

    def metal(self) -> Material:
        """Make steel, brass, copper or blackened iron."""
        rng = self._rng
        color = rng.choice([(0.62, 0.62, 0.64), (0.75, 0.53, 0.25), (0.06, 0.06, 0.065), (0.7, 0.38, 0.25)])
        return Material("metal", color, color, rng.uniform(0.12, 0.45), metallic=1.0)

    def stone(self) -> Material:
        """Make stone for counters, basins or paving."""
        rng = self._rng
        color = self._tone([0.08, 0.6], (0.02, 0.12), (0.35, 0.9))
        vein = tone(rng, 0.08, (0.05, 0.2), (0.15, 0.6))
        pattern: Pattern = rng.choice(["marble", "speckle", "plaster"])
        return Material(pattern, color, vein, rng.uniform(0.1, 0.6), scale=rng.uniform(0.6, 1.6))

    def ceramic(self) -> Material:
        """Make glaze for crockery and sanitary ware."""
        color = self._tone([self.accent_hue, 0.1], (0.0, 0.35), (0.6, 0.95))
        return Material("plain", color, color, 0.18, coat=0.7)

    def anything(self) -> Material:
        """Make a random material for a small object."""
        return self._rng.choice([self.wood, self.paint, self.metal, self.ceramic, self.stone, self.cloth])()


Parts = tuple[Part, ...]


def placed(parts: Parts, location: Vector, yaw: Number) -> Parts:
    """Rotate parts about z by `yaw`, radians, then translate them."""

    def moved(part: Part) -> Part:
        x, y, z = part.rotation
        return replace(part, location=add(rotate_z(part.location, yaw), location), rotation=(x, y, z + yaw))

    return tuple(map(moved, parts))


def box(size: Vector, location: Vector, material: Material, bevel: Number = 0.004) -> Part:
    """Make a box with slightly rounded edges."""
    return Part(shape="box", size=size, location=location, material=material, bevel=bevel)


def legs(width: Number, depth: Number, height: Number, thick: Number, material: Material) -> Parts:
    """Make four square legs under the corners of a rectangle, metres."""
    x, y = width / 2 - thick, depth / 2 - thick
    return tuple(
        box((thick, thick, height), (sx * x, sy * y, height / 2), material) for sx in (-1, 1) for sy in (-1, 1)
    )


def table(rng: random.Random, palette: Palette, width: Number, depth: Number, height: Number) -> Parts:
    """Make a table with four legs or a round foot."""
    top = rng.choice([palette.wood, palette.wood, palette.stone, palette.paint])()
    thick = rng.uniform(0.025, 0.05)
    if rng.random() < 0.3:
        foot = palette.metal()
        side = min(width, depth)
        return (
            Part("cylinder", (side, side, thick), (0, 0, height - thick / 2), top, bevel=0.006),
            Part("cylinder", (0.07, 0.07, height - thick), (0, 0, (height - thick) / 2), foot),
            Part("cylinder", (side * 0.5, side * 0.5, 0.02), (0, 0, 0.01), foot, bevel=0.005),
        )
    leg = rng.uniform(0.035, 0.07)
    four = legs(width - 0.06, depth - 0.06, height - thick, leg, rng.choice([top, palette.wood()]))
    return (box((width, depth, thick), (0, 0, height - thick / 2), top, 0.008), *four)


def sofa(rng: random.Random, palette: Palette, width: Number = 1.9) -> Parts:
    """Make a sofa with seat, back, arms and loose cushions."""
    cloth, wood = palette.cloth("fabric"), palette.wood()
    depth, seat = 0.86, 0.42
    parts = [
        box((width, depth, 0.22), (0, 0, 0.2), cloth, 0.03),
        box((width, 0.2, 0.5), (0, depth / 2 - 0.1, 0.56), cloth, 0.06),
    ]
    parts += [box((0.18, depth, 0.36), (s * (width / 2 - 0.09), 0, 0.4), cloth, 0.05) for s in (-1, 1)]
    parts += list(legs(width - 0.1, depth - 0.1, 0.09, 0.05, wood))
    count = 2 if width < 2.0 else 3
    each = (width - 0.36) / count
    for i in range(count):
        x = (i - (count - 1) / 2) * each
        parts.append(Part("cushion", (each * 0.98, depth - 0.24, 0.17), (x, -0.08, seat - 0.03), cloth, seed=i))
        if rng.random() < 0.75:
            tilt, place = (math.radians(68), 0.0, rng.uniform(-0.25, 0.25)), (x * 0.9, 0.14, seat + 0.22)
            parts.append(Part("cushion", (0.42, 0.42, 0.14), place, palette.cloth(), tilt, seed=i + 7))
    return tuple(parts)


def chair(rng: random.Random, palette: Palette) -> Parts:
    """Make a dining chair."""
    frame = rng.choice([palette.wood, palette.paint, palette.metal])()
    pad = palette.cloth()
    back = [box((0.035, 0.03, 0.45), (s * 0.19, 0.2, 0.68), frame) for s in (-1, 1)]
    rails = [box((0.36, 0.02, 0.06), (0, 0.2, 0.6 + 0.13 * i), frame) for i in range(3)]
    seat = [box((0.44, 0.44, 0.03), (0, 0, 0.44), frame, 0.01), Part("cushion", (0.41, 0.41, 0.06), (0, 0, 0.475), pad)]
    return (*legs(0.44, 0.44, 0.43, 0.035, frame), *back, *rails, *seat)


def shelf(rng: random.Random, palette: Palette, width: Number = 0.9, height: Number = 1.8) -> Parts:
    """Make a shelf with books and balls."""
    wood = rng.choice([palette.wood, palette.paint])()
    depth, thick = 0.3, 0.022
    parts = [box((thick, depth, height), (s * width / 2, 0, height / 2), wood) for s in (-1, 1)]
    parts.append(box((width, 0.01, height), (0, depth / 2, height / 2), wood))
    levels = max(2, round(height / 0.36))
    for level in range(levels + 1):
        z = thick / 2 + level * (height - thick) / levels
        parts.append(box((width, depth, thick), (0, 0, z), wood))
        if level == levels:
            continue
        x = -width / 2 + 0.03
        while x < width / 2 - 0.1:
            if rng.random() < 0.12:
                size = rng.uniform(0.08, 0.14)
                place = (x + size / 2, 0, z + thick / 2 + size / 2)
                parts.append(Part("sphere", (size, size, size), place, palette.anything()))
                x += size + 0.04
                continue
            book_w, book_h = rng.uniform(0.018, 0.05), rng.uniform(0.17, 0.27)
            color = tone(rng, rng.random(), (0.1, 0.75), (0.2, 0.85))
            cover = Material("plain", color, color, rng.uniform(0.3, 0.8))
            place = (x + book_w / 2, -0.02, z + thick / 2 + book_h / 2)
            parts.append(box((book_w * 0.94, rng.uniform(0.14, 0.2), book_h), place, cover, 0.002))
            x += book_w + (rng.uniform(0.05, 0.2) if rng.random() < 0.1 else 0.0)
    return tuple(parts)


def cabinet(rng: random.Random, palette: Palette, width: Number, height: Number, depth: Number = 0.45) -> Parts:
    """Make a cabinet with doors or drawers and handles."""
    body, handle = rng.choice([palette.wood, palette.paint, palette.paint])(), palette.metal()
    parts = [box((width, depth, height), (0, 0, height / 2), body)]
    columns, rows = max(1, round(width / 0.5)), rng.choice([1, 2, 3])
    for i in range(columns):
        for j in range(rows):
            w, h = width / columns, (height - 0.1) / rows
            x, z = (i + 0.5) * w - width / 2, 0.08 + (j + 0.5) * h
            parts.append(box((w - 0.012, 0.02, h - 0.012), (x, -depth / 2 - 0.008, z), body, 0.003))
            parts.append(box((0.12, 0.018, 0.012), (x, -depth / 2 - 0.03, z + h * 0.3), handle, 0.003))
    return tuple(parts)


def counter(rng: random.Random, palette: Palette, width: Number) -> Parts:
    """Make a kitchen counter with a stone top, tap and splash-back."""
    body = cabinet(rng, palette, width, 0.86, 0.58)
    top, metal = palette.stone(), palette.metal()
    tiles = Material("tiles", tone(rng, palette.accent_hue, (0.0, 0.3), (0.6, 0.9)), (0.6, 0.6, 0.58), 0.15, scale=6.0)
    tap = [
        Part("cylinder", (0.035, 0.035, 0.28), (width * 0.25, 0.2, 1.03), metal),
        Part("cylinder", (0.025, 0.025, 0.18), (width * 0.25, 0.12, 1.16), metal, (math.pi / 2, 0, 0)),
    ]
    return (
        *body,
        box((width + 0.02, 0.62, 0.04), (0, 0, 0.88), top, 0.006),
        box((width, 0.015, 0.55), (0, 0.3, 1.17), tiles),
        *tap,
    )


def bed(rng: random.Random, palette: Palette) -> Parts:
    """Make a double bed with bedding."""
    wood, sheet, blanket = palette.wood(), palette.cloth("fabric"), palette.cloth()
    parts = [
        box((1.5, 2.05, 0.24), (0, 0, 0.22), wood, 0.01),
        box((1.54, 0.06, 1.0), (0, 1.05, 0.5), wood, 0.02),
        Part("cushion", (1.46, 1.98, 0.26), (0, 0, 0.44), sheet),
        Part("cushion", (1.56, 1.3, 0.2), (0, -0.34, 0.53), blanket, seed=3),
    ]
    for s in (-1, 1):
        pillow = palette.cloth("fabric")
        parts.append(Part("cushion", (0.62, 0.42, 0.2), (s * 0.36, 0.76, 0.64), pillow, (0.25, 0, 0), seed=5))
    return tuple(parts)


def bathtub(rng: random.Random, palette: Palette) -> Parts:
    """Make a bathtub with a tiled front."""
    white = palette.ceramic()
    tiles = Material("tiles", tone(rng, palette.accent_hue, (0.0, 0.4), (0.5, 0.9)), (0.7, 0.7, 0.68), 0.2, scale=7.0)
    rim = [box((1.7, 0.07, 0.06), (0, s * 0.34, 0.57), white, 0.02) for s in (-1, 1)]
    rim += [box((0.07, 0.75, 0.06), (s * 0.82, 0, 0.57), white, 0.02) for s in (-1, 1)]
    return (box((1.66, 0.7, 0.2), (0, 0, 0.1), white, 0.02), *rim, box((1.7, 0.02, 0.55), (0, -0.37, 0.275), tiles),
            box((0.03, 0.7, 0.5), (-0.83, 0, 0.3), white), box((0.03, 0.7, 0.5), (0.83, 0, 0.3), white),
            box((1.66, 0.03, 0.5), (0, 0.35, 0.3), white))  # fmt: skip


def basin(rng: random.Random, palette: Palette) -> Parts:
    """Make a washstand with a bowl and a mirror above it."""
    mirror = Material("metal", (0.85, 0.86, 0.87), roughness=0.02, metallic=1.0)
    bowl = ((0.0, 0.0), (0.6, 0.05), (0.95, 0.7), (1.0, 1.0), (0.9, 0.95), (0.55, 0.25), (0.0, 0.15))
    return (
        *cabinet(rng, palette, 0.9, 0.78),
        box((0.94, 0.5, 0.03), (0, 0, 0.795), palette.stone()),
        Part("turned", (0.42, 0.42, 0.13), (0, 0, 0.875), palette.ceramic(), profile=bowl),
        box((0.8, 0.02, 0.9), (0, 0.22, 1.55), mirror),
    )


def plant(rng: random.Random, palette: Palette, height: Number) -> Parts:
    """Make a potted plant."""
    green = tone(rng, 0.29, (0.4, 0.7), (0.25, 0.55))
    leaf = Material("plain", green, (green[0] * 0.5, green[1] * 0.6, green[2] * 0.5), 0.45)
    soil = Material("plaster", (0.03, 0.02, 0.012), (0.01, 0.01, 0.01), 0.95, bump=0.5)
    pot = height * 0.3
    profile = ((0.0, 0.0), (0.68, 0.0), (0.9, 0.8), (1.0, 1.0), (0.86, 1.0), (0.0, 0.9))
    glaze = rng.choice([palette.ceramic, palette.stone])()
    return (
        Part("turned", (pot * 1.1, pot * 1.1, pot), (0, 0, pot / 2), glaze, profile=profile),
        Part("cylinder", (pot * 0.85, pot * 0.85, 0.01), (0, 0, pot * 0.93), soil),
        Part("tuft", (height, height, height * 0.75), (0, 0, pot + height * 0.33), leaf, seed=rng.randrange(10**6)),
    )


def floor_lamp(rng: random.Random, palette: Palette) -> tuple[Parts, Lamp]:
    """Make a standing lamp and the light inside its shade."""
    metal = palette.metal()
    glow = Material("fabric", (0.95, 0.75, 0.5), (0.8, 0.6, 0.4), 0.9, emission=rng.uniform(0.6, 1.6))
    shade = ((0.75, 0.0), (1.0, 0.0), (0.7, 1.0), (0.6, 1.0))
    parts = (
        Part("cylinder", (0.28, 0.28, 0.03), (0, 0, 0.015), metal, bevel=0.006),
        Part("cylinder", (0.022, 0.022, 1.45), (0, 0, 0.74), metal),
        Part("turned", (0.42, 0.42, 0.28), (0, 0, 1.5), glow, profile=shade),
    )
    warm = (1.0, rng.uniform(0.62, 0.82), rng.uniform(0.32, 0.6))
    return parts, Lamp("point", warm, rng.uniform(18, 60), (0, 0, 1.52), size=0.09)


def picture(rng: random.Random, palette: Palette) -> Parts:
    """Make a framed picture, centred at the origin."""
    w, h = rng.uniform(0.35, 0.9), rng.uniform(0.35, 0.8)
    a, b = tone(rng, rng.random(), (0.2, 0.7), (0.3, 0.9)), tone(rng, rng.random(), (0.2, 0.7), (0.2, 0.8))
    return (
        box((w, 0.03, h), (0, 0, 0), palette.wood(), 0.006),
        box((w - 0.07, 0.005, h - 0.07), (0, -0.016, 0), Material("painting", a, b, 0.5, scale=1.6), 0.0),
    )


def tabletop(rng: random.Random, palette: Palette, top: Part) -> Parts:
    """Make a few small objects near the edge of a table's top, on z = 0; the middle stays free."""
    parts: list[Part] = []
    width, depth = top.size[:2]
    for _ in range(rng.randint(1, 4)):
        angle = rng.uniform(0, 2 * math.pi)
        x, y = 0.5 * width * math.cos(angle), 0.5 * depth * math.sin(angle)
        reach = 1.0 if top.shape == "cylinder" else min(width / 2 / max(abs(x), 1e-6), depth / 2 / max(abs(y), 1e-6))
        inside = 1 - 0.14 / (math.hypot(x, y) * reach)
        x, y = x * reach * inside, y * reach * inside
        if math.hypot(x, y) < 0.22 or any(math.dist(p.location[:2], (x, y)) < 0.24 for p in parts):
            continue
        kind = rng.choice(["bowl", "cup", "book", "ball"])
        if kind == "book":
            size = (rng.uniform(0.12, 0.2), rng.uniform(0.16, 0.26), rng.uniform(0.015, 0.05))
            book = box(size, (x, y, size[2] / 2), palette.paint(), 0.002)
            parts.append(replace(book, rotation=(0, 0, rng.uniform(0, 3))))
        elif kind == "ball":
            size = rng.uniform(0.06, 0.1)
            parts.append(Part("sphere", (size, size, size), (x, y, size / 2), palette.anything()))
        else:
            wide = rng.uniform(0.14, 0.24) if kind == "bowl" else 0.085
            tall = wide * 0.38 if kind == "bowl" else 0.095
            profile = ((0.0, 0.0), (0.55, 0.0), (0.85, 0.4), (1.0, 1.0), (0.93, 1.0), (0.75, 0.45), (0.0, 0.12))
            if kind == "cup":
                profile = ((0.0, 0.0), (0.8, 0.0), (1.0, 1.0), (0.92, 1.0), (0.75, 0.08), (0.0, 0.08))
            parts.append(Part("turned", (wide, wide, tall), (x, y, tall / 2), palette.ceramic(), profile=profile))
    return tuple(parts)
