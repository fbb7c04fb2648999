"""Values: rotations, directions, SH rotation, similarities, cameras, and the bounding sphere of Gaussians."""

import itertools
import math
from dataclasses import replace

import pytest
import torch
from shapes import blobs, camera_inside, random_scene

from splatgraft.core import spherical_harmonics as harmonics
from splatgraft.core.bounds import bounding_sphere
from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.directions import even_directions, even_pairs, perpendicular, tangents, vogel_offsets
from splatgraft.core.gaussians import concatenate
from splatgraft.core.rotations import (
    quaternion_from_rotation,
    rotation_about,
    rotation_between,
    rotation_from_quaternion,
    rotation_to_z,
)
from splatgraft.core.similarity import Similarity

UNITS = torch.nn.functional.normalize(torch.randn(6, 3, generator=torch.Generator().manual_seed(0)), dim=1)
AXES = [*torch.eye(3), *-torch.eye(3), *UNITS]
# products of a few float32 numbers of at most one, each rounded by 6e-8
TOLERANCE = 1e-6


def is_rotation(matrix: torch.Tensor) -> bool:
    orthonormal = torch.allclose(matrix @ matrix.T, torch.eye(3), atol=TOLERANCE)
    return orthonormal and abs(float(torch.linalg.det(matrix)) - 1) < TOLERANCE


def test_a_rotation_about_an_axis_keeps_it_and_turns_counterclockwise():
    angle = 0.7
    for axis in AXES:
        rotation = rotation_about(axis, angle)
        assert is_rotation(rotation)
        assert torch.allclose(rotation @ axis, axis, atol=TOLERANCE)
        # the antisymmetric part of a rotation is sin(angle) times the cross product with its axis
        (_, xy, xz), (yx, _, yz), (zx, zy, _) = rotation
        skew = torch.stack([zy - yz, xz - zx, yx - xy])
        assert torch.allclose(skew / 2, math.sin(angle) * axis, atol=TOLERANCE)


def test_the_rotation_between_two_vectors_is_the_smallest():
    for start, end in itertools.product(AXES, AXES):
        rotation = rotation_between(start, end)
        assert is_rotation(rotation)
        assert torch.allclose(rotation @ start, end, atol=TOLERANCE)
        # its trace is 1 + 2 cos(angle), and no rotation turns by less than the angle between the vectors
        assert abs(float(rotation.trace()) - (1 + 2 * float(start @ end))) < 4 * TOLERANCE


def test_up_becomes_z_and_tangents_and_normal_are_a_right_handed_frame():
    for up in AXES:
        assert is_rotation(rotation_to_z(up))
        assert torch.allclose(rotation_to_z(up) @ up, torch.tensor([0.0, 0.0, 1.0]), atol=TOLERANCE)
    for axis in (*even_directions(20), *AXES):
        tangent, bitangent = tangents(axis)
        assert is_rotation(torch.stack([tangent, bitangent, axis]))
        assert torch.equal(perpendicular(axis), tangent)


def test_even_directions_are_centred_unit_vectors_and_pairs_exact_opposites():
    pairs = even_pairs(32)
    assert torch.equal(pairs[:16], -pairs[16:])
    directions = even_directions(320)
    assert torch.allclose(directions.norm(dim=1), torch.ones(320), rtol=0, atol=TOLERANCE)
    # a clustered set has a mean far from 0; a random one is off by 1 / sqrt(320) = 0.06
    assert directions.mean(0).norm() < 0.005


def test_vogel_offsets_lie_in_the_plane_at_their_radii():
    axis = torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 0.7]), dim=0)
    radii = torch.linspace(0.1, 1.0, 9)
    offsets = vogel_offsets(axis, radii, torch.arange(9))
    assert (offsets @ axis).abs().max() < TOLERANCE
    assert torch.allclose(offsets.norm(dim=1), radii, rtol=0, atol=TOLERANCE)
    first = torch.nn.functional.normalize(offsets[:2], dim=1)
    # golden angle: 137.5 degrees, cosine -0.7374
    assert abs(float(first[0] @ first[1]) + 0.73737) < 1e-5


def random_rotations(n, seed=0):
    return rotation_from_quaternion(torch.randn(n, 4, generator=torch.Generator().manual_seed(seed)))


def test_quaternion_round_trip():
    rotations = torch.cat([random_rotations(200), torch.diag(torch.tensor([1.0, -1, -1]))[None], torch.eye(3)[None]])
    # float32 products of three factors of order 1
    assert torch.allclose(rotation_from_quaternion(quaternion_from_rotation(rotations)), rotations, atol=2e-6)


def test_rotated_harmonics_are_the_same_radiance_seen_from_turned_directions():
    rotation = random_rotations(1, seed=3)[0].double()
    sh = torch.randn(7, 16, 3, dtype=torch.float64)
    directions = torch.nn.functional.normalize(torch.randn(7, 3, dtype=torch.float64), dim=-1)
    before = torch.einsum("nk,nkc->nc", harmonics.basis(directions, 3), sh)
    turned = harmonics.rotate(sh, rotation)
    after = torch.einsum("nk,nkc->nc", harmonics.basis(directions @ rotation.T, 3), turned)
    assert torch.allclose(before, after, atol=1e-6)  # the rotation itself is float32 here


def test_similarities_are_a_group_and_move_covariances_like_points():
    a = Similarity(scale=2.0, rotation=random_rotations(1, 1)[0], translation=torch.tensor([1.0, 2, 3]))
    b = Similarity(scale=0.3, rotation=random_rotations(1, 2)[0], translation=torch.tensor([-1.0, 0, 4]))
    x = torch.randn(10, 3)
    assert torch.allclose((a @ b).points(x), a.points(b.points(x)), atol=1e-5)
    assert torch.allclose(a.inverse().points(a.points(x)), x, atol=1e-5)
    move = Similarity(scale=1.7, rotation=random_rotations(1, 5)[0], translation=torch.tensor([0.0, 1, 0]))
    g = random_scene(50, 3, seed=0)
    expected = move.scale**2 * move.rotation @ g.covariances @ move.rotation.T
    assert torch.allclose(move.gaussians(g).covariances, expected, atol=1e-5)


@pytest.mark.parametrize(("count", "expected"), [(1, [0]), (2, [0, 9]), (4, [0, 3, 6, 9]), (20, list(range(10)))])
def test_spread_cameras_are_evenly_spaced(count, expected):
    poses = look_at(torch.rand(10, 3) + 2, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    cameras = pinhole(poses, 50.0, width=8, height=8)
    assert cameras.spread(count).names == tuple(cameras.names[i] for i in expected)


def test_look_at_stays_on_the_device_of_its_points():
    # torch's device without data stands for a GPU
    poses = look_at(*(torch.zeros(shape, device="meta") for shape in ((2, 3), (3,), (3,))))
    assert (poses.device.type, poses.shape) == ("meta", (2, 4, 4))


def test_a_camera_computes_on_its_own_device():
    # torch's device without data stands for a GPU
    camera = camera_inside().to("meta")
    world = camera.unproject(torch.ones(camera.height, camera.width, device="meta"))
    smaller = camera.cropped([(1, 1, 9, 9)]).resized(0.5).intrinsics
    for found in (camera.rays(), camera.world_rays(), world, camera.project(world)[0], camera.centers, smaller):
        assert found.device.type == "meta"


def test_projection_inverts_unprojection_and_follows_the_world_rays():
    poses = look_at(torch.tensor([[2.0, 1, 1], [0, 3, 1]]), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    camera = pinhole(poses, 30.0, width=24, height=16)[1]
    depth = torch.rand(16, 24) + 0.5
    points = camera.unproject(depth)
    pixels, found = camera.project(points)
    rows, columns = torch.meshgrid(torch.arange(16) + 0.5, torch.arange(24) + 0.5, indexing="ij")
    torch.testing.assert_close(found, depth)
    torch.testing.assert_close(pixels, torch.stack([columns, rows], -1), atol=2e-5, rtol=0)  # float32 of up to 24
    torch.testing.assert_close(camera.centers[0] + depth[..., None] * camera.world_rays(), points)
    assert camera.project(2 * camera.centers[0] - points)[1].max() < 0  # behind the camera


def shell(center, radius, *, count=1000, scale=0.01, opacity=0.9):
    """Return small opaque Gaussians spread evenly over a sphere."""
    points = even_directions(count) * radius + torch.tensor(center)
    return blobs(points, scale, opacity_logit=math.log(opacity / (1 - opacity)))


def test_it_holds_the_object_and_its_width():
    sphere = bounding_sphere(shell((1.0, 2.0, 3.0), 2.0))
    assert torch.allclose(sphere.center, torch.tensor([1.0, 2.0, 3.0]), atol=0.05)
    # the reach is 2 + 0.01, enlarged by 5%; the centre is off by up to 0.05
    assert 2.01 <= sphere.radius <= 1.05 * (2.01 + 0.05)


def test_stray_gaussians_change_it_little():
    object_ = shell((0.0, 0.0, 0.0), 1.0)
    means = object_.means.clone()
    means[::250] = 100.0  # 4 of 1000: fewer than the 1% that may lie outside
    alone, stray = bounding_sphere(object_), bounding_sphere(replace(object_, means=means))
    # quantiles move by at most 4 ranks of 1000: 0.4% of the axis's even distribution over [-1, 1]
    assert (stray.center - alone.center).norm() < 0.01 * 3**0.5
    assert abs(stray.radius - alone.radius) < 0.02


def test_faint_gaussians_count_only_where_none_is_opaque():
    object_, haze = shell((0.0, 0.0, 0.0), 1.0), shell((0.0, 0.0, 0.0), 9.0, opacity=0.05)
    alone, both = bounding_sphere(object_), bounding_sphere(concatenate([object_, haze]))
    assert torch.equal(alone.center, both.center)
    assert alone.radius == both.radius
    assert bounding_sphere(haze).radius > 9
