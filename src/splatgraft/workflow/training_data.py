"""Options of the training data of `train flux` and `train removal`."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class DataOptions:
    """Folders of pairs, their mixture and their size."""

    pairs: tuple[Path, ...] = ()
    """Folders that `splatgraft synth pairs` rendered."""
    generated: tuple[Path, ...] = ()
    """Folders that `splatgraft synth generated` made."""
    orida: tuple[Path, ...] = ()
    """Folders that `splatgraft synth orida` made."""
    weights: tuple[float, ...] = ()
    """Relative frequency of each folder, in the order above; the numbers of pairs where not given."""
    size: str = "704x496"
    """Pixels of a training picture, WIDTHxHEIGHT, multiples of 16."""
    held_out: float = 0.05
    """Share of the scenes that are kept for validation and never trained on."""
