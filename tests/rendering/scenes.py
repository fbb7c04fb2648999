"""Small random scenes and a camera for rendering tests."""

import torch

from splatgraft.core.cameras import Cameras, look_at, pinhole
from splatgraft.core.gaussians import Gaussians


def random_scene(n: int, degree: int, seed: int) -> Gaussians:
    """Gaussians of a tenth of a unit within a few units of the origin."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    return Gaussians(
        means=normal(n, 3),
        log_scales=normal(n, 3) * 0.6 - 2.5,
        quaternions=normal(n, 4),
        opacity_logits=normal(n) * 1.5 + 0.5,
        sh=normal(n, (degree + 1) ** 2, 3) * 0.4,
    )


def camera(width: int = 37, height: int = 29) -> Cameras:
    """A camera in the scene, some Gaussians behind it; sizes that no tile divides."""
    pose = look_at(torch.tensor([[0.5, 0.3, -2.2]]), torch.zeros(3), torch.tensor([0.0, -1.0, 0.0]))
    return pinhole(pose, 40.0, width=width, height=height)
