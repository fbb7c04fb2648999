"""Numbers for pictures against ground truth, per view and over views. Knows nothing about scenes, files or methods."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from splatgraft.core.image_metrics import psnr, ssim_map
from splatgraft.evaluation.regions import Regions, Truth, find_regions, luminance_ratio

Perceptual = Callable[[Tensor, Tensor], Tensor]
"""A distance between two sRGB images (h, w, 3), such as LPIPS."""

SMALLEST_REGION = 25
"""Pixels under which a region of a view says nothing and is left out of the mean."""


@dataclass(frozen=True)
class ComparedView:
    """One view of copy-paste and result beside the truth."""

    name: str
    """The view's name."""
    held_out: bool
    """Whether no step before has seen a picture of this view."""
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
    """All metrics of one image; nan where a region of the view is too small to speak.

    `background` is a render of the scene without the object, so that errors of reconstruction cancel in
    `shadow_ratio_rmse` and `rest_*_change`. Without `perceptual` there is no "lpips".
    """
    similarity = ssim_map(image, truth.image).mean(-1)
    inner = (slice(5, -5), slice(5, -5))
    out = {"psnr": float(psnr(image, truth.image)), "ssim": float(similarity.mean())}
    for name in ("object", "shadow", "rest"):
        region = getattr(regions, name)
        speaks = int(region.sum()) >= SMALLEST_REGION
        out[f"{name}_psnr"] = float(psnr(image, truth.image, region)) if speaks else math.nan
        speaks = int(region[inner].sum()) >= SMALLEST_REGION
        out[f"{name}_ssim"] = float(similarity[region[inner]].mean()) if speaks else math.nan
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
    """The content of metrics.json: copy-paste and result side by side; nothing in it is nan, missing is null.

    `copy_paste` and `result` hold the means over held-out views, or over all where none is held out (`views` says
    which); `all_views` holds both over every view; `per_view` holds every number. `rest_max_change` is a maximum over
    views, the rest are means over the views that speak.
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
