"""Factories of the other projects' methods; heavy modules are imported when one is called."""

from splatgraft.harmonization.interface import Harmonizer
from splatgraft.harmonization.options import (
    HarmonizerContext,
    ICLightOptions,
    ImageEditingOptions,
    LbmOptions,
    MVCoLightOptions,
)


def make_lbm(options: LbmOptions, context: HarmonizerContext) -> Harmonizer:
    """Load LBM relighting.

    Raises:
        ValueError: Its package is missing.
    """
    from splatgraft.harmonization.peers.lbm import load_lbm

    return load_lbm(options, context)


def make_ic_light(options: ICLightOptions, context: HarmonizerContext) -> Harmonizer:
    """Load IC-Light.

    Raises:
        ValueError: Its weights are missing.
    """
    from splatgraft.harmonization.peers.ic_light import load_ic_light

    return load_ic_light(options, context)


def make_mv_colight(options: MVCoLightOptions, context: HarmonizerContext) -> Harmonizer:
    """Find MV-CoLight's code and weights.

    Raises:
        ValueError: Its code or weights are missing.
    """
    from splatgraft.harmonization.peers.mv_colight import load_mv_colight

    return load_mv_colight(options)


def make_image_editing(options: ImageEditingOptions, context: HarmonizerContext) -> Harmonizer:
    """Connect to an image-editing service.

    Raises:
        ValueError: The key is missing, or the expected cost is above `options.max_cost`.
    """
    from splatgraft.harmonization.peers.image_editing import connect_image_editing

    return connect_image_editing(options, context)
