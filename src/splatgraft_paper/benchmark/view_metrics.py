"""Metrics of one method in one view, and of its consistency between neighbouring views."""

import math
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.evaluation.measure import SMALLEST_REGION, Perceptual, compare
from splatgraft.evaluation.regions import Regions, Truth, find_regions

REGIONS = ("whole", "object", "shadow", "rest")
"""Regions of every metric; `shadow` is the band that the true object darkens by more than 5%."""
_SAME_SURFACE = 0.02
"""Relative difference of depth below which two views see the same point; allows for 16-bit depth and slanted surfaces.
Set by hand."""


def measure_view(
    image: Float[Tensor, "h w 3"],
    truth: Truth,
    *,
    background: Float[Tensor, "h w 3"],
    perceptual: Perceptual | None = None,
) -> dict[str, float]:
    """Compute PSNR, SSIM, FLIP and LPIPS of every region, and the error of the shadow's strength.

    Args:
        image: the method's result, sRGB in [0, 1].
        truth: the ground truth.
        background: the method's render without the object, sRGB in [0, 1].
        perceptual: adds LPIPS. That of a region compares the truth with a copy that has the region's pixels of `image`.

    Returns:
        Keys such as `psnr_whole`, `lpips_shadow` to values; nan where a region is too small.
    """
    regions = find_regions(truth)
    plain = compare(image, truth, regions=regions, background=background)
    out = {"psnr_whole": plain["psnr"], "ssim_whole": plain["ssim"], "flip_whole": plain["flip"]}
    for name in REGIONS[1:]:
        out |= {f"{metric}_{name}": plain[f"{name}_{metric}"] for metric in ("psnr", "ssim", "flip")}
    out |= {name: plain[name] for name in ("shadow_ratio_rmse", "rest_mean_change", "rest_max_change")}
    if perceptual is not None:
        for name in REGIONS:
            mixed = only_region(image, truth, regions, name)
            out[f"lpips_{name}"] = math.nan if mixed is None else float(perceptual(mixed, truth.image))
    return out


def only_region(
    image: Float[Tensor, "h w 3"], truth: Truth, regions: Regions, name: str
) -> Float[Tensor, "h w 3"] | None:
    """The truth with one region's pixels replaced by those of `image`; None where the region is too small."""
    if name == "whole":
        return image
    region: Bool[Tensor, "h w"] = getattr(regions, name)
    return torch.where(region[..., None], image, truth.image) if int(region.sum()) >= SMALLEST_REGION else None


def warp(
    image: Float[Tensor, "h w 3"],
    depth: Float[Tensor, "h w"],
    *,
    cameras: Cameras,
    into_depth: Float[Tensor, "h w"],
) -> tuple[Float[Tensor, "h w 3"], Bool[Tensor, "h w"]]:
    """Warp the second camera's image into the first camera's view.

    Args:
        image: of the second camera.
        depth: of the second camera, along the optical axis; 0 where nothing is hit.
        cameras: the two cameras.
        into_depth: depth of the first camera.

    Returns:
        The warped image, and the pixels where both cameras see the same point.
    """
    first, second = cameras[0], cameras[1]
    h, w = into_depth.shape
    rows, columns = torch.meshgrid(torch.arange(h) + 0.5, torch.arange(w) + 0.5, indexing="ij")
    rays = torch.stack([columns, rows, torch.ones_like(rows)], -1) @ torch.linalg.inv(first.intrinsics[0]).T
    points = rays * into_depth[..., None]
    second_from_first = torch.linalg.inv(second.world_from_camera[0]) @ first.world_from_camera[0]
    points = points @ second_from_first[:3, :3].T + second_from_first[:3, 3]
    z = points[..., 2]
    valid = (into_depth > 0) & (z > 1e-6)
    pixels = (points @ second.intrinsics[0].T)[..., :2] / torch.where(valid, z, torch.ones_like(z))[..., None]
    size = torch.tensor([image.shape[1], image.shape[0]], dtype=torch.float32)
    inside = ((pixels > 1) & (pixels < size - 1)).all(-1)
    grid = (pixels / size * 2 - 1)[None]
    stacked = torch.cat([image, depth[..., None]], -1).permute(2, 0, 1)[None]
    warped = torch.nn.functional.grid_sample(stacked[:, :3], grid, align_corners=False)[0].permute(1, 2, 0)
    # nearest, so that depths on both sides of an edge are not averaged
    found = torch.nn.functional.grid_sample(stacked[:, 3:], grid, mode="nearest", align_corners=False)[0, 0]
    same = valid & inside & ((found - z).abs() < _SAME_SURFACE * z)
    return warped, same


def disagreement(
    images: Mapping[int, Float[Tensor, "h w 3"]],
    depths: Sequence[Float[Tensor, "h w"]],
    masks: Sequence[Float[Tensor, "h w"]],
    cameras: Cameras,
) -> float | None:
    """RMSE in sRGB between consecutive views, near the object, after warping by the true depth.

    True gloss differs between views too, so compare with the value of the ground truth.

    Args:
        images: of a method, by index of the view.
        depths: true depth of all views.
        masks: coverage by the object of all views; pixels within an eighth of the image's width of it are compared.
        cameras: of all views.

    Returns:
        None where no consecutive views have images.
    """
    squares, count = 0.0, 0
    for i in sorted(images):
        if i + 1 not in images:
            continue
        warped, same = warp(images[i + 1], depths[i + 1], cameras=cameras[[i, i + 1]], into_depth=depths[i])
        reach = images[i].shape[1] // 8 * 2 + 1
        near = torch.nn.functional.max_pool2d(masks[i][None, None], reach, 1, reach // 2)[0, 0] > 0.5
        region = same & near
        squares += float(((warped - images[i])[region] ** 2).sum())
        count += 3 * int(region.sum())
    return math.sqrt(squares / count) if count >= 3 * SMALLEST_REGION else None
