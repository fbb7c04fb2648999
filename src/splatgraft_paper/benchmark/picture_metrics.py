"""Metrics of a picture by what is known of its view: truth, mask, the scene without the object, the composite."""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.flip import flip_map
from splatgraft.core.image_metrics import psnr, ssim, ssim_map
from splatgraft.core.images import LUMINANCE
from splatgraft.evaluation.light_change import describe_change
from splatgraft.evaluation.measure import SMALLEST_REGION, Perceptual
from splatgraft.evaluation.regions import Truth
from splatgraft_paper.benchmark.view_metrics import measure_view

_SSIM_BORDER = 5
"""Pixels of SSIM's window beyond its centre."""


@dataclass(frozen=True)
class KnownView:
    """What is known of a view; all of one size, sRGB in [0, 1]."""

    truth: Float[Tensor, "h w 3"] | None = None
    """With the object really in the scene."""
    mask: Float[Tensor, "h w"] | None = None
    """Coverage by the object, in [0, 1]."""
    background: Float[Tensor, "h w 3"] | None = None
    """Without the object."""
    composite: Float[Tensor, "h w 3"] | None = None
    """With the object pasted in."""


def measure_picture(
    image: Float[Tensor, "h w 3"], known: KnownView, perceptual: Perceptual | None = None
) -> dict[str, float]:
    """Compute every metric that what is known allows.

    Args:
        image: A method's picture of the view, sRGB in [0, 1].
        known: Of the same view.
        perceptual: Adds LPIPS.

    Returns:
        With a truth: `psnr_whole`, `ssim_whole`, `ssim_padded_whole`, `flip_whole`, and `lpips_whole` where asked for;
        with a mask also those of the object; with a background too, those of the shadow and of the rest. With a
        composite and a mask, whether or not there is a truth: `object_brightness`, `darkened_fraction`,
        `brightened_fraction` (`describe_change`), `detail_kept` (gradients on the object over those of the composite)
        and `rest_mean_change` (away from object and shadow; only without a truth). nan where a region is too small.
    """
    out: dict[str, float] = {}
    if known.truth is not None and known.mask is not None and known.background is not None:
        truth = Truth(image=known.truth, background=known.background, mask=known.mask)
        out |= measure_view(image, truth, background=known.background, perceptual=perceptual)
    elif known.truth is not None:
        out |= _whole_and_object(image, known.truth, known.mask, perceptual)
    if known.truth is not None:
        out["ssim_padded_whole"] = float(padded_ssim(image, known.truth))
    if known.composite is not None and known.mask is not None:
        out |= _change(image, known.composite, known.mask, with_truth=known.truth is not None)
    return out


def padded_ssim(image: Float[Tensor, "h w c"], reference: Float[Tensor, "h w c"]) -> Float[Tensor, ""]:
    """SSIM as 3DGS computes it: the images go on as zeros beyond their borders, and border pixels count."""
    pads = (0, 0, _SSIM_BORDER, _SSIM_BORDER, _SSIM_BORDER, _SSIM_BORDER)
    return ssim(F.pad(image, pads), F.pad(reference, pads))


def _whole_and_object(
    image: Float[Tensor, "h w 3"],
    truth: Float[Tensor, "h w 3"],
    mask: Float[Tensor, "h w"] | None,
    perceptual: Perceptual | None,
) -> dict[str, float]:
    similarity, visible = ssim_map(image, truth).mean(-1), flip_map(image, truth)
    out = {
        "psnr_whole": float(psnr(image, truth)),
        "ssim_whole": float(similarity.mean()),
        "flip_whole": float(visible.mean()),
    }
    if perceptual is not None:
        out["lpips_whole"] = float(perceptual(image, truth))
    if mask is None:
        return out
    inside = mask > 0.5
    inner = inside[_SSIM_BORDER:-_SSIM_BORDER, _SSIM_BORDER:-_SSIM_BORDER]
    large_enough = int(inner.sum()) >= SMALLEST_REGION
    out["psnr_object"] = float(psnr(image, truth, inside)) if large_enough else math.nan
    out["ssim_object"] = float(similarity[inner].mean()) if large_enough else math.nan
    out["flip_object"] = float(visible[inside].mean()) if large_enough else math.nan
    if perceptual is not None:
        mixed = torch.where(inside[..., None], image, truth)
        out["lpips_object"] = float(perceptual(mixed, truth)) if large_enough else math.nan
    return out


def _change(
    image: Float[Tensor, "h w 3"], composite: Float[Tensor, "h w 3"], mask: Float[Tensor, "h w"], *, with_truth: bool
) -> dict[str, float]:
    """What was done to the composite: needs no truth."""
    out = describe_change(image, composite, mask)
    inside = mask > 0.5
    before, after = _gradient(composite)[inside].sum(), _gradient(image)[inside].sum()
    large_enough = int(inside.sum()) >= SMALLEST_REGION and float(before) > 0
    out["detail_kept"] = float(after / before) if large_enough else math.nan
    if not with_truth:
        rest = mask <= 0
        out["rest_mean_change"] = float((image - composite).abs().amax(-1)[rest].mean()) if rest.any() else math.nan
    return out


def _gradient(image: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w"]:
    """Length of the gradient of luminance, by forward differences; zero in the last row and column."""
    grey = image @ LUMINANCE.to(image)
    rows, columns = F.pad(grey.diff(dim=0), (0, 0, 0, 1)), F.pad(grey.diff(dim=1), (0, 1))
    return torch.hypot(rows, columns)
