"""Values in a notebook: one line of text, and a picture that shows what the value holds."""

import io
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from small_transfer import parts
from tiny_project import ball, photograph, plane

import splatgraft as sg
from splatgraft.core.gaussians import empty
from splatgraft.relighting.light.light import fit_ambient


def drawn(value: object) -> np.ndarray:
    """Return the picture that IPython would show, sRGB in [0, 1]."""
    data = value._repr_png_()  # pyright: ignore[reportAttributeAccessIssue]
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")) / 255


def is_red(pixels: np.ndarray) -> np.ndarray:
    """Mark the ball's pixels; the plane is bluish grey."""
    return (pixels[..., 0] > 0.3) & (pixels[..., 0] > 2 * pixels[..., 2])


@pytest.fixture(scope="module")
def composite() -> sg.Composite:
    return sg.compose(parts()["place"], [parts()["object"]], target_from_objects=[sg.Similarity.identity()])


def test_every_value_is_one_short_line(composite: sg.Composite, tmp_path: Path):
    photograph(tmp_path, plane((0.5, 0.5, 0.5)), ball())
    capture = sg.read_capture(tmp_path)
    relit = sg.relight(composite, capture.cameras)
    assert relit.light is not None
    for value in (composite, composite.target, capture, relit, relit.light):
        assert len(repr(value)) < 150
        assert "\n" not in repr(value)
    assert repr(composite.target) == "Gaussians(144 of SH degree 1)"
    assert repr(capture) == "PosedImages(8 images of 48 x 36, 8 masks, 224 points)"
    assert repr(capture.select(torch.zeros(8, dtype=torch.bool))).startswith("PosedImages(0 images,")
    assert is_red(drawn(relit)).mean() > 0.02


def test_a_thing_alone_is_drawn_whole_and_a_composite_shows_its_object(composite: sg.Composite):
    alone = is_red(drawn(composite.objects[0].gaussians))
    rows, columns = alone.any(1), alone.any(0)
    # a circle as high as the picture of 4 by 3 has 0.59 of it
    assert 0.2 < alone.mean() < 0.59
    assert not any((rows[0], rows[-1], columns[0], columns[-1]))
    shown = is_red(drawn(composite))
    # the plane is in the picture too: a camera at the ball's surface would see the ball alone
    assert 0.02 < shown.mean() < 0.59
    # in the middle
    assert shown[shown.shape[0] // 2, shown.shape[1] // 2]
    # no camera can be found for nothing
    assert empty()._repr_png_() is None


def test_a_capture_shows_its_photographs(tmp_path: Path):
    photograph(tmp_path, plane((0.5, 0.5, 0.5)), ball())
    capture = sg.read_capture(tmp_path)
    sheet = drawn(capture)
    # two rows of four, 120 pixels high
    assert sheet.shape == (240, 640, 3)
    first = torch.from_numpy(sheet[:120, :160]).float().permute(2, 0, 1)[None]
    small = torch.nn.functional.adaptive_avg_pool2d(first, (36, 48))[0].permute(1, 2, 0)
    # enlarged and reduced again: edges soften
    assert float((small - capture.image(0)).abs().mean()) < 0.02
    assert replace(capture, image_paths=())._repr_png_() is None


def test_a_light_shows_its_sources_as_the_map_of_the_command_does():
    right = sg.LightSource((0.0, -1.0, 0.0), (1.0, 1.0, 1.0), name="")
    up = sg.LightSource((math.cos(0.5), 0.0, math.sin(0.5)), (1.0, 1.0, 1.0), name="")
    light = sg.Light((right, up), fit_ambient(torch.tensor([0.2, 0.2, 0.2])))
    picture = drawn(light)
    assert picture.shape == (256, 512, 3)
    yellow = (picture[..., 0] > 0.8) & (picture[..., 2] < 0.5)
    # -y is a quarter turn right of the middle, which looks along +x; 0.5 rad above the horizon is up there
    for row, column in ((128, 384), (128 - 256 * 0.5 / math.pi, 256)):
        near = yellow[round(row) - 8 : round(row) + 9, column - 8 : column + 9]
        assert near.sum() > 10
        yellow[round(row) - 8 : round(row) + 9, column - 8 : column + 9] = False
    assert not yellow.any()
