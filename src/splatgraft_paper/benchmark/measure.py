"""Metrics of a method on one scene: its pictures of held-out views against the truth, and their consistency."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import list_images, read_rgb, write_image
from splatgraft.core.posed_images import PosedImages, held_out
from splatgraft.evaluation.measure import SMALLEST_REGION, Perceptual, Regions, Truth, compare, find_regions
from splatgraft.fitting.perceptual_losses import lpips_vgg
from splatgraft.formats import read_capture, read_gaussians
from splatgraft.project.layout import METRICS_FILE
from splatgraft.project.step import Context, Device, Inputs, choose_device
from splatgraft.rendering import render
from splatgraft_paper.benchmark.scene import HELD_OUT_EVERY
from splatgraft_paper.tables.layout import match_views, pictures


@dataclass(frozen=True)
class MeasureMethod:
    """Comparison of one method with the truth on the held-out views of one scene."""

    truth: Path
    """Capture with the object, with masks."""
    photographs: Path
    """Capture without the object, from the same cameras."""
    target: Path
    """Reconstruction without the object, a .ply; the method's shadow is measured against its renders."""
    out: Path
    """Folder for metrics.json and pictures/."""
    result: Path | None = None
    """The method's scene, a .ply."""
    pictures: Path | None = None
    """Or its pictures, named as the views, or numbered as by 3DGS's render.py: all views or the held-out ones."""
    weights: Path | None = None
    """Folder with LPIPS's weights."""
    lpips: bool = False
    """Whether LPIPS is measured."""
    device: Device = "auto"

    def inputs(self) -> Inputs:
        """List the truth, the result and the pictures."""
        files = {}
        for role, folder in (("truth", self.truth), ("photographs", self.photographs)):
            files[role] = read_capture(folder).image_paths
        files["scenes"] = tuple(path for path in (self.target, self.result) if path is not None)
        found = list_images(self.pictures) if self.pictures is not None and self.pictures.is_dir() else []
        return {**files, "pictures": tuple(found)}

    def write(self, folder: Path, context: Context) -> None:
        """Measure every held-out view and write its picture."""
        truth, photographs = read_capture(self.truth), read_capture(self.photographs)
        if truth.cameras.names != photographs.cameras.names:
            raise ValueError(f"{self.truth}: expected views named as in {self.photographs}, found others")
        chosen = [int(i) for i in torch.nonzero(held_out(len(truth), HELD_OUT_EVERY)).flatten()]
        device = choose_device(self.device, context.console)
        scene = None if self.result is None else read_gaussians(self.result).to(device)
        background = read_gaussians(self.target).to(device)
        perceptual = lpips_vgg(self.weights) if self.lpips else None
        (folder / "pictures").mkdir()
        images = self._images(scene, truth, chosen)
        rows = {}
        for done, index in enumerate(chosen, 1):
            stem = Path(truth.cameras.names[index]).stem
            write_image(folder / "pictures" / f"{stem}.png", images[index])
            without = _picture(background, truth, index)
            rows[stem] = _row(images[index], true_view(truth, photographs, index), without, perceptual)
            context.progress(done, len(chosen), stem)
        values = {name: _mean([row[name] for row in rows.values()]) for name in next(iter(rows.values()))}
        consistency = _consistency(self.truth, truth, images)
        record = {"values": {**values, **consistency}, "views": rows}
        (folder / METRICS_FILE).write_text(json.dumps(record, indent=1, allow_nan=False), encoding="utf-8")

    def _images(
        self, scene: Gaussians | None, truth: PosedImages, chosen: list[int]
    ) -> Mapping[int, Float[Tensor, "h w 3"]]:
        """Return pictures by view: renders of all views of a scene, or a folder's pictures with all held-out views."""
        if scene is not None:
            return {index: _picture(scene, truth, index) for index in range(len(truth))}
        assert self.pictures is not None
        found: dict[int, Tensor] = {}
        stems = [Path(name).stem for name in truth.cameras.names]
        matched, _ = match_views(stems, pictures(self.pictures))
        for index, stem in enumerate(stems):
            path = matched.get(stem, self.pictures / f"{stem}.png")
            if stem in matched:
                found[index] = read_rgb(path)
                wanted = (truth.cameras.sizes[index][1], truth.cameras.sizes[index][0])
                if found[index].shape[:2] != torch.Size([int(wanted[0]), int(wanted[1])]):
                    sizes = f"{wanted[1]}x{wanted[0]} pixels, found {found[index].shape[1]}x{found[index].shape[0]}"
                    raise ValueError(f"{path}: expected {sizes}")
            elif index in chosen:
                raise ValueError(f"{path}: expected the method's picture of a held-out view, found none")
        return found


def true_view(truth: PosedImages, photographs: PosedImages, index: int) -> Truth:
    """Return the true picture of a view, its picture without the object, and the object's mask."""
    mask = truth.mask(index)
    if mask is None:
        raise ValueError(f"{truth.image_paths[index]}: expected a mask of the object in masks/, found none")
    return Truth(image=truth.image(index), background=photographs.image(index), mask=mask)


def _row(
    image: Float[Tensor, "h w 3"],
    truth: Truth,
    background: Float[Tensor, "h w 3"],
    perceptual: Perceptual | None,
) -> dict[str, float | None]:
    values = measure_view(image, truth, background=background, perceptual=perceptual)
    return {name: value if math.isfinite(value) else None for name, value in values.items()}


def _mean(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _picture(scene: Gaussians, truth: PosedImages, index: int) -> Float[Tensor, "h w 3"]:
    color = render(scene, truth.cameras[index].to(scene.device)).color
    return color[0].cpu().clamp(0, 1)


def _consistency(
    folder: Path, truth: PosedImages, images: Mapping[int, Float[Tensor, "h w 3"]]
) -> dict[str, float | None]:
    """Compute the disagreement of neighbouring views of the method and of the truth; None if depth is unknown."""
    paths = [folder / "depth" / f"{Path(name).stem}.npy" for name in truth.cameras.names]
    if not all(path.is_file() for path in paths):
        return {"disagreement": None, "disagreement_truth": None}
    depths = [torch.from_numpy(np.load(path, allow_pickle=False).astype(np.float32)) for path in paths]
    masks = [mask for mask in (truth.mask(index) for index in range(len(truth))) if mask is not None]
    true_images = {index: truth.image(index) for index in images}
    return {
        "disagreement": disagreement(images, depths, masks, truth.cameras),
        "disagreement_truth": disagreement(true_images, depths, masks, truth.cameras),
    }


REGIONS = ("whole", "object", "shadow", "rest")
"""Regions of every metric; `shadow` has the pixels that the true object darkens by more than 5%."""


def measure_view(
    image: Float[Tensor, "h w 3"],
    truth: Truth,
    *,
    background: Float[Tensor, "h w 3"],
    perceptual: Perceptual | None = None,
) -> dict[str, float]:
    """Compute PSNR, SSIM, FLIP and, with `perceptual`, LPIPS of every region, and the error of the shadow's strength.

    Images are sRGB in [0, 1]; `background` is the method's render without the object. LPIPS of a region compares the
    truth with a copy that has the region's pixels of `image`. Values are nan for a region that is too small.
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
    """Replace one region of the truth by the pixels of `image`; None if the region is too small."""
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
    """Warp the second camera's image into the first camera's view, and mask the pixels that both cameras see.

    Depths are along the optical axis, 0 where nothing is hit.
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
    # nearest, because a mean of the depths on both sides of an edge would lie on neither surface
    found = torch.nn.functional.grid_sample(stacked[:, 3:], grid, mode="nearest", align_corners=False)[0, 0]
    # 2% set by hand: 16-bit depth and slanted surfaces differ by less
    same = valid & inside & ((found - z).abs() < 0.02 * z)
    return warped, same


def disagreement(
    images: Mapping[int, Float[Tensor, "h w 3"]],
    depths: Sequence[Float[Tensor, "h w"]],
    masks: Sequence[Float[Tensor, "h w"]],
    cameras: Cameras,
) -> float | None:
    """Compute the RMSE in sRGB between consecutive views near the object, after warping by the true depth.

    Pixels within an eighth of the image's width of the object's masks are compared. The result is None if no two
    consecutive views have images. True gloss differs between views too, so compare with the value of the ground truth.
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
