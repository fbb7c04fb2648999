"""Lens distortion: an undistorted image equals the pinhole's image and has no empty borders."""

import numpy as np
import pytest
import torch

from splatgraft.core.distortion import Distortion

WIDTH, HEIGHT = 160, 120
MATRIX = torch.tensor([[130.0, 0, 83], [0, 134, 57], [0, 0, 1]], dtype=torch.float64)
LENSES = [
    (0.1, 0, 0, 0, 0),
    (-0.12, 0.03, 0, 0, 0),
    (0.08, -0.03, 0.004, -0.006, 0.002),
]


def distorted(rays, coefficients):
    """Distort normalised image coordinates by Brown's model, from its definition."""
    k1, k2, p1, p2, k3 = coefficients
    x, y = rays[..., 0], rays[..., 1]
    square = x * x + y * y
    radial = 1 + k1 * square + k2 * square**2 + k3 * square**3
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x),
            y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
        ],
        -1,
    )


def pixel_centers(width, height):
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1)


def picture(rays):
    """Return a smooth picture of directions; |second derivative| at most 100 per unit squared in each axis."""
    return 0.5 + 0.25 * np.sin(20 * rays[..., 0]) + 0.25 * np.cos(20 * rays[..., 1] + 1)


def through_the_lens(coefficients):
    """Return the picture on the distorted camera's grid; fixed-point iteration finds each pixel's ray."""
    matrix = MATRIX.numpy()
    target = (pixel_centers(WIDTH, HEIGHT) - matrix[:2, 2]) / np.diag(matrix)[:2]
    rays = target.copy()
    for _ in range(100):
        rays = rays + target - distorted(rays, coefficients)
    assert np.abs(distorted(rays, coefficients) - target).max() < 1e-9
    return torch.from_numpy(picture(rays)).float()


def lens(coefficients):
    return Distortion(
        intrinsics=MATRIX, coefficients=torch.tensor(coefficients, dtype=torch.float64), size=(WIDTH, HEIGHT)
    )


@pytest.mark.parametrize("coefficients", LENSES)
def test_undistorted_picture_is_the_pinholes(coefficients):
    pinhole = lens(coefficients).pinhole()
    found = lens(coefficients).undistort(
        through_the_lens(coefficients), torch.from_numpy(pinhole), width=WIDTH, height=HEIGHT
    )
    rays = (pixel_centers(WIDTH, HEIGHT) - pinhole[:2, 2]) / np.diag(pinhole)[:2]
    error = np.abs(found.numpy() - picture(rays))
    # bilinear: spacing^2 / 8 * second derivative = (1/130)^2 / 8 * 100 per axis, with OpenCV's steps of 1/32 px:
    # slope 5 per unit / 130 px / 64; the outermost row repeats the border, half a pixel off
    assert error[1:-1, 1:-1].max() < 2 * (1 / 120) ** 2 / 8 * 100 + 2 * 5 / 120 / 64 + 1e-4
    assert error.max() < 2 * 5 / 120


@pytest.mark.parametrize("coefficients", LENSES)
def test_no_border_is_empty_and_none_is_wasted(coefficients):
    pinhole = lens(coefficients).pinhole()
    t = np.linspace(0, 1, 1000)
    ends = np.zeros_like(t), np.ones_like(t)
    sides = [np.stack([end, t], -1) for end in ends] + [np.stack([t, end], -1) for end in ends]
    for i, side in enumerate(sides):
        rays = (side * (WIDTH, HEIGHT) - pinhole[:2, 2]) / np.diag(pinhole)[:2]
        px = distorted(rays, coefficients) * np.diag(MATRIX.numpy())[:2] + MATRIX.numpy()[:2, 2]
        across = px[:, i // 2]
        slack = across if i % 2 == 0 else (WIDTH, HEIGHT)[i // 2] - across
        # between the 129 samples of a side its bow is off by (1/128)^2 / 8 of at most 30 px; every side comes near
        assert slack.min() > -0.01
        assert slack.min() < 4


def test_sizes_scale_the_pinhole_and_the_picture():
    whole = lens(LENSES[2])
    doubled = Distortion(
        intrinsics=torch.diag(torch.tensor([2.0, 2, 1], dtype=torch.float64)) @ MATRIX,
        coefficients=whole.coefficients,
        size=(2 * WIDTH, 2 * HEIGHT),
    )
    assert np.allclose(doubled.pinhole(), np.diag([2, 2, 1]) @ whole.pinhole(), atol=1e-9)
    image = through_the_lens(LENSES[2])
    pinhole = torch.from_numpy(whole.pinhole())
    served_smaller = torch.diag(torch.tensor([0.5, 0.5, 1], dtype=torch.float64)) @ pinhole
    one = whole.undistort(image, pinhole, width=WIDTH, height=HEIGHT)
    other = doubled.undistort(image, served_smaller, width=WIDTH // 2, height=HEIGHT // 2)
    # maps in float32 to 1e-5 px, but OpenCV rounds them to 1/32 px: slope 5 / 130 / 32 where one falls over
    assert (one - other).abs().max() < 2 * 5 / 120 / 32


@pytest.mark.parametrize("coefficients", [(-3.0, 0, 0, 0, 0), (0, -9.0, 0, 0, 0), (0, 0, 5.0, 0, 0)])
def test_what_folds_over_itself_is_refused(coefficients):
    with pytest.raises(ValueError, match="expected a distortion that can be undone, found k1, k2, p1, p2, k3 ="):
        lens(coefficients).pinhole()
