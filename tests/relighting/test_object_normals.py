"""Normals of objects from depth images: right where neighbours mislead, outward, and the old estimate without views."""

import math

import torch

from splatgraft.core.bounds import BoundingSphere, bounding_sphere
from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.directions import even_directions
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.spherical_harmonics import dc_from_rgb
from splatgraft.relighting.normals import estimate_normals
from splatgraft.relighting.object_views import fuse_normals, object_views

ORIGIN = BoundingSphere(torch.zeros(3), 0.5)


def blobs(points, width) -> Gaussians:
    """Round Gaussians, whose own shape tells no normal."""
    n = len(points)
    return Gaussians(
        means=points,
        log_scales=torch.full((n, 3), math.log(width)),
        quaternions=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        opacity_logits=torch.full((n,), 3.0),
        sh=dc_from_rgb(torch.full((n, 1, 3), 0.5)),
    )


def noisy_ball(noise=0.01, count=1500):
    """Centres scattered in depth by 2% of the radius, as those of a short reconstruction are."""
    around = even_directions(count)
    depth = 0.5 + noise * torch.randn(count, 1, generator=torch.Generator().manual_seed(0))
    return blobs(depth * around, 0.03), around


def cameras(count=16):
    eyes = 2.5 * even_directions(count)
    poses = look_at(eyes, torch.zeros(3), torch.tensor([0.3, 0.1, 1.0]))
    return pinhole(poses, 100.0, width=96, height=96)


def angles_deg(one, other):
    return (one * other).sum(1).clamp(-1, 1).acos().rad2deg()


def box(half=0.3, count=16) -> tuple[Gaussians, torch.Tensor]:
    x = torch.linspace(-half, half, count)
    grid = torch.stack(torch.meshgrid(x, x, indexing="ij"), -1).reshape(-1, 2)
    points, normals = [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            face = torch.zeros(len(grid), 3)
            face[:, [a for a in range(3) if a != axis]] = grid
            face[:, axis] = sign * half
            points.append(face)
            normals.append(torch.eye(3)[axis].mul(sign).expand(len(grid), 3))
    return blobs(torch.cat(points), 0.6 * 2 * half / count), torch.cat(normals)


def test_a_smooth_surface_is_within_the_bound():
    ball, truth = noisy_ball()
    neighbours = estimate_normals(ball, cameras())
    fused = fuse_normals(ball, object_views(ball, ORIGIN, cameras()), neighbours, radius=0.5)
    assert angles_deg(fused.vectors, truth).median() < 4  # the bound for objects, degrees
    assert (angles_deg(fused.vectors, truth) < 90).all()


def test_depth_keeps_edges_that_neighbours_round_off():
    body, truth = box()
    neighbours = estimate_normals(body, cameras())
    views = object_views(body, bounding_sphere(body), cameras())
    fused = fuse_normals(body, views, neighbours, radius=0.5)
    # one Gaussian from the edge: the nearest 16 lie on both faces
    near = (body.means.abs().sort(1).values[:, 1] > 0.24) & (body.means.abs().sort(1).values[:, 1] < 0.29)
    before, after = (float(angles_deg(n.vectors, truth)[near].mean()) for n in (neighbours, fused))
    assert after < 0.8 * before


def test_both_sides_of_a_thin_plate_face_outward():
    x = torch.linspace(-0.4, 0.4, 25)
    grid = torch.stack(torch.meshgrid(x, x, indexing="ij"), -1).reshape(-1, 2)
    side = torch.tensor([0.03]).expand(len(grid), 1)
    plate = blobs(torch.cat([torch.cat([grid, side], 1), torch.cat([grid, -side], 1)]), 0.015)
    truth = torch.cat([side.sign(), -side.sign()]) * torch.tensor([[0.0, 0.0, 1.0]])
    neighbours = estimate_normals(plate, cameras())
    fused = fuse_normals(plate, object_views(plate, bounding_sphere(plate), cameras()), neighbours, radius=0.6)
    inner = (plate.means[:, :2].abs() < 0.3).all(1)
    assert angles_deg(fused.vectors, truth)[inner].median() < 10  # the blobs' own bumps are a few degrees
    assert (angles_deg(fused.vectors, truth)[inner] < 90).float().mean() > 0.98


def test_without_views_the_estimate_by_neighbours_stays():
    ball, _ = noisy_ball()
    away = cameras()
    away.world_from_camera[:, :3, 3] *= -1  # every camera looks away from the ball
    views = object_views(ball, ORIGIN, away)
    assert views == ()
    neighbours = estimate_normals(ball, cameras())
    fused = fuse_normals(ball, views, neighbours, radius=0.5)
    assert torch.allclose(fused.vectors, neighbours.vectors, atol=1e-6)
    assert torch.equal(fused.confidence, neighbours.confidence)
