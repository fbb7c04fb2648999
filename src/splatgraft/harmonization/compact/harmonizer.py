"""The harmoniser `compact`: the network runs at a low resolution, and its output is applied at full resolution."""

import torch
import torch.nn.functional as F

from splatgraft.core.images import srgb_from_linear
from splatgraft.harmonization.compact.features import apply_output, compact_input
from splatgraft.harmonization.compact.network import CompactNetwork
from splatgraft.harmonization.interface import Harmonized, HarmonizerInputs

_STRIDE = 16  # the network halves the image four times
_LONG_SIDE = 256  # pixels of the longer side of the network's input; smaller views are not enlarged
_HALF_CONFIDENCE_ERROR = 0.05  # sRGB; the expected error at which the confidence is one half


class Compact:
    """Harmoniser that corrects the prior by a small network, in one deterministic step."""

    def __init__(self, network: CompactNetwork, *, device: torch.device, strength: float = 1.0) -> None:
        """Move `network` to `device`; `strength` in [0, 1] scales the correction (0 returns the prior)."""
        self._network, self._device, self._strength = network.to(device), device, strength

    @torch.no_grad()
    def harmonize(self, view: HarmonizerInputs) -> Harmonized:
        """Correct the prior and estimate the confidence; return the prior itself if no object is visible."""
        if float(view.mask.max()) < 0.5:
            return Harmonized(image=view.prior)
        full_size = compact_input(view).to(self._device)
        h, w = view.mask.shape
        factor = min(1.0, _LONG_SIDE / max(h, w))
        small = full_size.resized(*(max(_STRIDE, round(side * factor / _STRIDE) * _STRIDE) for side in (h, w)))
        output = self._network(small.channels())
        image = srgb_from_linear(apply_output(full_size, output)[0].clamp(0, 1)).permute(1, 2, 0).cpu()
        error = F.interpolate(output.log_error, size=(h, w), mode="bilinear", align_corners=False)[0, 0].exp().cpu()
        return Harmonized(
            image=torch.lerp(view.prior, image, self._strength),
            confidence=1 / (1 + (error / _HALF_CONFIDENCE_ERROR) ** 2),
        )
