"""The values `SceneFile` and `SceneMetadata`: a trained scene as a file holds it, and what is known of its frame."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from splatgraft.core.gaussians import Gaussians

_WORDS = {"R": "right", "L": "left", "U": "up", "D": "down", "B": "back", "F": "front"}


@dataclass(frozen=True)
class SceneMetadata:
    """Up direction and size of the world in which Gaussians are given, where they are known."""

    up: tuple[float, float, float] | None = None
    """Unit vector, in the frame of the Gaussians."""
    metres_per_unit: float | None = None
    """Above 0."""

    @property
    def known(self) -> dict[str, tuple[float, float, float] | float]:
        """The fields that are known, by their names."""
        return {name: value for name, value in vars(self).items() if value is not None}


def stated_metadata(up: Sequence[float] | None, metres_per_unit: float | None) -> SceneMetadata:
    """What a file states; a direction without length and a size of 0 or less state nothing."""
    length = 0.0 if up is None else math.hypot(*up)
    unit = (up[0] / length, up[1] / length, up[2] / length) if up is not None and length > 0 else None
    return SceneMetadata(unit, metres_per_unit if metres_per_unit is not None and metres_per_unit > 0 else None)


@dataclass(frozen=True)
class SceneFile:
    """A trained scene that was read from a file."""

    gaussians: Gaussians
    """In the file's order; axes as in a .ply of the original code where the format has others."""
    axes: str = "RDF"
    """Directions of x, y and z in the file (right or left, up or down, back or front); what was turned to RDF."""
    metadata: SceneMetadata = SceneMetadata()
    """What the file states of the frame of `gaussians`."""
    notes: tuple[str, ...] = ()
    """Sentences for the user: what is left out, and conventions that differ from a .ply of the original code."""

    def said(self) -> tuple[str, ...]:
        """Sentences for the user: number and degree, axes, and the notes."""
        g, metres = self.gaussians, self.metadata.metres_per_unit
        turned = "as in a .ply of structure from motion" if self.axes == "RDF" else "turned to RDF"
        words = ", ".join(f"{name} {_WORDS[letter]}" for name, letter in zip("xyz", self.axes, strict=True))
        size = () if metres is None else (f"it says that one unit is {metres:.4g} m; `splatgraft scale` takes it over",)
        return (
            f"{g.count:,} Gaussians, SH degree {g.sh_degree}",
            *size,
            f"its axes are taken to be {self.axes} ({words}), {turned}; other ones are named by --axes",
            *self.notes,
        )
