"""A small ball of Gaussians with cameras around it, and the same ball under another light."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from splatgraft.consolidation import ConsolidateOptions
from splatgraft.consolidation.frozen_views import Views
from splatgraft.core import spherical_harmonics
from splatgraft.core.cameras import Cameras, look_at, pinhole
from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering import render


@dataclass(frozen=True)
class Relit:
    composite: Gaussians
    truth: Gaussians
    cameras: Cameras
    images: list[Tensor]


def ball(count: int, *, degree: int, seed: int) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    sh = 0.3 * draw(count, (degree + 1) ** 2, 3)
    sh[:, 1:] *= 0.2
    return Gaussians(
        means=0.5 * draw(count, 3),
        log_scales=-2.3 + 0.3 * draw(count, 3),
        quaternions=draw(count, 4),
        opacity_logits=1 + draw(count),
        sh=sh,
    )


def ring(views: int, size: int = 48) -> Cameras:
    angle = torch.arange(views) / views * 2 * torch.pi
    eyes = torch.stack([3 * angle.cos(), 0.8 * (3 * angle).sin(), 3 * angle.sin()], -1)
    return pinhole(look_at(eyes, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0])), 50.0, width=size, height=size)


def views_of(scene: Gaussians, cameras: Cameras, images: Sequence[Tensor], **changes) -> Views:
    """Return views with exact maps, which tests compare with the renderer."""
    exact = ConsolidateOptions(min_row_weight=0.0, cache_bytes=2**24)
    return Views(scene, cameras, images, options=replace(exact, **changes))


def basis_towards(scene: Gaussians, camera: Cameras) -> Tensor:
    """Return spherical harmonics of every Gaussian in the direction from the camera."""
    directions = torch.nn.functional.normalize(scene.means - camera.centers, dim=-1)
    return spherical_harmonics.basis(directions, scene.sh_degree)


@pytest.fixture(scope="session")
def relit() -> Relit:
    composite, cameras = ball(300, degree=1, seed=0), ring(8)
    change = 0.2 * torch.randn(300, 4, 3, generator=torch.Generator().manual_seed(1))
    change[:, 1:] *= 0.2
    truth = replace(composite, sh=composite.sh + change)
    return Relit(composite, truth, cameras, list(render(truth, cameras).color))
