"""Harmonisers by other authors and a baseline, for comparison: their options, each of which makes its harmoniser."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

from splatgraft.harmonization.interface import Harmonizer
from splatgraft.harmonization.methods import HARMONIZERS, harmonizer_options
from splatgraft.harmonization.options import HarmonizerContext, HarmonizerOptions
from splatgraft_paper.peers.reinhard import Reinhard


@dataclass(frozen=True)
class ReinhardOptions:
    """Match the object's colour statistics to its surroundings (Reinhard et al. 2001); a baseline."""

    name: ClassVar[str] = "reinhard"

    def make(self, context: HarmonizerContext) -> Harmonizer:
        """Make the harmoniser."""
        return Reinhard()


@dataclass(frozen=True)
class LbmOptions:
    """LBM relighting (Chadebec et al. 2025), run through your own installation of its package."""

    name: ClassVar[str] = "lbm"

    weights: str | None = None
    """Folder or hub id of the weights; the published ones where not given."""

    def make(self, context: HarmonizerContext) -> Harmonizer:
        """Make the harmoniser."""
        from splatgraft_paper.peers.lbm import load_lbm

        return load_lbm(self, context)


@dataclass(frozen=True)
class MVCoLightOptions:
    """MV-CoLight's network for single pictures (Ren et al. 2025), run in your own checkout of its code."""

    name: ClassVar[str] = "mv-colight"

    weights: str | None = None
    """Folder with config.py and model_step_N.pt; must be given."""
    checkout: Path | None = None
    """Folder of its code; must be given."""

    def make(self, context: HarmonizerContext) -> Harmonizer:
        """Make the harmoniser."""
        from splatgraft_paper.peers.mv_colight import load_mv_colight

        return load_mv_colight(self)


@dataclass(frozen=True)
class ImageEditingOptions:
    """An image-editing service over HTTP with the paper's prompt (Sec. 7); your pictures leave this machine."""

    name: ClassVar[str] = "image-editing"

    weights: str | None = None
    """Address of the service; the paper's where not given."""
    max_cost: float = 0.0
    """US dollars that may be spent at most."""

    def make(self, context: HarmonizerContext) -> Harmonizer:
        """Make the harmoniser."""
        from splatgraft_paper.peers.image_editing import connect_image_editing

        return connect_image_editing(self, context)


PEERS = {kind.name: kind for kind in (ReinhardOptions, LbmOptions, MVCoLightOptions, ImageEditingOptions)}
"""Name of a method to its options."""


def method_options(name: str, *, weights: str | None = None) -> HarmonizerOptions:
    """Give the default options of a method, ours or another project's.

    Args:
        name: A key of `HARMONIZERS` or of `PEERS`.
        weights: Replaces the default weights; ignored by methods without weights.

    Raises:
        ValueError: There is no method of that name.
    """
    if name in PEERS:
        options = PEERS[name]()
        return replace(options, weights=weights) if weights is not None and hasattr(options, "weights") else options
    if name not in HARMONIZERS:
        raise ValueError(f"harmonizer: expected one of {', '.join(sorted([*HARMONIZERS, *PEERS]))}, found {name!r}")
    return harmonizer_options(name, weights=weights)
