"""Object masks of all images of a capture, by a 2D algorithm that the scene guides, or by the network BiRefNet.

The guided masks (GrabCut, SAM 2) are cut in reduced images: the region of the object and a first selection of Gaussians
(`object_region`) start the rounds of `cut_object`, and the masks are enlarged to the capture's size.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import resize
from splatgraft.core.posed_images import PosedImages
from splatgraft.core.prompts import ViewPrompt
from splatgraft.runtime.lazy_sequence import LazySequence
from splatgraft.runtime.progress import Progress, silent
from splatgraft.segmentation.cut_object import CutViews, ViewCutter, cut_object
from splatgraft.segmentation.lift import lift_masks
from splatgraft.segmentation.object_region import ObjectRegion, seed_selection
from splatgraft.segmentation.onnx_networks import load_birefnet
from splatgraft.segmentation.selection import Box

CUT_SIDE_PX = 384
"""Longest side of the images that are cut: masks of larger ones differ by less than half a pixel of this size, and
GrabCut's time grows with the area."""


@dataclass(frozen=True)
class CutRequest:
    """The 2D algorithm, and the user's box and prompts."""

    cutter: ViewCutter
    """Algorithm for one image."""
    box: Box | None = None
    """Bounds of the object, world units; estimated if None."""
    prompts: Mapping[int, ViewPrompt] | None = None
    """Points and rectangles by index of the image, pixels of the capture's cameras."""


def cut_capture(
    capture: PosedImages, scene: Gaussians, request: CutRequest, *, progress: Progress = silent
) -> tuple[Iterator[Float[Tensor, "_ _"]], ObjectRegion]:
    """Cut the object out of every image of a capture, so that the masks agree in 3D.

    Args:
        capture: The images; masks that some of them have give the first selection of Gaussians.
        scene: Gaussians of the capture.
        request: Algorithm and prompts.
        progress: Called per image.

    Returns:
        A mask per image, 0 or 1, at the size of its camera, and the region that holds the object.
    """
    factor = min(1.0, CUT_SIDE_PX / int(capture.cameras.sizes.max()))
    small = capture.resized(factor)
    ratios = (small.cameras.sizes / capture.cameras.sizes).tolist()
    prompts = {index: prompt.scaled(*ratios[index]) for index, prompt in (request.prompts or {}).items()}
    cameras = small.cameras.to(scene.device)
    selection, region = seed_selection(scene, cameras, box=request.box, prompts=prompts, known=_known(small, scene))
    pictures = []
    for index in range(len(small)):
        progress(index, len(small), "reading pictures")
        pictures.append((small.image(index) * 255).round().to(torch.uint8))
    images = LazySequence(len(small), lambda index: pictures[index].float() / 255)
    views = CutViews(images, cameras, prompts)
    masks, _ = cut_object(views, scene, share=selection, region=region, cutter=request.cutter, progress=progress)
    sizes = capture.cameras.sizes.tolist()
    return ((resize(mask, *sizes[index]) > 0.5).float() for index, mask in enumerate(masks)), region


def _known(capture: PosedImages, scene: Gaussians) -> Bool[Tensor, "n"] | None:
    """Select the Gaussians that the capture's own masks give to the object; None if no image has a mask."""
    masked = capture.with_masks()
    if not len(masked):
        return None
    masks = [mask for index in range(len(masked)) if (mask := masked.mask(index)) is not None]
    return lift_masks(scene, masked.cameras.to(scene.device), masks) > 0.5


def network_masks(capture: PosedImages, *, weights: Path | None, progress: Progress) -> Iterator[Float[Tensor, "_ _"]]:
    """Predict the foreground of each image by BiRefNet, in [0, 1]; `weights` is an .onnx file, None for the hub's."""
    network = load_birefnet() if weights is None else load_birefnet(weights)

    def made() -> Iterator[Tensor]:
        for index in range(len(capture)):
            yield network.mask(capture.image(index))
            progress(index + 1, len(capture), f"masks from the network on {network.place}")

    return made()
