"""Which pixels of a view are object, shadow and untouched rest, by the ground truth. Knows nothing about any method."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.images import linear_from_srgb

SHADOW_RATIO = 0.95
"""Linear light with the object over linear light without it, below which a pixel counts as shadowed."""
_LUMINANCE = torch.tensor([0.2126, 0.7152, 0.0722])
_TOUCHED = 2 / 255
_DARKEST = 0.002


@dataclass(frozen=True)
class Truth:
    """One view as it should look, and as it looked before."""

    image: Float[Tensor, "h w 3"]
    """The target scene with the object really in it, sRGB in [0, 1]."""
    background: Float[Tensor, "h w 3"]
    """The same view without the object, sRGB in [0, 1]."""
    mask: Float[Tensor, "h w"]
    """The object's coverage in [0, 1]."""


@dataclass(frozen=True)
class Regions:
    """Parts of a view; disjoint. What is in none of them is penumbra, bounce or edge, and counts in the whole image."""

    object: Bool[Tensor, "h w"]
    """Covered by the object by more than half."""
    shadow: Bool[Tensor, "h w"]
    """Outside the object, with linear luminance (mean of 3x3) under `SHADOW_RATIO` of what it was."""
    rest: Bool[Tensor, "h w"]
    """Far from all that the object changed: the ground truth says that nothing happened here."""


def find_regions(truth: Truth) -> Regions:
    """Regions of one view, from its ground truth alone."""
    inside = truth.mask > 0.5
    margin = max(2, round(truth.mask.shape[1] / 100))
    near_object = _grown(truth.mask > 0, 2)
    shadow = (luminance_ratio(truth.image, truth.background) < SHADOW_RATIO) & ~near_object
    change = _mean_3x3((truth.image - truth.background).abs().amax(-1))
    rest = ~_grown((change > _TOUCHED) | near_object | shadow, margin)
    return Regions(object=inside, shadow=shadow, rest=rest)


def luminance_ratio(image: Float[Tensor, "h w 3"], background: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w"]:
    """Linear Rec. 709 luminance of `image` over that of `background`, each averaged over 3x3 against sensor noise."""
    above, below = (_mean_3x3(linear_from_srgb(x) @ _LUMINANCE.to(x)) for x in (image, background))
    # 0.002 in linear light is 6/255 in sRGB: under it 8 bits cannot tell a shadow
    return (above + _DARKEST) / (below + _DARKEST)


def _mean_3x3(values: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    return torch.from_numpy(cv2.blur(values.detach().numpy(), (3, 3), borderType=cv2.BORDER_REPLICATE))


def _grown(region: Bool[Tensor, "h w"], pixels: int) -> Bool[Tensor, "h w"]:
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1, 2 * pixels + 1))
    return torch.from_numpy(cv2.dilate(region.numpy().astype(np.uint8), kernel)) > 0
