"""Points of pictures with EXIF rotation: from what a viewer shows to the grid that poses refer to."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageOps
from PIL.ExifTags import Base

from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.images import read_stored_rgb, stored_points
from splatgraft.core.posed_images import PosedImages
from splatgraft.core.prompts import ViewPrompt
from splatgraft.folders.picture_points import prompts_by_view

STORED = (40, 24)


def write_dot(path: Path, orientation: int) -> tuple[float, float]:
    """A black picture with one white pixel; gives its middle as Pillow shows it upright."""
    pixels = np.zeros((STORED[1], STORED[0]), np.uint8)
    pixels[5, 31] = 255
    exif = Image.Exif()
    exif[Base.Orientation] = orientation
    Image.fromarray(pixels).save(path, exif=exif)
    with Image.open(path) as image:
        row, column = np.argwhere(np.array(ImageOps.exif_transpose(image)) > 0)[0]
    return float(column) + 0.5, float(row) + 0.5


@pytest.mark.parametrize(
    ("orientation", "sideways"), [*((i, False) for i in range(1, 9)), *((i, True) for i in range(5, 9))]
)
def test_a_point_that_is_clicked_upright_is_found_on_the_grid_that_is_read(
    tmp_path: Path, orientation: int, sideways: bool
) -> None:
    clicked = write_dot(tmp_path / "a.png", orientation)
    size = STORED[::-1] if sideways else STORED
    read = read_stored_rgb(tmp_path / "a.png", size)[..., 0].numpy()
    row, column = np.argwhere(read > 0.5)[0]
    found = stored_points(tmp_path / "a.png", torch.tensor([clicked]), size)
    assert found.tolist() == [[column + 0.5, row + 0.5]]


@pytest.mark.parametrize("camera_size", [STORED, STORED[::-1], (20, 12), (12, 20)])
def test_clicks_and_boxes_are_those_of_the_upright_picture(tmp_path: Path, camera_size: tuple[int, int]) -> None:
    x, y = write_dot(tmp_path / "a.png", 6)
    pose = look_at(torch.tensor([[0.0, -1, 0]]), torch.zeros(3), torch.tensor([0.0, 0, 1]))
    camera = pinhole(pose, 30.0, width=camera_size[0], height=camera_size[1])
    posed = PosedImages((tmp_path / "a.png",), camera, torch.zeros(1, 3), torch.zeros(1, 3))
    asked = {camera.names[0]: ViewPrompt(inside=torch.tensor([[x, y]]), box=(x - 2, y - 4, x + 2, y + 4))}
    (found,) = prompts_by_view(posed, asked, tmp_path / "clicks.toml").values()
    stored = camera_size[0] > camera_size[1]
    factor = max(camera_size) / max(STORED)
    at = torch.tensor([31.5, 5.5]) if stored else torch.tensor([x, y])
    half = torch.tensor([4.0, 2.0]) if stored else torch.tensor([2.0, 4.0])
    assert torch.allclose(found.inside, factor * at[None])
    assert found.box is not None
    assert torch.allclose(torch.tensor(found.box), factor * torch.cat([at - half, at + half]))
