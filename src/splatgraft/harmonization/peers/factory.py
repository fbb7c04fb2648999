"""Makes the peers from options. Imports nothing heavy before one is called."""

from splatgraft.harmonization.interface import Harmonizer
from splatgraft.harmonization.options import HarmonizerOptions


def make_lbm(options: HarmonizerOptions) -> Harmonizer:
    """LBM relighting.

    Raises: ValueError where its package is missing.
    """
    from splatgraft.harmonization.peers.lbm import load_lbm

    return load_lbm(options)


def make_ic_light(options: HarmonizerOptions) -> Harmonizer:
    """IC-Light, foreground and background.

    Raises: ValueError where its weights are missing.
    """
    from splatgraft.harmonization.peers.ic_light import load_ic_light

    return load_ic_light(options)


def make_mv_colight(options: HarmonizerOptions) -> Harmonizer:
    """MV-CoLight's network for single pictures.

    Raises: ValueError where its code or weights are missing.
    """
    from splatgraft.harmonization.peers.mv_colight import load_mv_colight

    return load_mv_colight(options)


def make_image_editing(options: HarmonizerOptions) -> Harmonizer:
    """An image-editing service, asked with the paper's prompt.

    Raises: ValueError where the key is missing or the cost is above what may be spent.
    """
    from splatgraft.harmonization.peers.image_editing import connect_image_editing

    return connect_image_editing(options)
