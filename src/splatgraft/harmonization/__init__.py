"""Harmonization of rendered views: an image model corrects the light on an inserted object, one view at a time."""

from collections.abc import Callable

from splatgraft.harmonization.compact.factory import make_compact
from splatgraft.harmonization.flux.factory import make_flux
from splatgraft.harmonization.identity import IdentityHarmonizer
from splatgraft.harmonization.interface import BatchHarmonizer, Harmonized, Harmonizer, HarmonizerInputs
from splatgraft.harmonization.options import HarmonizerOptions
from splatgraft.harmonization.peers.factory import make_ic_light, make_image_editing, make_lbm, make_mv_colight
from splatgraft.harmonization.reinhard import Reinhard

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
    "none": lambda options: IdentityHarmonizer(),
    "reinhard": lambda options: Reinhard(),
    "compact": make_compact,
    "flux": make_flux,
    "lbm": make_lbm,
    "ic-light": make_ic_light,
    "mv-colight": make_mv_colight,
    "image-editing": make_image_editing,
}
"""Name to factory function; a factory imports its heavy libraries only when it is called."""


def make_harmonizer(name: str, options: HarmonizerOptions | None = None) -> Harmonizer:
    """The harmoniser called `name`.

    Raises: ValueError where there is none of that name (the message lists those there are), or where its weights or
    packages are missing.
    """
    if name not in HARMONIZERS:
        raise ValueError(f"harmonizer: expected one of {', '.join(sorted(HARMONIZERS))}, found {name!r}")
    return HARMONIZERS[name](options or HarmonizerOptions())
