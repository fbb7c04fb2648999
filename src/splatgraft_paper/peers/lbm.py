"""LBM relighting (Chadebec et al. 2025) through the user's own installation of its package.

The package (github.com/gojasper/LBM) and its weights are CC BY-NC: they are neither shipped nor downloaded by default.
Untested with the real package and weights.
"""

from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from PIL import Image

from splatgraft.harmonization.interface import Harmonized, HarmonizerInputs
from splatgraft.harmonization.options import HarmonizerContext
from splatgraft_paper.peers.options import LbmOptions

_WEIGHTS = "jasperai/LBM_relighting"


class LBM:
    """Latent bridge matching in one step from the composite to the relit image."""

    def __init__(self, model: Any, evaluate: Any, steps: int) -> None:
        """Use a model and the function `evaluate` of `lbm.inference`."""
        self._model, self._evaluate, self._steps = model, evaluate, steps

    def harmonize(self, view: HarmonizerInputs) -> Harmonized:
        """Relight the composite; pixels outside the object keep the composite's colours, as in the authors' code."""
        given = Image.fromarray((view.composite * 255).round().to(torch.uint8).numpy())
        made = (
            self._evaluate(self._model, given, self._steps).convert("RGB").resize(given.size, Image.Resampling.BICUBIC)
        )
        image = torch.from_numpy(np.array(made)).float() / 255
        return Harmonized(torch.lerp(view.composite, image, view.mask[..., None].clamp(0, 1)))


def load_lbm(options: LbmOptions, context: HarmonizerContext) -> LBM:
    """The network by `options.weights`, or the published one.

    Raises:
        ValueError: the package is missing.
    """
    if find_spec("lbm") is None:
        raise ValueError(
            "harmonizer lbm: expected the package lbm (pip install git+https://github.com/gojasper/LBM, licence CC "
            "BY-NC 4.0), found none"
        )
    from lbm.inference import evaluate, get_model  # pyright: ignore

    weights = options.weights or _WEIGHTS
    context.say(f"lbm: {weights}, licence CC BY-NC 4.0")
    model = get_model(weights, torch_dtype=torch.bfloat16, device=str(context.device))
    return LBM(model, evaluate, 1)
