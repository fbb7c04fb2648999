"""Harmonize: one view at a time, an image model makes the light agree. Knows nothing about scenes or other views."""

from collections.abc import Callable

from splatgraft.harmonize.compact.registered import make_compact
from splatgraft.harmonize.flux.registered import make_flux
from splatgraft.harmonize.interface import BatchHarmonizer, Harmonized, Harmonizer, HarmonizerInputs
from splatgraft.harmonize.keep import KeepPrior
from splatgraft.harmonize.options import HarmonizerOptions
from splatgraft.harmonize.peers.registered import make_ic_light, make_image_editing, make_lbm, make_mv_colight
from splatgraft.harmonize.reinhard import Reinhard

__all__ = [
    "HARMONIZERS",
    "BatchHarmonizer",
    "Harmonized",
    "Harmonizer",
    "HarmonizerInputs",
    "HarmonizerOptions",
    "make_harmonizer",
]

HARMONIZERS: dict[str, Callable[[HarmonizerOptions], Harmonizer]] = {
    "none": lambda options: KeepPrior(),
    "reinhard": lambda options: Reinhard(),
    "compact": make_compact,
    "flux": make_flux,
    "lbm": make_lbm,
    "ic-light": make_ic_light,
    "mv-colight": make_mv_colight,
    "image-editing": make_image_editing,
}
"""Name to maker; a maker imports what is heavy only when called."""


def make_harmonizer(name: str, options: HarmonizerOptions | None = None) -> Harmonizer:
    """The harmoniser called `name`.

    Raises: ValueError where there is none of that name (the message lists those there are), or where its weights or
    packages are missing.
    """
    if name not in HARMONIZERS:
        raise ValueError(f"harmonizer: expected one of {', '.join(sorted(HARMONIZERS))}, found {name!r}")
    return HARMONIZERS[name](options or HarmonizerOptions())
