"""Object masks of posed images from a 3D box, by GrabCut (Rother et al. 2004; OpenCV).

GrabCut separates object and surroundings of a single image by colour. Here the projected 3D box bounds the object and
the convex hull of the projected sparse points initialises it. A second pass starts from the masks of all views, lifted
to the Gaussians and rendered back into each view.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering import RenderOptions, view_operator
from splatgraft.runtime.progress import Progress, silent
from splatgraft.segmentation.box import Box
from splatgraft.segmentation.lift import lift_masks


@dataclass(frozen=True)
class GrabcutOptions:
    """How object and surroundings are separated; values set by hand."""

    iterations: int = 5
    """GrabCut iterations per image."""
    lightness: float = 0.5
    """Weight of lightness against colour: below 1, a shadow looks more like the ground on which it lies."""
    certain: float = 0.9
    """Lifted mask value in the second pass from which a pixel is certainly object; below 1 - `certain` it is certainly
    surroundings."""
    speck: int = 50
    """The largest part of the mask over the largest part that is removed, by area."""
    hole: int = 1000
    """The mask over the largest hole that is filled, by area."""


def grabcut_masks(
    images: Sequence[Float[Tensor, "_ _ 3"]],
    cameras: Cameras,
    box: Box,
    points: Float[Tensor, "m 3"],
    options: GrabcutOptions = GrabcutOptions(),
    *,
    progress: Progress = silent,
) -> list[Float[Tensor, "_ _"]]:
    """A mask, 0 or 1, of the object in `box`, for each image.

    Args:
        images: sRGB in [0, 1], one per camera.
        cameras: Of the images.
        box: Contains the object, world units.
        points: Sparse points of the capture, world units.
        options: Of GrabCut.
        progress: Called per image.

    Raises:
        ValueError: Where a camera does not see the box, or fewer than 4 points lie in it.
    """
    inside = points[box.contains(points)]
    if len(inside) < 4:
        raise ValueError(f"box: expected at least 4 sparse points of the capture inside it, found {len(inside)}")
    masks = []
    for index, (image, camera) in enumerate(zip(images, cameras, strict=True)):
        progress(index, len(images), "cutting masks")
        masks.append(_cut(image, _prior_from_box(camera, box, inside), options))
    progress(len(images), len(images), "cutting masks")
    return masks


def refine_masks(
    masks: Sequence[Float[Tensor, "_ _"]],
    images: Sequence[Float[Tensor, "_ _ 3"]],
    cameras: Cameras,
    gaussians: Gaussians,
    options: GrabcutOptions = GrabcutOptions(),
    *,
    progress: Progress = silent,
) -> list[Float[Tensor, "_ _"]]:
    """The masks cut again, each from the masks of all views, lifted to `gaussians` and blended into its view."""
    feature = lift_masks(gaussians, cameras, masks)[:, None]
    refined = []
    for index, (image, camera) in enumerate(zip(images, cameras, strict=True)):
        progress(index, len(images), "refining masks")
        lifted = view_operator(gaussians, camera, RenderOptions()).blend(feature)[..., 0].cpu().numpy()
        refined.append(_cut(image, _prior_from_lifted(lifted, options.certain), options))
    progress(len(images), len(images), "refining masks")
    return refined


def _prior_from_box(camera: Cameras, box: Box, inside: Float[Tensor, "k 3"]) -> UInt8[np.ndarray, "h w"]:
    width, height = camera.width, camera.height
    corners = _project(camera, box.corners.to(inside))
    outline = np.zeros((height, width), np.uint8)
    cv2.fillConvexPoly(outline, cv2.convexHull(corners.astype(np.float32)).round().astype(np.int32), 1)
    if not outline.any():
        raise ValueError(f"box: expected the camera of {camera.names[0]} to see it, found it outside the picture")
    prior = np.where(outline > 0, cv2.GC_PR_BGD, cv2.GC_BGD).astype(np.uint8)
    seeds = _project(camera, inside)
    seeds = seeds[np.isfinite(seeds).all(1)]
    try:
        hull = seeds[ConvexHull(seeds).vertices]
    except QhullError as error:
        raise ValueError(f"box: expected points in it that span an area of {camera.names[0]}, found a line") from error
    likely = np.zeros_like(outline)
    cv2.fillConvexPoly(likely, hull.round().astype(np.int32), 1)
    prior[(likely > 0) & (outline > 0)] = cv2.GC_PR_FGD
    return prior


def _project(camera: Cameras, points: Float[Tensor, "k 3"]) -> Float[np.ndarray, "k 2"]:
    camera_from_world = camera.camera_from_world[0]
    local = points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    if bool((local[:, 2] <= 0).any()):
        raise ValueError(f"box: expected it in front of the camera of {camera.names[0]}, found it around or behind")
    pixels = local @ camera.intrinsics[0].T
    return (pixels[:, :2] / pixels[:, 2:]).double().cpu().numpy()


def _prior_from_lifted(lifted: Float[np.ndarray, "h w"], certain: float) -> UInt8[np.ndarray, "h w"]:
    prior = np.full(lifted.shape, cv2.GC_BGD, np.uint8)
    prior[lifted > 1 - certain] = cv2.GC_PR_BGD
    prior[lifted > 0.5] = cv2.GC_PR_FGD
    prior[lifted > certain] = cv2.GC_FGD
    return prior


def _cut(
    image: Float[Tensor, "h w 3"], prior: UInt8[np.ndarray, "h w"], options: GrabcutOptions
) -> Float[Tensor, "h w"]:
    rgb = (image.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
    lab = cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB)
    lab[..., 0] = np.round(options.lightness * lab[..., 0].astype(np.float32)).astype(np.uint8)
    labels = prior.copy()
    has_object, has_surroundings = ((prior == cv2.GC_FGD) | (prior == cv2.GC_PR_FGD)).any(), (prior % 2 == 0).any()
    if not (has_object and has_surroundings):
        # nothing to separate: all object or none of it
        return torch.from_numpy((prior % 2).astype(np.float32))
    cv2.setRNGSeed(0)
    unused = (0, 0, 0, 0)  # the rectangle, which GC_INIT_WITH_MASK ignores
    cv2.grabCut(lab, labels, unused, np.zeros((1, 65)), np.zeros((1, 65)), options.iterations, cv2.GC_INIT_WITH_MASK)
    return torch.from_numpy(_without_specks((labels % 2).astype(np.uint8), options))


def _without_specks(mask: UInt8[np.ndarray, "h w"], options: GrabcutOptions) -> Float[np.ndarray, "h w"]:
    """The mask without small separate parts and small holes."""
    for value in (1, 0):
        count, labels, stats, _ = cv2.connectedComponentsWithStats((mask == value).astype(np.uint8), connectivity=4)
        if count > 1:
            areas = stats[1:, cv2.CC_STAT_AREA]
            limit = areas.max() / options.speck if value == 1 else int((mask == 1).sum()) / options.hole
            small = np.flatnonzero(areas < limit) + 1
            mask = np.where(np.isin(labels, small), 1 - value, mask).astype(np.uint8)
    return mask.astype(np.float32)
