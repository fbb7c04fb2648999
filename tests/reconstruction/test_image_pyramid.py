"""Every second pixel of a photograph, as the steps of a fit see it."""

from pathlib import Path

import pytest
import torch
from shapes import random_scene

from splatgraft.core import cameras as camera_values
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import write_image
from splatgraft.core.posed_images import PosedImages
from splatgraft.reconstruction.image_pyramid import Pyramid, read_pyramid
from splatgraft.reconstruction.options import Sampling
from splatgraft.rendering import RenderOptions, render
from splatgraft.runtime.progress import silent

WIDTH, HEIGHT = 101, 83


def scene() -> Gaussians:
    return random_scene(80, 1, seed=1)


@pytest.fixture
def pyramid(tmp_path: Path) -> Pyramid:
    eye = torch.tensor([[3.0, 1.0, 1.0], [0.0, 3.0, 1.0]])
    poses = camera_values.look_at(eye, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    cameras = camera_values.pinhole(poses, 90.0, width=WIDTH, height=HEIGHT)
    paths = (tmp_path / "0.png", tmp_path / "1.png")
    for path, image in zip(paths, render(scene(), cameras).color, strict=True):
        write_image(path, image)
    capture = PosedImages(paths, cameras, torch.zeros(0, 3), torch.zeros(0, 3))
    return read_pyramid(capture, (Sampling(1.0, 2, 0.5), Sampling(1.0, 1, 1.0)), device="cpu", progress=silent)


def test_the_pixels_of_a_stride_are_those_of_the_whole_picture(pyramid):
    whole = pyramid.at(0, visit=0, done=0.9)
    full = render(scene(), whole.camera).color[0]
    seen = torch.zeros(HEIGHT, WIDTH)
    for visit in range(4):
        view = pyramid.at(0, visit=visit, done=0.0)
        assert view.low_pass_px2 == whole.low_pass_px2 / 4
        part = render(scene(), view.camera, options=RenderOptions(low_pass_px2=view.low_pass_px2)).color[0]
        place = [
            (top, left)
            for top in (0, 1)
            for left in (0, 1)
            if full[top::2, left::2].shape == part.shape and torch.equal(whole.image[top::2, left::2], view.image)
        ]
        assert len(place) == 1
        top, left = place[0]
        # a splat ends at the pixels with an alpha below 1/255, which rounding moves; there are 80 of them
        assert (part - full[top::2, left::2]).abs().max() < 0.02
        assert (part - full[top::2, left::2]).abs().mean() < 1e-4
        seen[top::2, left::2] += 1
    assert (seen == 1).all()
