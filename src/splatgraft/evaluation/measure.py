"""Metrics of pictures against ground truth: regions of a view, metrics of a picture, means over views."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.flip import flip_map
from splatgraft.core.image_metrics import psnr, ssim_map
from splatgraft.core.images import LUMINANCE, linear_from_srgb
from splatgraft.core.posed_images import PosedImages
from splatgraft.runtime.lazy_sequence import LazySequence

SHADOW_RATIO = 0.95
"""Ratio of linear light with the object to that without the object, below which a pixel counts as shadowed."""

# set by hand
_CHANGED = 2 / 255  # sRGB difference with and without the object above which a pixel counts as changed
_RATIO_OFFSET = 0.002  # linear light added to both sides of a ratio: 6/255 in sRGB; below, 8 bits resolve no shadow
_OBJECT_MARGIN_PX = 2  # pixels around the object that belong to no region
_REST_MARGIN = 0.01  # margin between changed pixels and the rest, as a share of the image's width; at least 2 pixels


@dataclass(frozen=True)
class Truth:
    """Ground truth of one view, with and without the object."""

    image: Float[Tensor, "h w 3"]
    """The target scene with the object in it, sRGB in [0, 1]."""
    background: Float[Tensor, "h w 3"]
    """The target scene without the object, in the same view, sRGB in [0, 1]."""
    mask: Float[Tensor, "h w"]
    """Coverage by the object, in [0, 1]."""


@dataclass(frozen=True)
class Regions:
    """Disjoint regions of a view; other pixels (penumbra, bounced light, edges) count only in the whole image."""

    object: Bool[Tensor, "h w"]
    """Pixels that the object covers by more than half."""
    shadow: Bool[Tensor, "h w"]
    """Pixels off the object whose linear luminance (3x3 mean) is below `SHADOW_RATIO` of that without the object."""
    rest: Bool[Tensor, "h w"]
    """Pixels at a distance from all pixels that the object changes in the ground truth."""


def find_regions(truth: Truth) -> Regions:
    """Find the regions of one view from its ground truth."""
    inside = truth.mask > 0.5
    margin = max(2, round(truth.mask.shape[1] * _REST_MARGIN))
    near_object = _dilated(truth.mask > 0, _OBJECT_MARGIN_PX)
    shadow = (luminance_ratio(truth.image, truth.background) < SHADOW_RATIO) & ~near_object
    change = _mean_3x3((truth.image - truth.background).abs().amax(-1))
    rest = ~_dilated((change > _CHANGED) | near_object | shadow, margin)
    return Regions(object=inside, shadow=shadow, rest=rest)


def luminance_ratio(image: Float[Tensor, "h w 3"], background: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w"]:
    """Compute the ratio of linear Rec. 709 luminance, `image` over `background`, each averaged over 3x3 pixels."""
    numerator, denominator = (_mean_3x3(linear_from_srgb(x) @ LUMINANCE.to(x)) for x in (image, background))
    return (numerator + _RATIO_OFFSET) / (denominator + _RATIO_OFFSET)


def _mean_3x3(values: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    return torch.from_numpy(cv2.blur(values.detach().numpy(), (3, 3), borderType=cv2.BORDER_REPLICATE))


def _dilated(region: Bool[Tensor, "h w"], pixels: int) -> Bool[Tensor, "h w"]:
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1, 2 * pixels + 1))
    return torch.from_numpy(cv2.dilate(region.numpy().astype(np.uint8), kernel)) > 0


Perceptual = Callable[[Tensor, Tensor], Tensor]
"""Distance between two sRGB images (h, w, 3), such as LPIPS."""

SMALLEST_REGION = 25
"""Number of pixels below which a region of a view is left out of the means; set by hand."""
_SHOWN = ("copy_paste", "result")  # the pictures of a view that are measured
_SSIM_BORDER = 5  # pixels in which SSIM's window reaches over the image border


@dataclass(frozen=True)
class ComparedView:
    """Copy-paste, result and ground truth of one view."""

    name: str
    """The view's name."""
    held_out: bool
    """Whether no step before the evaluation used a picture of this view."""
    copy_paste: Float[Tensor, "h w 3"]
    """The composite before any light transfer, sRGB in [0, 1]."""
    result: Float[Tensor, "h w 3"]
    """The final scene, sRGB in [0, 1]."""
    background: Float[Tensor, "h w 3"]
    """The reconstructed target scene without the object, sRGB in [0, 1]."""
    truth: Truth
    """The ground truth of this view."""


def compare(
    image: Float[Tensor, "h w 3"],
    truth: Truth,
    *,
    regions: Regions,
    background: Float[Tensor, "h w 3"],
    perceptual: Perceptual | None = None,
) -> dict[str, float]:
    """Compute all metrics of one image.

    Args:
        image: The image, sRGB in [0, 1].
        truth: Ground truth of the view.
        regions: Regions of the view.
        background: A render of the scene without the object, sRGB in [0, 1]. Reconstruction errors that it shares with
            `image` cancel in `shadow_ratio_rmse` and `rest_*_change`.
        perceptual: A distance that becomes the metric "lpips".

    Returns:
        The metrics by name; nan if a region of the view has fewer than `SMALLEST_REGION` pixels.
    """
    similarity = ssim_map(image, truth.image).mean(-1)
    inner = (slice(_SSIM_BORDER, -_SSIM_BORDER), slice(_SSIM_BORDER, -_SSIM_BORDER))
    visible = flip_map(image, truth.image)
    out = {"psnr": float(psnr(image, truth.image)), "ssim": float(similarity.mean()), "flip": float(visible.mean())}
    for name in ("object", "shadow", "rest"):
        region = getattr(regions, name)
        large_enough = int(region.sum()) >= SMALLEST_REGION
        out[f"{name}_psnr"] = float(psnr(image, truth.image, region)) if large_enough else math.nan
        out[f"{name}_flip"] = float(visible[region].mean()) if large_enough else math.nan
        large_enough = int(region[inner].sum()) >= SMALLEST_REGION
        out[f"{name}_ssim"] = float(similarity[region[inner]].mean()) if large_enough else math.nan
    out["shadow_ratio_rmse"] = math.nan
    if int(regions.shadow.sum()) >= SMALLEST_REGION:
        error = luminance_ratio(image, background) - luminance_ratio(truth.image, truth.background)
        out["shadow_ratio_rmse"] = float((error[regions.shadow] ** 2).mean().sqrt())
    change = (image - background).abs().amax(-1)[regions.rest]
    out["rest_max_change"] = float(change.max()) if len(change) else math.nan
    out["rest_mean_change"] = float(change.mean()) if len(change) else math.nan
    if perceptual is not None:
        out["lpips"] = float(perceptual(image, truth.image))
    return out


def measure(views: Sequence[ComparedView], perceptual: Perceptual | None = None) -> dict:
    """Compute the content of metrics.json; missing values are None.

    `copy_paste` and `result` have the means over held-out views, or over all views if no view is held out (`views`
    names which). `all_views` has the means over every view, `per_view` every value. `rest_max_change` is a maximum over
    views; the other metrics are means over the views in which they are defined.
    """
    rows = [_row(view, perceptual) for view in views]
    held_out = [row for row in rows if row["held_out"]]
    everything = _means(rows)
    return {
        "views": "held out" if held_out else "all",
        "view_count": len(held_out or rows),
        **(_means(held_out) if held_out else everything),
        "all_views": {"view_count": len(rows), **everything},
        "per_view": [_without_nan(row) for row in rows],
    }


def _row(view: ComparedView, perceptual: Perceptual | None) -> dict:
    row: dict = {"view": view.name, "held_out": view.held_out}
    for name in _SHOWN:
        row[name] = _compared(getattr(view, name), view.truth, view.background, perceptual)
    return row


def _compared(image: Tensor, truth: Truth, background: Tensor, perceptual: Perceptual | None) -> dict[str, float]:
    """Compute the metrics of an image that may exceed [0, 1], in the view's own regions."""
    image, background = image.clamp(0, 1), background.clamp(0, 1)
    return compare(image, truth, regions=find_regions(truth), background=background, perceptual=perceptual)


def _means(rows: Sequence[dict]) -> dict[str, dict[str, float | None]]:
    return {which: _mean_of([row[which] for row in rows]) for which in _SHOWN}


def _mean_of(rows: Sequence[dict[str, float]]) -> dict[str, float | None]:
    """Compute the mean of each metric over the views in which it is defined; None if there is no such view."""
    means: dict[str, float | None] = {}
    for name in rows[0] if rows else ():
        values = [row[name] for row in rows if math.isfinite(row[name])]
        joined = max if name == "rest_max_change" else (lambda v: sum(v) / len(v))
        means[name] = joined(values) if values else None
    return means


def _without_nan(row: dict) -> dict:
    clean = {which: {k: v if math.isfinite(v) else None for k, v in row[which].items()} for which in _SHOWN}
    return {**row, **clean}


def evaluate(
    images: Sequence[Float[Tensor, "_ _ 3"]],
    truth: Sequence[Truth],
    *,
    backgrounds: Sequence[Float[Tensor, "_ _ 3"]],
    perceptual: Perceptual | None = None,
) -> dict[str, float | None]:
    """Measure the pictures of a result against the ground truth of the same views.

    Args:
        images: v pictures (h, w, 3) of the result, sRGB in [0, 1].
        truth: The ground truth of each view, as `true_views` gives it.
        backgrounds: A render of the target scene without the object for each view, sRGB in [0, 1]. The error of the
            reconstruction itself then cancels in `shadow_ratio_rmse` and `rest_*_change`.
        perceptual: A distance between two (h, w, 3) images such as LPIPS, which becomes the metric "lpips".

    Returns:
        `psnr` (dB), `ssim` and `flip` of the whole image and of the regions object, shadow and rest;
        `shadow_ratio_rmse`, the error of the shadow as a ratio of linear luminance; `rest_max_change` and
        `rest_mean_change` (sRGB). Each is the mean over the views in which its region has at least 25 pixels (the
        maximum for `rest_max_change`), and None if there is no such view.

    Raises:
        ValueError: There is not one truth and one background per picture.
    """
    if not len(images) == len(truth) == len(backgrounds):
        found = f"{len(images)} images, {len(truth)} truths and {len(backgrounds)} backgrounds"
        raise ValueError(f"evaluate: expected one truth and one background per image, found {found}")
    given = zip(images, truth, backgrounds, strict=True)
    return _mean_of([_compared(image, true, background, perceptual) for image, true, background in given])


def true_views(truth: PosedImages, target: PosedImages) -> LazySequence[Truth]:
    """Pair the ground truth's images and masks with the target's images of the same name.

    Args:
        truth: A capture of the target with the real object in it, and a mask of the object for every view.
        target: The capture of the target without the object.

    Returns:
        One `Truth` per view of `truth`, read on access.

    Raises:
        ValueError: A view of the truth has no mask, or no image of the same name in the target.
    """
    for index, path in enumerate(truth.mask_paths or (None,) * len(truth)):
        if path is None:
            raise ValueError(f"{truth.image_paths[index]}: expected a mask of the object, found none")
    index_of = {Path(name).stem: index for index, name in enumerate(target.cameras.names)}
    stems = [Path(name).stem for name in truth.cameras.names]
    if missing := [stem for stem in stems if stem not in index_of]:
        raise ValueError(f"evaluate: expected an image of the target named {missing[0]} as in the truth, found none")

    def read(index: int) -> Truth:
        mask = truth.mask(index)
        assert mask is not None
        return Truth(image=truth.image(index), background=target.image(index_of[stems[index]]), mask=mask)

    return LazySequence(len(truth), read)
