"""The values `SceneFile`, a trained scene with notes on its file, and `SceneMetadata`, its up direction and size."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from splatgraft.core.gaussians import Gaussians

_WORDS = {"R": "right", "L": "left", "U": "up", "D": "down", "B": "back", "F": "front"}


@dataclass(frozen=True)
class SceneMetadata:
    """Up direction and size of the world of a scene; None if unknown."""

    up: tuple[float, float, float] | None = None
    """Unit up vector in the frame of the Gaussians."""
    metres_per_unit: float | None = None
    """Metres per world unit, above 0."""

    @property
    def known(self) -> dict[str, tuple[float, float, float] | float]:
        """Known fields by name."""
        return {name: value for name, value in vars(self).items() if value is not None}


def stated_metadata(up: Sequence[float] | None, metres_per_unit: float | None) -> SceneMetadata:
    """Make metadata from a file's values; a direction without length and a size of 0 or less count as unknown."""
    length = 0.0 if up is None else math.hypot(*up)
    unit = (up[0] / length, up[1] / length, up[2] / length) if up is not None and length > 0 else None
    return SceneMetadata(unit, metres_per_unit if metres_per_unit is not None and metres_per_unit > 0 else None)


@dataclass(frozen=True)
class SceneFile:
    """A trained scene that was read from a file."""

    gaussians: Gaussians
    """Gaussians in the file's order, in the axes RDF of a .ply of the original code."""
    axes: str = "RDF"
    """Directions of x, y and z in the file (right or left, up or down, back or front), which were turned to RDF."""
    metadata: SceneMetadata = SceneMetadata()
    """Up direction and size that the file states, in the frame of `gaussians`."""
    notes: tuple[str, ...] = ()
    """Notes for the user: unused parts of the file, and conventions that differ from a .ply of the original code."""

    def said(self) -> tuple[str, ...]:
        """Describe the scene for the user: number and degree, size, axes, and the notes."""
        g, metres = self.gaussians, self.metadata.metres_per_unit
        turned = "as in a .ply of structure from motion" if self.axes == "RDF" else "turned to RDF"
        words = ", ".join(f"{name} {_WORDS[letter]}" for name, letter in zip("xyz", self.axes, strict=True))
        size = () if metres is None else (f"one unit is {metres:.4g} m by the file",)
        return (
            f"{g.count:,} Gaussians, SH degree {g.sh_degree}",
            *size,
            f"its axes are read as {self.axes} ({words}), {turned}; if that is wrong, give --axes",
            *self.notes,
        )
