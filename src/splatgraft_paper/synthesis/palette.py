"""Random colours and materials of a place, drawn around a few shared hues."""

import colorsys
import random

from splatgraft_paper.synthesis.scene import Color, Material, Number, Pattern


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
    """The materials of one place: woods, walls, cloth and accents that share a few hues."""

    def __init__(self, rng: random.Random):
        """Draw the shared hues."""
        self._rng = rng
        self.accent_hue = rng.random()
        self.second_hue = (self.accent_hue + rng.choice([0.08, 0.33, 0.5, 0.6])) % 1.0
        self.wood_value = rng.uniform(0.28, 0.82)

    def wall(self) -> Material:
        """Painted plaster, mostly pale."""
        rng = self._rng
        if rng.random() < 0.25:
            color = tone(rng, self.accent_hue, (0.12, 0.4), (0.45, 0.75))
        else:
            color = tone(rng, rng.choice([0.08, 0.12, 0.55, self.second_hue]), (0.02, 0.14), (0.72, 0.9))
        darker: Color = (color[0] * 0.8, color[1] * 0.8, color[2] * 0.78)
        return Material(pattern="plaster", color=color, second=darker, roughness=0.85, bump=0.05)

    def ceiling(self) -> Material:
        """Nearly white paint."""
        return Material(pattern="plaster", color=(0.78, 0.77, 0.74), second=(0.6, 0.6, 0.6), roughness=0.9)

    def floor(self, kind: str) -> Material:
        """Planks, tiles or stone, by the kind of room."""
        rng = self._rng
        choice = rng.choice(
            ["tiles", "marble", "tiles"] if kind in ("bathroom", "kitchen") else ["planks"] * 3 + ["tiles"]
        )
        if choice == "planks":
            return self.wood("planks", scale=rng.uniform(0.9, 1.6))
        pale = tone(rng, rng.choice([0.07, 0.1, 0.58]), (0.03, 0.25), (0.4, 0.85))
        joint = tone(rng, 0.1, (0.02, 0.1), (0.25, 0.7))
        pattern: Pattern = "tiles" if choice == "tiles" else "marble"
        return Material(
            pattern=pattern,
            color=pale,
            second=joint,
            roughness=rng.uniform(0.08, 0.5),
            scale=rng.uniform(1.6, 3.5),
            bump=0.15,
        )

    def wood(self, pattern: Pattern = "wood", scale: Number = 1.0) -> Material:
        """Oak to walnut, varnished or oiled."""
        rng = self._rng
        value = min(0.9, max(0.18, self.wood_value + rng.gauss(0, 0.06)))
        color = tone(rng, 0.075, (0.4, 0.62), (value, value))
        dark: Color = (color[0] * 0.5, color[1] * 0.45, color[2] * 0.4)
        return Material(
            pattern=pattern,
            color=color,
            second=dark,
            roughness=rng.uniform(0.22, 0.6),
            scale=scale,
            bump=0.12,
            coat=rng.choice([0.0, 0.0, 0.4]),
        )

    def cloth(self, pattern: Pattern | None = None) -> Material:
        """Upholstery, curtains, bedding."""
        rng = self._rng
        hue = rng.choice([self.accent_hue, self.second_hue, 0.09])
        color = tone(rng, hue, (0.08, 0.6), (0.25, 0.85))
        second = tone(rng, self.second_hue, (0.05, 0.4), (0.4, 0.9))
        chosen: Pattern = pattern or rng.choice(["fabric", "fabric", "fabric", "stripes", "checker"])
        return Material(pattern=chosen, color=color, second=second, roughness=0.9, bump=0.35)

    def rug(self) -> Material:
        """A rug with a visible pattern."""
        rng = self._rng
        color = tone(rng, self.accent_hue, (0.2, 0.65), (0.3, 0.7))
        second = tone(rng, self.second_hue, (0.1, 0.5), (0.5, 0.9))
        pattern: Pattern = rng.choice(["rug", "rug", "stripes", "speckle"])
        return Material(
            pattern=pattern, color=color, second=second, roughness=0.95, bump=0.5, scale=rng.uniform(0.7, 1.6)
        )

    def paint(self) -> Material:
        """Lacquer on furniture."""
        rng = self._rng
        hue = rng.choice([self.accent_hue, self.second_hue, 0.1])
        color = tone(rng, hue, (0.02, 0.55), (0.25, 0.95))
        return Material(
            pattern="plain", color=color, second=color, roughness=rng.uniform(0.15, 0.5), coat=rng.choice([0.0, 0.6])
        )

    def metal(self) -> Material:
        """Steel, brass, blackened iron."""
        rng = self._rng
        color = rng.choice([(0.62, 0.62, 0.64), (0.75, 0.53, 0.25), (0.06, 0.06, 0.065), (0.7, 0.38, 0.25)])
        return Material(pattern="metal", color=color, second=color, roughness=rng.uniform(0.12, 0.45), metallic=1.0)

    def stone(self) -> Material:
        """Counters, basins, paving."""
        rng = self._rng
        color = tone(rng, rng.choice([0.08, 0.6]), (0.02, 0.12), (0.35, 0.9))
        vein = tone(rng, 0.08, (0.05, 0.2), (0.15, 0.6))
        pattern: Pattern = rng.choice(["marble", "speckle", "plaster"])
        return Material(
            pattern=pattern, color=color, second=vein, roughness=rng.uniform(0.1, 0.6), scale=rng.uniform(0.6, 1.6)
        )

    def ceramic(self) -> Material:
        """Glazed crockery and sanitary ware."""
        rng = self._rng
        color = tone(rng, rng.choice([self.accent_hue, 0.1]), (0.0, 0.35), (0.6, 0.95))
        return Material(pattern="plain", color=color, second=color, roughness=0.18, coat=0.7)

    def anything(self) -> Material:
        """Any material of a small object."""
        return self._rng.choice([self.wood, self.paint, self.metal, self.ceramic, self.stone, self.cloth])()
