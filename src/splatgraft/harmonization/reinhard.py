"""The harmoniser `reinhard`: the object's colour statistics become those around it; a baseline. Casts no shadow.

Reinhard et al., Color Transfer between Images, 2001: mean and deviation matched per channel in l-alpha-beta.
"""

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
# 1/255 in sRGB is 3e-4 in linear light: below it the logarithm would only amplify quantisation
_DARKEST = 3e-4


class Reinhard:
    """Matches the object's mean and deviation to those of the background in a ring around it."""

    def harmonize(self, view: HarmonizerInputs) -> Harmonized:
        """The prior with the object's colours shifted; unchanged where there is no object or nothing around it."""
        inside = view.mask > 0.5
        around = _ring(inside)
        if int(inside.sum()) < 2 or int(around.sum()) < 2:
            return Harmonized(image=view.prior)
        lab = _lab_from_srgb(view.prior)
        source, wanted = lab[inside], _lab_from_srgb(view.background)[around]
        # a flat object has no deviation to stretch
        stretch = torch.where(source.std(0) > 1e-4, wanted.std(0) / source.std(0).clamp_min(1e-4), 1.0)
        matched = _srgb_from_lab((lab - source.mean(0)) * stretch + wanted.mean(0)).clamp(0, 1)
        return Harmonized(image=torch.lerp(view.prior, matched, view.mask[..., None].clamp(0, 1)))


def _ring(inside: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Pixels outside the object, as far from it as half the square root of its area."""
    reach = max(3, round(float(inside.sum()) ** 0.5 / 2))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    grown = torch.from_numpy(cv2.dilate(inside.numpy().astype(np.uint8), kernel)) > 0
    return grown & ~inside


def _lab_from_srgb(image: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    lms = linear_from_srgb(image).clamp_min(_DARKEST) @ _LMS_FROM_RGB.T
    return lms.log10() @ _LAB_FROM_LOG_LMS.T


def _srgb_from_lab(lab: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    lms = 10 ** (lab @ torch.linalg.inv(_LAB_FROM_LOG_LMS).T)
    return srgb_from_linear(lms @ torch.linalg.inv(_LMS_FROM_RGB).T)
