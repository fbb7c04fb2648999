"""Values: SH rotation, similarity group laws, camera inverse and even choice of cameras."""

import pytest
import torch

from splatgraft.core import spherical_harmonics as harmonics
from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.rotations import quaternion_from_rotation, rotation_from_quaternion
from splatgraft.core.similarity import Similarity


def random_rotations(n, seed=0):
    return rotation_from_quaternion(torch.randn(n, 4, generator=torch.Generator().manual_seed(seed)))


def random_gaussians(n=50, seed=0):
    g = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.randn(n, 3, generator=g),
        log_scales=torch.randn(n, 3, generator=g) * 0.3 - 3,
        quaternions=torch.randn(n, 4, generator=g),
        opacity_logits=torch.randn(n, generator=g),
        sh=torch.randn(n, 16, 3, generator=g) * 0.2,
    )


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


def test_similarity_inverse_and_product():
    a = Similarity(scale=2.0, rotation=random_rotations(1, 1)[0], translation=torch.tensor([1.0, 2, 3]))
    b = Similarity(scale=0.3, rotation=random_rotations(1, 2)[0], translation=torch.tensor([-1.0, 0, 4]))
    x = torch.randn(10, 3)
    assert torch.allclose((a @ b).points(x), a.points(b.points(x)), atol=1e-5)
    assert torch.allclose(a.inverse().points(a.points(x)), x, atol=1e-5)


def test_similarity_moves_covariances_like_points():
    move = Similarity(scale=1.7, rotation=random_rotations(1, 5)[0], translation=torch.tensor([0.0, 1, 0]))
    g = random_gaussians()
    expected = move.scale**2 * move.rotation @ g.covariances @ move.rotation.T
    assert torch.allclose(move.gaussians(g).covariances, expected, atol=1e-5)


@pytest.mark.parametrize(("count", "expected"), [(1, [0]), (2, [0, 9]), (4, [0, 3, 6, 9]), (20, list(range(10)))])
def test_spread_cameras_are_evenly_spaced(count, expected):
    poses = look_at(torch.rand(10, 3) + 2, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    cameras = pinhole(poses, 50.0, width=8, height=8)
    assert cameras.spread(count).names == tuple(cameras.names[i] for i in expected)
