"""Cube maps: all directions are covered once, radiance is right, uncaptured directions are marked."""

import math

import pytest
import torch

from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.images import linear_from_srgb
from splatgraft.core.spherical_harmonics import dc_from_rgb
from splatgraft.relighting.light.panorama import cube_cameras, cube_directions, render_panorama


def shell(colors, directions, *, radius=2.0, spread=0.12):
    n = len(directions)
    return Gaussians(
        means=directions * radius,
        log_scales=torch.full((n, 3), math.log(spread)),
        quaternions=torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        opacity_logits=torch.full((n,), 8.0),
        sh=dc_from_rgb(colors)[:, None],
    )


def even(n=3000):
    i = torch.arange(n) + 0.5
    z, azimuth = 1 - 2 * i / n, i * (math.pi * (3 - math.sqrt(5)))
    ring = (1 - z * z).sqrt()
    return torch.stack([ring * azimuth.cos(), ring * azimuth.sin(), z], -1)


def test_solid_angles_sum_to_the_sphere_and_directions_are_balanced():
    directions, area = cube_directions(16)
    assert float(area.sum()) == pytest.approx(4 * math.pi, rel=1e-5)  # float32 sum of 1536 terms
    assert (directions * area[..., None]).sum((0, 1, 2)).abs().max() < 1e-4
    second = torch.einsum("fhwi,fhwj,fhw->ij", directions, directions, area)
    # midpoint rule with 16 pixels per 90 degrees: error of order (1/8)^2 / 12 of 4 pi / 3
    assert (second - torch.eye(3) * 4 * math.pi / 3).abs().max() < 0.02


def test_directions_are_those_of_the_cameras():
    directions, _ = cube_directions(8)
    cameras = cube_cameras(torch.tensor([1.0, 2, 3]), 8)
    points = cameras.centers[:, None, None] + 5 * directions
    rotation, shift = cameras.camera_from_world[:, :3, :3], cameras.camera_from_world[:, :3, 3]
    in_camera = torch.einsum("fij,fhwj->fhwi", rotation, points) + shift[:, None, None]
    pixels = in_camera[..., :2] / in_camera[..., 2:] * 4 + 4
    x = torch.arange(8) + 0.5
    # float32 of coordinates of order 10
    assert (pixels[..., 0] - x).abs().max() < 1e-4
    assert (pixels[..., 1] - x[:, None]).abs().max() < 1e-4
    assert (torch.linalg.det(cameras.world_from_camera[:, :3, :3]) - 1).abs().max() < 1e-6


def test_light_is_seen_in_its_direction_in_linear_light():
    directions = even()
    colors = torch.where(directions[:, 2:] > 0, torch.tensor([0.9, 0.6, 0.3]), torch.tensor([0.2, 0.2, 0.2]))
    scene = shell(colors, directions)
    seen = render_panorama(scene, torch.zeros(3), size=32)
    assert seen.coverage > 0.99
    above = seen.radiance[seen.directions[..., 2] > 0.3]
    # blends only like with like away from the border; alpha near 1 leaves 8 bits of float noise
    assert (above - linear_from_srgb(torch.tensor([0.9, 0.6, 0.3]))).abs().max() < 2e-3


def test_coverage_is_the_captured_share():
    directions = even()
    half = directions[directions[:, 2] > 0]
    seen = render_panorama(shell(torch.full((len(half), 3), 0.5), half), torch.zeros(3), size=32)
    # the rim of Gaussians of 0.12 / 2 rad reaches about two of them below the border: at most 6% of the sphere
    assert 0.48 < seen.coverage < 0.57


def test_near_things_are_left_out():
    directions = even()
    near = shell(torch.zeros(300, 3), even(300), radius=0.3, spread=0.05)
    far = shell(torch.full((3000, 3), 0.7), directions)
    seen = render_panorama(concatenate([near, far]), torch.zeros(3), size=16, nearest=0.5)
    serialized = render_panorama(far, torch.zeros(3), size=16, nearest=0.5)
    assert torch.equal(seen.radiance, serialized.radiance)


def test_wide_gaussians_close_by_are_not_smeared_over_the_horizon():
    # a sky, and under the point a table of discs as wide as they are far
    sky = shell(torch.full((3000, 3), 0.7), even(), radius=6.0, spread=0.36)
    x = torch.linspace(-0.6, 0.6, 5)
    grid = torch.stack(torch.meshgrid(x, x, indexing="ij"), -1).reshape(-1, 2)
    table = Gaussians(
        means=torch.cat([grid, torch.full((25, 1), -0.25)], 1),
        log_scales=torch.tensor([0.2, 0.2, 0.01]).log().repeat(25, 1),
        quaternions=torch.tensor([1.0, 0, 0, 0]).repeat(25, 1),
        opacity_logits=torch.full((25,), 4.0),
        sh=dc_from_rgb(torch.tensor([0.9, 0.1, 0.1])).repeat(25, 1)[:, None],
    )
    seen = render_panorama(concatenate([sky, table]), torch.zeros(3), size=32, nearest=0.1)
    level = seen.directions[..., 2].abs() < 0.1
    found = seen.radiance[level]
    assert (found[:, 0] - found[:, 1]).abs().max() < 0.02
