"""Which pairs `train flux` and `train removal` are given. Does no work."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class DataOptions:
    """Which pairs, how they are mixed and how large they are."""

    pairs: tuple[Path, ...] = ()
    """Folders that `splatgraft synth pairs` rendered."""
    generated: tuple[Path, ...] = ()
    """Folders that `splatgraft synth generated` made."""
    orida: tuple[Path, ...] = ()
    """Folders that `splatgraft synth orida` made."""
    weights: tuple[float, ...] = ()
    """How often each folder is drawn from, in the order above; by their numbers of pairs where not given."""
    size: str = "704x496"
    """Pixels of a training picture, WIDTHxHEIGHT, multiples of 16."""
    held_out: float = 0.05
    """Share of the scenes that are kept for validation and never trained on."""
