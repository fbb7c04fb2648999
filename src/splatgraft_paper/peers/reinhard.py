"""The harmoniser `reinhard`, a baseline: matches the object's colour statistics to those of its surroundings.

Reinhard et al., Color Transfer between Images, 2001: mean and deviation matched per channel in l-alpha-beta. No
shadow is added.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.images import linear_from_srgb, srgb_from_linear
from splatgraft.harmonization.interface import Harmonized, HarmonizerInputs

_LMS_FROM_RGB = torch.tensor([[0.3811, 0.5783, 0.0402], [0.1967, 0.7244, 0.0782], [0.0241, 0.1288, 0.8444]])
_LAB_FROM_LOG_LMS = torch.diag(torch.tensor([3.0, 6.0, 2.0]).rsqrt()) @ torch.tensor(
    [[1.0, 1, 1], [1, 1, -2], [1, -1, 0]]
)


@dataclass(frozen=True)
class ReinhardParameters:
    """Numbers of the colour transfer, set by hand."""

    darkest: float = 3e-4
    """Linear light; smaller values are raised to it. 1/255 in sRGB: below, the logarithm amplifies quantisation."""
    flat_deviation: float = 1e-4
    """Deviation in l-alpha-beta below which a channel of the object is shifted but not scaled."""
    ring_width: float = 0.5
    """Width of the ring around the object whose colours are matched, as a share of the root of the object's area."""
    min_ring_px: int = 3
    """Smallest width of the ring, pixels."""


PARAMETERS = ReinhardParameters()


class Reinhard:
    """Matches the object's mean and deviation to those of the background in a ring around the object."""

    def harmonize(self, view: HarmonizerInputs) -> Harmonized:
        """Shift the object's colours in the prior; unchanged where object or ring has fewer than two pixels."""
        inside = view.mask > 0.5
        around = _ring(inside)
        if int(inside.sum()) < 2 or int(around.sum()) < 2:
            return Harmonized(image=view.prior)
        lab = _lab_from_srgb(view.prior)
        source, surroundings = lab[inside], _lab_from_srgb(view.background)[around]
        flat = PARAMETERS.flat_deviation
        scale = torch.where(source.std(0) > flat, surroundings.std(0) / source.std(0).clamp_min(flat), 1.0)
        matched = _srgb_from_lab((lab - source.mean(0)) * scale + surroundings.mean(0)).clamp(0, 1)
        return Harmonized(image=torch.lerp(view.prior, matched, view.mask[..., None].clamp(0, 1)))


def _ring(inside: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Pixels around the object, outside of it."""
    width = max(PARAMETERS.min_ring_px, round(float(inside.sum()) ** 0.5 * PARAMETERS.ring_width))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * width + 1, 2 * width + 1))
    dilated = torch.from_numpy(cv2.dilate(inside.numpy().astype(np.uint8), kernel)) > 0
    return dilated & ~inside


def _lab_from_srgb(image: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    lms = linear_from_srgb(image).clamp_min(PARAMETERS.darkest) @ _LMS_FROM_RGB.T
    return lms.log10() @ _LAB_FROM_LOG_LMS.T


def _srgb_from_lab(lab: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    lms = 10 ** (lab @ torch.linalg.inv(_LAB_FROM_LOG_LMS).T)
    return srgb_from_linear(lms @ torch.linalg.inv(_LMS_FROM_RGB).T)
