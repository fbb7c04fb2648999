"""Image metrics against ground truth, per view and as means over views."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from splatgraft.core.flip import flip_map
from splatgraft.core.image_metrics import psnr, ssim_map
from splatgraft.evaluation.regions import Regions, Truth, find_regions, luminance_ratio

Perceptual = Callable[[Tensor, Tensor], Tensor]
"""A distance between two sRGB images (h, w, 3), such as LPIPS."""

SMALLEST_REGION = 25
"""Pixels; smaller regions of a view are left out of the means. Set by hand."""
_SSIM_BORDER = 5
"""Pixels: SSIM's window reaches over the image border there."""


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
        image: sRGB in [0, 1].
        truth: the ground truth.
        regions: of the view, see `find_regions`.
        background: render of the scene without the object, sRGB in [0, 1]; reconstruction errors that it shares with
            `image` cancel in `shadow_ratio_rmse` and `rest_*_change`.
        perceptual: adds "lpips".

    Returns:
        Metric to value; nan where a region of the view has fewer than `SMALLEST_REGION` pixels.
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

    Args:
        views: at least one.
        perceptual: adds "lpips".

    Returns:
        `copy_paste` and `result`: means over held-out views, or over all where none is held out (`views` names which).
        `all_views`: the same over every view. `per_view`: every value. `rest_max_change` is a maximum over views; the
        other metrics are means over the views where they are defined.
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
    regions = find_regions(view.truth)
    row: dict = {"view": view.name, "held_out": view.held_out}
    for name in ("copy_paste", "result"):
        row[name] = compare(
            getattr(view, name).clamp(0, 1),
            view.truth,
            regions=regions,
            background=view.background.clamp(0, 1),
            perceptual=perceptual,
        )
    return row


def _means(rows: Sequence[dict]) -> dict[str, dict[str, float | None]]:
    out: dict[str, dict[str, float | None]] = {}
    for which in ("copy_paste", "result"):
        out[which] = {}
        for name in rows[0][which] if rows else ():
            values = [row[which][name] for row in rows if math.isfinite(row[which][name])]
            joined = max if name == "rest_max_change" else (lambda v: sum(v) / len(v))
            out[which][name] = joined(values) if values else None
    return out


def _without_nan(row: dict) -> dict:
    clean = {which: {k: _finite(v) for k, v in row[which].items()} for which in ("copy_paste", "result")}
    return {**row, **clean}


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
