"""A picture of the object's masks: photographs with the outline of the mask and of the 3D selection."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import resize, write_image
from splatgraft.folders.object_masks import MaskedViews
from splatgraft.rendering import view_operator

_CELL_PX = 320
"""Longest side of one photograph on the sheet."""
_COLUMNS = 4
_MASK, _SELECTION = (255, 60, 40), (60, 220, 255)


def write_mask_sheet(
    path: Path, masked: MaskedViews, chosen: Sequence[int], *, scene: Gaussians, selection: Bool[Tensor, "n"]
) -> None:
    """Write photographs in rows, the surroundings darkened, with two outlines: red the mask, blue the selection.

    Args:
        path: The picture's file.
        masked: Photographs and masks.
        chosen: Which of them, in this order.
        scene: n Gaussians.
        selection: The object's.
    """
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
    for area, color in ((shown, _SELECTION), (mask, _MASK)):
        outlines, _ = cv2.findContours(area.numpy().astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(drawn, outlines, -1, color, 1)
    name = Path(masked.views.cameras.names[index]).name
    cv2.putText(drawn, name, (5, drawn.shape[0] - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.putText(drawn, name, (5, drawn.shape[0] - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1, cv2.LINE_AA)
    return torch.from_numpy(drawn).float() / 255
