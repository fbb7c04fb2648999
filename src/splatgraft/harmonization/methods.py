"""The harmonisation methods: the options class of each by name, and the harmoniser that options make."""

from collections.abc import Callable
from dataclasses import replace
from typing import get_args

from splatgraft.harmonization.compact.factory import make_compact
from splatgraft.harmonization.flux.factory import make_flux
from splatgraft.harmonization.identity import IdentityHarmonizer
from splatgraft.harmonization.interface import Harmonizer
from splatgraft.harmonization.options import (
    CompactOptions,
    FluxOptions,
    HarmonizerContext,
    HarmonizerOptions,
    NoneOptions,
)

HARMONIZERS: dict[str, type[HarmonizerOptions]] = {kind.name: kind for kind in get_args(HarmonizerOptions)}
"""Name of a method to its options."""

_FACTORIES: dict[type, Callable[..., Harmonizer]] = {
    NoneOptions: lambda options, context: IdentityHarmonizer(),
    CompactOptions: make_compact,
    FluxOptions: make_flux,
}
"""Options to the factory function, which imports its heavy libraries only when it is called."""


def make_harmonizer(method: str | HarmonizerOptions, context: HarmonizerContext = HarmonizerContext()) -> Harmonizer:
    """Make a harmoniser.

    Args:
        method: Its options, or its name for the default options.
        context: Device, number and size of the views, and where messages go.

    Raises:
        ValueError: There is no method of that name (the message lists the names), or its weights or packages are
            missing.
    """
    options = harmonizer_options(method) if isinstance(method, str) else method
    make = getattr(options, "make", None)  # options of other packages make their harmoniser themselves
    return make(context) if make else _FACTORIES[type(options)](options, context)


def harmonizer_options(name: str, *, weights: str | None = None) -> HarmonizerOptions:
    """Give the default options of a method.

    Args:
        name: A key of `HARMONIZERS`.
        weights: Replaces the default weights; ignored by methods without weights.

    Raises:
        ValueError: There is no method of that name.
    """
    if name not in HARMONIZERS:
        raise ValueError(f"harmonizer: expected one of {', '.join(sorted(HARMONIZERS))}, found {name!r}")
    options = HARMONIZERS[name]()
    if weights is None or isinstance(options, NoneOptions):
        return options
    return replace(options, weights=weights)
