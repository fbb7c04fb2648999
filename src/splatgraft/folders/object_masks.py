"""The sources of 2D masks for `segment`: files, GrabCut or SAM 2 guided by the scene, or the network BiRefNet.

A sheet of photographs shows the outlines of the masks and of the 3D selection.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import list_images, read_mask, resize, write_image
from splatgraft.core.posed_images import PosedImages
from splatgraft.core.prompts import ViewPrompt
from splatgraft.folders.view_folder import file_stems
from splatgraft.rendering import view_operator
from splatgraft.runtime.lazy_sequence import LazySequence
from splatgraft.runtime.progress import Progress, silent
from splatgraft.segmentation import (
    Box,
    CutViews,
    ObjectRegion,
    ViewCutter,
    cut_object,
    lift_masks,
    load_birefnet,
    seed_selection,
)

MaskSource = Literal["auto", "files", "grabcut", "sam2", "birefnet", "box"]

CUT_SIDE_PX = 384
"""Longest side at which pictures are cut: the masks of larger ones are the same within half a pixel of it, and GrabCut
takes time with the area."""
_CELL_PX = 320  # longest side of one photograph on the sheet
_COLUMNS = 4
_MASK_RED, _SELECTION_BLUE = (255, 60, 40), (60, 220, 255)


@dataclass(frozen=True)
class CutRequest:
    """What is known before the pictures are cut."""

    cutter: ViewCutter
    """The algorithm for one picture."""
    box: Box | None = None
    """Around the object, world units; guessed where None."""
    prompts: Mapping[int, ViewPrompt] | None = None
    """What the user says, by index of the picture, pixels of the capture's cameras."""


@dataclass(frozen=True)
class MaskedViews:
    """Views of a capture that have an object mask, and the masks."""

    views: PosedImages
    """The pictures."""
    masks: Sequence[Tensor]
    """(h, w) in [0, 1], of the size of each view's camera, undistorted; read when asked for."""
    region: ObjectRegion | None = None
    """Where the object was looked for; None where the masks were given."""


def with_mask_folder(capture: PosedImages, folder: Path | None, path: Path) -> PosedImages:
    """The views of `capture` that have a mask: in `folder` by name, or the capture's own."""
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
            "give --masks FOLDER, or --mask-source grabcut (with --prompts or --box), sam2, birefnet or box"
        )
    return _with_masks(capture, paths, with_mask)


def masked_views(capture: PosedImages) -> MaskedViews:
    """A capture in which every view has a mask."""

    def read(index: int) -> Tensor:
        mask = capture.mask(index)
        assert mask is not None
        return mask

    return MaskedViews(capture, LazySequence(len(capture), read))


def cut_masks(
    capture: PosedImages, scene: Gaussians, request: CutRequest, *, folder: Path, progress: Progress = silent
) -> MaskedViews:
    """The capture with masks that agree in 3D, written to `folder`; with the region of the object.

    Pictures are cut at `CUT_SIDE_PX`. Masks of some pictures that are there already tell where the object is.
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
    allowed = region.allows(scene.means)
    masks, _ = cut_object(views, scene, share=selection, allowed=allowed, cutter=request.cutter, progress=progress)
    sizes = capture.cameras.sizes.tolist()
    grown = ((resize(mask, *sizes[index]) > 0.5).float() for index, mask in enumerate(masks))
    return replace(_written(capture, grown, folder), region=region)


def _known(capture: PosedImages, scene: Gaussians) -> Bool[Tensor, "n"] | None:
    """The Gaussians that the masks of some pictures give to the object; None where no picture has a mask."""
    masked = capture.with_masks()
    if not len(masked):
        return None
    return lift_masks(scene, masked.cameras.to(scene.device), masked_views(masked).masks) > 0.5


def network_masks(capture: PosedImages, *, weights: Path | None, folder: Path, progress: Progress) -> MaskedViews:
    """The capture with masks of the foreground from BiRefNet, written to `folder`."""
    network = load_birefnet() if weights is None else load_birefnet(weights)

    def made() -> Iterator[Tensor]:
        for index in range(len(capture)):
            yield network.mask(capture.image(index))
            progress(index + 1, len(capture), f"masks from the network on {network.place}")

    return _written(capture, made(), folder)


def _written(capture: PosedImages, masks: Iterable[Tensor], folder: Path) -> MaskedViews:
    folder.mkdir()
    paths = tuple(folder / f"{stem}.png" for stem in file_stems(capture.cameras))
    for path, mask in zip(paths, masks, strict=True):
        write_image(path, mask)
    # they are as the undistorted cameras see them: the capture would undistort them once more
    return MaskedViews(capture, LazySequence(len(paths), lambda index: read_mask(paths[index])))


def _with_masks(capture: PosedImages, paths: tuple[Path | None, ...], which: Bool[Tensor, "v"]) -> PosedImages:
    return replace(capture, mask_paths=paths).select(which)


def write_mask_sheet(
    path: Path, masked: MaskedViews, chosen: Sequence[int], *, scene: Gaussians, selection: Bool[Tensor, "n"]
) -> None:
    """Write `chosen` photographs in rows, the surroundings darkened, outlined: red the mask, blue the selection."""
    cells = [_cell(masked, index, scene, selection) for index in chosen]
    height, width = max(c.shape[0] for c in cells), max(c.shape[1] for c in cells)
    padded = [torch.nn.functional.pad(c, (0, 0, 0, width - c.shape[1], 0, height - c.shape[0]), value=1) for c in cells]
    columns = min(_COLUMNS, len(padded))
    padded += [torch.ones(height, width, 3)] * (-len(padded) % columns)
    rows = [torch.cat(padded[i : i + columns], 1) for i in range(0, len(padded), columns)]
    write_image(path, torch.cat(rows))


def _cell(masked: MaskedViews, index: int, scene: Gaussians, selection: Bool[Tensor, "n"]) -> Float[Tensor, "h w 3"]:
    camera = masked.views.cameras[index]
    small = camera.resized(min(1.0, _CELL_PX / int(camera.sizes.max())))
    image = (resize(masked.views.image(index), small.width, small.height).clamp(0, 1) * 255).to(torch.uint8).numpy()
    mask = resize(masked.masks[index], small.width, small.height) > 0.5
    feature = selection[:, None].float().to(scene.device)
    shown = view_operator(scene, small.to(scene.device)).blend(feature)[..., 0].cpu() > 0.5
    drawn = image.copy()
    drawn[~mask.numpy()] //= 2
    for area, color in ((shown, _SELECTION_BLUE), (mask, _MASK_RED)):
        outlines, _ = cv2.findContours(area.numpy().astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(drawn, outlines, -1, color, 1)
    name = Path(masked.views.cameras.names[index]).name
    cv2.putText(drawn, name, (5, drawn.shape[0] - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.putText(drawn, name, (5, drawn.shape[0] - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1, cv2.LINE_AA)
    return torch.from_numpy(drawn).float() / 255
