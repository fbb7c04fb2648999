"""The harmoniser `compact`: the network asked at a low resolution, its answer laid on the whole picture."""

import torch
import torch.nn.functional as F

from splatgraft.core.images import srgb_from_linear
from splatgraft.harmonization.compact.features import composed, view_of
from splatgraft.harmonization.compact.network import CompactNetwork
from splatgraft.harmonization.interface import Harmonized, HarmonizerInputs

_LONG_SIDE = 256
_STRIDE = 16
_USUAL_ERROR = 0.05
"""sRGB; an expected error of this size halves the confidence."""


class Compact:
    """Gives the prior a small network's corrections; one step, no noise, the same every time."""

    def __init__(self, network: CompactNetwork, *, device: torch.device, strength: float = 1.0) -> None:
        """`strength`: how much of the correction is made, in [0, 1]."""
        self._network, self._device, self._strength = network.to(device), device, strength

    @torch.no_grad()
    def harmonize(self, view: HarmonizerInputs) -> Harmonized:
        """The corrected prior, and how sure the network is of it; the prior itself where there is no object."""
        if float(view.mask.max()) < 0.5:
            return Harmonized(image=view.prior)
        whole = view_of(view).to(self._device)
        h, w = view.mask.shape
        factor = min(1.0, _LONG_SIDE / max(h, w))
        small = whole.resized(*(max(_STRIDE, round(side * factor / _STRIDE) * _STRIDE) for side in (h, w)))
        answer = self._network(small.channels())
        made = srgb_from_linear(composed(whole, answer)[0].clamp(0, 1)).permute(1, 2, 0).cpu()
        error = F.interpolate(answer.log_error, size=(h, w), mode="bilinear", align_corners=False)[0, 0].exp().cpu()
        return Harmonized(
            image=torch.lerp(view.prior, made, self._strength), confidence=1 / (1 + (error / _USUAL_ERROR) ** 2)
        )
