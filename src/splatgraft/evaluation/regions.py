"""Regions of a view by its ground truth: object, shadow, and the rest that the object does not change."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.images import LUMINANCE, linear_from_srgb

SHADOW_RATIO = 0.95
"""Linear light with the object over linear light without it, below which a pixel counts as shadowed."""


@dataclass(frozen=True)
class RegionSettings:
    """Thresholds of the regions beside `SHADOW_RATIO`, set by hand."""

    changed: float = 2 / 255
    """sRGB difference with and without the object from which a pixel counts as changed."""
    ratio_offset: float = 0.002
    """Linear light added to both sides of a ratio: 6/255 in sRGB, below which 8 bits do not resolve a shadow."""
    object_margin_px: int = 2
    """Pixels around the object that belong to no region."""
    rest_margin: float = 0.01
    """Margin between changed pixels and the rest, as a share of the image's width; at least 2 pixels."""


SETTINGS = RegionSettings()


@dataclass(frozen=True)
class Truth:
    """Ground truth of one view, with and without the object."""

    image: Float[Tensor, "h w 3"]
    """The target scene with the object in it, sRGB in [0, 1]."""
    background: Float[Tensor, "h w 3"]
    """The same view without the object, sRGB in [0, 1]."""
    mask: Float[Tensor, "h w"]
    """Coverage by the object, in [0, 1]."""


@dataclass(frozen=True)
class Regions:
    """Disjoint regions of a view. Pixels in none of them (penumbra, bounce, edges) count only in the whole image."""

    object: Bool[Tensor, "h w"]
    """More than half covered by the object."""
    shadow: Bool[Tensor, "h w"]
    """Outside the object, with linear luminance (3x3 mean) below `SHADOW_RATIO` of that without the object."""
    rest: Bool[Tensor, "h w"]
    """Away from all pixels that the object changes in the ground truth."""


def find_regions(truth: Truth) -> Regions:
    """Find the regions of one view from its ground truth."""
    inside = truth.mask > 0.5
    margin = max(2, round(truth.mask.shape[1] * SETTINGS.rest_margin))
    near_object = _dilated(truth.mask > 0, SETTINGS.object_margin_px)
    shadow = (luminance_ratio(truth.image, truth.background) < SHADOW_RATIO) & ~near_object
    change = _mean_3x3((truth.image - truth.background).abs().amax(-1))
    rest = ~_dilated((change > SETTINGS.changed) | near_object | shadow, margin)
    return Regions(object=inside, shadow=shadow, rest=rest)


def luminance_ratio(image: Float[Tensor, "h w 3"], background: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w"]:
    """Ratio of linear Rec. 709 luminance, `image` over `background`, each averaged over 3x3 pixels against noise."""
    numerator, denominator = (_mean_3x3(linear_from_srgb(x) @ LUMINANCE.to(x)) for x in (image, background))
    return (numerator + SETTINGS.ratio_offset) / (denominator + SETTINGS.ratio_offset)


def _mean_3x3(values: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    return torch.from_numpy(cv2.blur(values.detach().numpy(), (3, 3), borderType=cv2.BORDER_REPLICATE))


def _dilated(region: Bool[Tensor, "h w"], pixels: int) -> Bool[Tensor, "h w"]:
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1, 2 * pixels + 1))
    return torch.from_numpy(cv2.dilate(region.numpy().astype(np.uint8), kernel)) > 0
