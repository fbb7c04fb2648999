"""Posed images: pixels at the cameras' size, undistorted; clicks on pictures with EXIF rotation find that grid."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageOps
from PIL.ExifTags import Base

from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.distortion import Distortion
from splatgraft.core.images import read_stored_rgb, stored_points
from splatgraft.core.posed_images import PosedImages, held_out
from splatgraft.core.prompts import ViewPrompt
from splatgraft.folders.picture_points import prompts_by_view

STORED = (40, 24)


def capture(tmp_path, *, distortions=()):
    rng = np.random.default_rng(0)
    paths, masks = [], []
    for i in range(3):
        paths.append(tmp_path / f"{i}.png")
        masks.append(tmp_path / f"mask_{i}.png")
        Image.fromarray(rng.integers(0, 256, (16, 24, 3), dtype=np.uint8)).save(paths[-1])
        Image.fromarray(rng.integers(0, 256, (16, 24), dtype=np.uint8)).save(masks[-1])
    return PosedImages(
        image_paths=tuple(paths),
        cameras=pinhole(torch.eye(4).repeat(3, 1, 1), 20.0, width=24, height=16),
        points=torch.zeros(0, 3),
        point_colors=torch.zeros(0, 3),
        mask_paths=(masks[0], None, masks[2]),
        distortions=distortions,
    )


def test_views_keep_their_own(tmp_path):
    matrix = torch.tensor([[20.0, 0, 12], [0, 20, 8], [0, 0, 1]], dtype=torch.float64)
    lens = Distortion(matrix, torch.tensor([0.05, 0, 0, 0, 0], dtype=torch.float64), size=(24, 16))
    whole = capture(tmp_path, distortions=(None, None, lens))
    part = whole.select(torch.tensor([False, True, True]))
    assert len(part) == 2
    assert part.distortions == (None, lens)
    assert part.mask(0) is None
    for i in range(2):
        assert torch.equal(part.image(i), whole.image(i + 1))
    assert torch.equal(part.mask(1), whole.mask(2))
    # the mean of four pixels is the subject of test_images.py
    half = whole.resized(0.5)
    assert half.image(0).shape == (8, 12, 3)
    assert half.mask(0).shape == (8, 12)


def test_every_eighth_view_is_held_out():
    assert torch.nonzero(held_out(20)).flatten().tolist() == [0, 8, 16]


def write_dot(path: Path, orientation: int) -> tuple[float, float]:
    """Write a black picture with one white pixel, and return its middle in the upright picture of Pillow."""
    pixels = np.zeros((STORED[1], STORED[0]), np.uint8)
    pixels[5, 31] = 255
    exif = Image.Exif()
    exif[Base.Orientation] = orientation
    Image.fromarray(pixels).save(path, exif=exif)
    with Image.open(path) as image:
        row, column = np.argwhere(np.array(ImageOps.exif_transpose(image)) > 0)[0]
    return float(column) + 0.5, float(row) + 0.5


def test_a_point_that_is_clicked_upright_is_found_on_the_grid_that_is_read(tmp_path: Path) -> None:
    for orientation, sideways in [*((i, False) for i in range(1, 9)), *((i, True) for i in range(5, 9))]:
        clicked = write_dot(tmp_path / "a.png", orientation)
        size = STORED[::-1] if sideways else STORED
        read = read_stored_rgb(tmp_path / "a.png", size)[..., 0].numpy()
        row, column = np.argwhere(read > 0.5)[0]
        found = stored_points(tmp_path / "a.png", torch.tensor([clicked]), size)
        assert found.tolist() == [[column + 0.5, row + 0.5]], (orientation, sideways)


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
