"""The sources of 2D masks for `segment`: files, GrabCut in a box, or the network BiRefNet."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Bool
from torch import Tensor

from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import list_images, write_image
from splatgraft.core.posed_images import PosedImages
from splatgraft.folders.view_folder import file_stems
from splatgraft.runtime.lazy_sequence import LazySequence
from splatgraft.runtime.progress import Progress
from splatgraft.segmentation import Box, default_box, grabcut_masks, load_birefnet, refine_masks

MaskSource = Literal["files", "grabcut", "birefnet", "box"]


def with_mask_folder(capture: PosedImages, folder: Path | None, path: Path) -> PosedImages:
    """The views of `capture` that have a mask: in `folder` by name, or the capture's own.

    Raises: ValueError where no view has one.
    """
    paths = capture.mask_paths
    if folder is not None:
        if not folder.is_dir():
            raise ValueError(f"{folder}: expected a folder of masks, found none")
        by_stem = {mask.stem: mask for mask in list_images(folder)}
        names = [Path(name) for name in capture.cameras.names]
        paths = tuple(by_stem.get(name.stem) or by_stem.get(name.name) for name in names)
    with_mask = torch.tensor([mask is not None for mask in paths], dtype=torch.bool)
    if not with_mask.any():
        raise ValueError(
            f"{folder or path}: expected masks named like the images ({capture.cameras.names[0]}), found none; "
            "give --masks FOLDER, or --mask-source grabcut (with --box), or --mask-source birefnet, or box"
        )
    return _with_masks(capture, paths, with_mask)


def read_masks(capture: PosedImages) -> LazySequence[Tensor]:
    """The masks of a capture in which every view has one, read when asked for."""

    def read(index: int) -> Tensor:
        mask = capture.mask(index)
        assert mask is not None
        return mask

    return LazySequence(len(capture), read)


def cut_masks(
    capture: PosedImages, scene: Gaussians, *, box: Box | None, folder: Path, progress: Progress
) -> PosedImages:
    """The capture with masks from GrabCut in a box, refined until the views agree, and written to `folder`.

    Raises: ValueError where no view shows the box, or no box can be guessed.
    """
    images = LazySequence(len(capture), capture.image)
    box = default_box(capture) if box is None else box
    masks = grabcut_masks(images, capture.cameras, box, capture.points, progress=progress)
    return _written(capture, refine_masks(masks, images, capture.cameras, scene, progress=progress), folder)


def network_masks(capture: PosedImages, *, weights: Path | None, folder: Path, progress: Progress) -> PosedImages:
    """The capture with masks of the foreground from BiRefNet, written to `folder`.

    Raises: ValueError where a package or the weights are missing.
    """
    network = load_birefnet() if weights is None else load_birefnet(weights)

    def read(index: int) -> Tensor:
        progress(index + 1, len(capture), "masks from the network")
        return network.mask(capture.image(index))

    return _written(capture, LazySequence(len(capture), read), folder)


def _written(capture: PosedImages, masks: Iterable[Tensor], folder: Path) -> PosedImages:
    folder.mkdir()
    paths = tuple(folder / f"{stem}.png" for stem in file_stems(capture.cameras))
    for path, mask in zip(paths, masks, strict=True):
        write_image(path, mask)
    return _with_masks(capture, paths, torch.ones(len(capture), dtype=torch.bool))


def _with_masks(capture: PosedImages, paths: tuple[Path | None, ...], which: Bool[Tensor, "v"]) -> PosedImages:
    return replace(capture, mask_paths=paths).select(which)
