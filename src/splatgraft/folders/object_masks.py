"""Folders of object masks: found by name for a capture, written, and drawn beside the 3D selection on a sheet."""

from collections.abc import Iterable, Sequence
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
from splatgraft.folders.view_folder import file_stems
from splatgraft.rendering import view_operator
from splatgraft.runtime.lazy_sequence import LazySequence
from splatgraft.segmentation import ObjectRegion

MaskSource = Literal["auto", "files", "grabcut", "sam2", "birefnet", "box", "whole"]
"""Origin of the masks for `segment`."""

_MASK_RED, _SELECTION_BLUE = (255, 60, 40), (60, 220, 255)


@dataclass(frozen=True)
class MaskedViews:
    """Views of a capture that have an object mask, and the masks."""

    views: PosedImages
    """Images of the views."""
    masks: Sequence[Tensor]
    """Masks (h, w) in [0, 1] at the size of each view's camera, undistorted; read when asked for."""
    region: ObjectRegion | None = None
    """Region in which the object was searched; None if the masks were given."""


def with_mask_folder(capture: PosedImages, folder: Path | None, path: Path) -> PosedImages:
    """Select the views of `capture` that have a mask: in `folder` by name, or the capture's own."""
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
    """Take the masks of a capture in which every view has one."""

    def read(index: int) -> Tensor:
        mask = capture.mask(index)
        assert mask is not None
        return mask

    return MaskedViews(capture, LazySequence(len(capture), read))


def write_masks(
    folder: Path, capture: PosedImages, masks: Iterable[Tensor], *, region: ObjectRegion | None = None
) -> MaskedViews:
    """Write the masks of all views to a new folder, one .png per view, and read them from there when asked for."""
    folder.mkdir()
    paths = tuple(folder / f"{stem}.png" for stem in file_stems(capture.cameras))
    for path, mask in zip(paths, masks, strict=True):
        write_image(path, mask)
    # the masks fit the undistorted cameras; as the capture's own they would be undistorted once more
    return MaskedViews(capture, LazySequence(len(paths), lambda index: read_mask(paths[index])), region)


def _with_masks(capture: PosedImages, paths: tuple[Path | None, ...], which: Bool[Tensor, "v"]) -> PosedImages:
    return replace(capture, mask_paths=paths).select(which)


def write_mask_sheet(
    path: Path, masked: MaskedViews, chosen: Sequence[int], *, scene: Gaussians, selection: Bool[Tensor, "n"]
) -> None:
    """Draw `chosen` photographs in rows: outside the mask darkened, the mask's outline red, the selection's blue."""
    cells = [_cell(masked, index, scene, selection) for index in chosen]
    height, width = max(c.shape[0] for c in cells), max(c.shape[1] for c in cells)
    padded = [torch.nn.functional.pad(c, (0, 0, 0, width - c.shape[1], 0, height - c.shape[0]), value=1) for c in cells]
    columns = min(4, len(padded))
    padded += [torch.ones(height, width, 3)] * (-len(padded) % columns)
    rows = [torch.cat(padded[i : i + columns], 1) for i in range(0, len(padded), columns)]
    write_image(path, torch.cat(rows))


def _cell(masked: MaskedViews, index: int, scene: Gaussians, selection: Bool[Tensor, "n"]) -> Float[Tensor, "h w 3"]:
    camera = masked.views.cameras[index]
    small = camera.resized(min(1.0, 320 / int(camera.sizes.max())))
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
