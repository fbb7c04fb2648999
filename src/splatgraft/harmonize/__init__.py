"""Harmonize: one view at a time, an image model makes the light agree. Knows nothing about scenes or other views."""

from collections.abc import Callable

from splatgraft.harmonize.interface import Harmonized, Harmonizer, HarmonizerInputs
from splatgraft.harmonize.keep import KeepPrior
from splatgraft.harmonize.reinhard import Reinhard

__all__ = ["HARMONIZERS", "Harmonized", "Harmonizer", "HarmonizerInputs", "make_harmonizer"]

HARMONIZERS: dict[str, Callable[[], Harmonizer]] = {"none": KeepPrior, "reinhard": Reinhard}
"""Name to maker; a maker imports what is heavy only when called."""


def make_harmonizer(name: str) -> Harmonizer:
    """The harmoniser called `name`.

    Raises: ValueError where there is none of that name; the message lists those there are.
    """
    if name not in HARMONIZERS:
        raise ValueError(f"harmonizer: expected one of {', '.join(sorted(HARMONIZERS))}, found {name!r}")
    return HARMONIZERS[name]()
