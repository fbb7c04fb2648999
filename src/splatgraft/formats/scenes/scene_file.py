"""The value `SceneFile`: a trained scene as a file holds it, and what was found or assumed of its conventions."""

from dataclasses import dataclass

from splatgraft.core.gaussians import Gaussians

_WORDS = {"R": "right", "L": "left", "U": "up", "D": "down", "B": "back", "F": "front"}


@dataclass(frozen=True)
class SceneFile:
    """A trained scene that was read from a file."""

    gaussians: Gaussians
    """In the file's order; axes as in a .ply of the original code where the format has others."""
    axes: str = "RDF"
    """Directions of x, y and z in the file (right or left, up or down, back or front); what was turned to RDF."""
    up: tuple[float, float, float] | None = None
    """Up direction in the frame of `gaussians`, where the file states one."""
    metres_per_unit: float | None = None
    """Size of a unit, where the file states it."""
    notes: tuple[str, ...] = ()
    """For the user: conventions that differ from a .ply of the original code, and how they were found."""

    def said(self) -> tuple[str, ...]:
        """Sentences for the user: number and degree, axes, and the notes."""
        g = self.gaussians
        turned = "as in a .ply of structure from motion" if self.axes == "RDF" else "turned to RDF"
        words = ", ".join(f"{name} {_WORDS[letter]}" for name, letter in zip("xyz", self.axes, strict=True))
        metres = self.metres_per_unit
        size = () if metres is None else (f"it says that one unit is {metres:.4g} m; `splatgraft scale` takes it over",)
        return (
            f"{g.count:,} Gaussians, SH degree {g.sh_degree}",
            *size,
            f"its axes are taken to be {self.axes} ({words}), {turned}; other ones are named by --axes",
            *self.notes,
        )
