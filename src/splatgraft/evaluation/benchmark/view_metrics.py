"""Numbers of one method in one view and between neighbouring views. Knows no methods, files or scenes."""

import math
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.evaluation.measure import SMALLEST_REGION, Perceptual, compare
from splatgraft.evaluation.regions import Regions, Truth, find_regions

REGIONS = ("whole", "object", "shadow", "rest")
"""What every metric is taken over; `shadow` is the band that the true object darkens by more than 5%."""
_SAME_SURFACE = 0.02
"""Relative difference of depth under which two views see the same point: 16-bit depth and slanted surfaces."""


def measure_view(
    image: Float[Tensor, "h w 3"],
    truth: Truth,
    *,
    background: Float[Tensor, "h w 3"],
    perceptual: Perceptual | None = None,
) -> dict[str, float]:
    """PSNR, SSIM and LPIPS of every region, and the error of the shadow's strength; nan where a region says nothing.

    Keys are `psnr_whole`, `lpips_shadow`, ... A region's LPIPS is that of the truth with the region's pixels taken from
    `image`, so that nothing else counts. `background` is the method's own picture without the object.
    """
    regions = find_regions(truth)
    plain = compare(image, truth, regions=regions, background=background)
    out = {"psnr_whole": plain["psnr"], "ssim_whole": plain["ssim"]}
    for name in REGIONS[1:]:
        out |= {f"psnr_{name}": plain[f"{name}_psnr"], f"ssim_{name}": plain[f"{name}_ssim"]}
    out |= {name: plain[name] for name in ("shadow_ratio_rmse", "rest_mean_change", "rest_max_change")}
    if perceptual is not None:
        for name in REGIONS:
            mixed = only_region(image, truth, regions, name)
            out[f"lpips_{name}"] = math.nan if mixed is None else float(perceptual(mixed, truth.image))
    return out


def only_region(
    image: Float[Tensor, "h w 3"], truth: Truth, regions: Regions, name: str
) -> Float[Tensor, "h w 3"] | None:
    """The truth with one region's pixels taken from `image`; None where the region is too small to speak."""
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
    """The picture of the second of two cameras as the first would see it, and where both see the same point.

    `depth` is the second camera's, `into_depth` the first's, along the optical axis, 0 where there is nothing.
    """
    first, second = cameras[0], cameras[1]
    h, w = into_depth.shape
    rows, columns = torch.meshgrid(torch.arange(h) + 0.5, torch.arange(w) + 0.5, indexing="ij")
    rays = torch.stack([columns, rows, torch.ones_like(rows)], -1) @ torch.linalg.inv(first.intrinsics[0]).T
    points = rays * into_depth[..., None]
    moved = torch.linalg.inv(second.world_from_camera[0]) @ first.world_from_camera[0]
    points = points @ moved[:3, :3].T + moved[:3, 3]
    z = points[..., 2]
    there = (into_depth > 0) & (z > 1e-6)
    pixels = (points @ second.intrinsics[0].T)[..., :2] / torch.where(there, z, torch.ones_like(z))[..., None]
    size = torch.tensor([image.shape[1], image.shape[0]], dtype=torch.float32)
    inside = ((pixels > 1) & (pixels < size - 1)).all(-1)
    grid = (pixels / size * 2 - 1)[None]
    stacked = torch.cat([image, depth[..., None]], -1).permute(2, 0, 1)[None]
    seen = torch.nn.functional.grid_sample(stacked[:, :3], grid, align_corners=False)[0].permute(1, 2, 0)
    # depth is not mixed across edges
    found = torch.nn.functional.grid_sample(stacked[:, 3:], grid, mode="nearest", align_corners=False)[0, 0]
    same = there & inside & ((found - z).abs() < _SAME_SURFACE * z)
    return seen, same


def disagreement(
    images: Mapping[int, Float[Tensor, "h w 3"]],
    depths: Sequence[Float[Tensor, "h w"]],
    masks: Sequence[Float[Tensor, "h w"]],
    cameras: Cameras,
) -> float | None:
    """RMSE in sRGB between neighbouring views on and around the object, one warped into the other by the true depth.

    Neighbours are views that follow one another; around is within a quarter of the picture's width. None where no
    neighbours have pictures. Real gloss differs between views too: compare with what the truth itself gives.
    """
    squares, count = 0.0, 0
    for i in sorted(images):
        if i + 1 not in images:
            continue
        seen, same = warp(images[i + 1], depths[i + 1], cameras=cameras[[i, i + 1]], into_depth=depths[i])
        reach = images[i].shape[1] // 8 * 2 + 1
        near = torch.nn.functional.max_pool2d(masks[i][None, None], reach, 1, reach // 2)[0, 0] > 0.5
        region = same & near
        squares += float(((seen - images[i])[region] ** 2).sum())
        count += 3 * int(region.sum())
    return math.sqrt(squares / count) if count >= 3 * SMALLEST_REGION else None
