"""The value `Gaussians`: a 3DGS scene as raw tensors. Knows nothing about files, cameras or rendering."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatgraft.core import spherical_harmonics


def rotation_from_quaternion(quaternions: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """Rotation matrices of wxyz quaternions of any length but zero."""
    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def quaternion_from_rotation(rotations: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 4"]:
    """Unit wxyz quaternions of rotation matrices, w >= 0; stable for every rotation."""
    m = rotations
    d = torch.diagonal(m, dim1=-2, dim2=-1)
    x, y, z = d.unbind(-1)
    squares = torch.stack([1 + x + y + z, 1 + x - y - z, 1 - x + y - z, 1 - x - y + z], -1)
    a, b, c = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    e, f, g = m[:, 0, 1] + m[:, 1, 0], m[:, 0, 2] + m[:, 2, 0], m[:, 1, 2] + m[:, 2, 1]
    rows = torch.stack(
        [
            torch.stack([squares[:, 0], a, b, c], -1),
            torch.stack([a, squares[:, 1], e, f], -1),
            torch.stack([b, e, squares[:, 2], g], -1),
            torch.stack([c, f, g, squares[:, 3]], -1),
        ],
        1,
    )
    # of four parallel candidates, the one with the largest component is the best conditioned
    best = rows[torch.arange(len(m), device=m.device), squares.argmax(-1)]
    best = torch.nn.functional.normalize(best, dim=-1)
    return torch.where(best[:, :1] < 0, -best, best)


@dataclass(frozen=True)
class Gaussians:
    """n 3D Gaussians with view-dependent colour, in the raw parametrisation that a 3DGS .ply stores."""

    means: Float[Tensor, "n 3"]
    """Centres, world units."""
    log_scales: Float[Tensor, "n 3"]
    """Natural logarithm of the standard deviations along the own axes, world units."""
    quaternions: Float[Tensor, "n 4"]
    """Own axes in the world, wxyz, of any length but zero."""
    opacity_logits: Float[Tensor, "n"]
    """Opacity before the sigmoid."""
    sh: Float[Tensor, "n k 3"]
    """Spherical-harmonic colour, k = (degree + 1)^2, sRGB minus one half."""

    @property
    def count(self) -> int:
        """Number of Gaussians n."""
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        """Degree of the colour expansion, 0 to 3."""
        return spherical_harmonics.degree_of(self.sh.shape[1])

    @property
    def device(self) -> torch.device:
        """Where the tensors live."""
        return self.means.device

    @property
    def scales(self) -> Float[Tensor, "n 3"]:
        """Standard deviations along the own axes, world units."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Float[Tensor, "n"]:
        """Opacity in (0, 1)."""
        return self.opacity_logits.sigmoid()

    @property
    def rotations(self) -> Float[Tensor, "n 3 3"]:
        """Own axes as columns, in the world."""
        return rotation_from_quaternion(self.quaternions)

    @property
    def covariances(self) -> Float[Tensor, "n 3 3"]:
        """World-space covariance R S S^T R^T (3DGS, Eq. 6)."""
        half = self.rotations * self.scales[:, None, :]
        return half @ half.transpose(1, 2)

    def select(self, which: Bool[Tensor, "n"] | Int[Tensor, "m"]) -> "Gaussians":
        """The Gaussians that a mask keeps, or an index list names."""
        return self.map(lambda tensor: tensor[which])

    def map(self, function: Callable[[Tensor], Tensor]) -> "Gaussians":
        """A copy with `function` applied to every tensor."""
        return replace(self, **{field.name: function(getattr(self, field.name)) for field in fields(self)})

    def to(self, device: torch.device | str) -> "Gaussians":
        """The same Gaussians on `device`."""
        return self.map(lambda tensor: tensor.to(device))

    def with_sh_degree(self, degree: int) -> "Gaussians":
        """Higher bands cut off, or padded with zeros."""
        return replace(self, sh=spherical_harmonics.with_degree(self.sh, degree))


def concatenate(parts: Sequence[Gaussians]) -> Gaussians:
    """All Gaussians of `parts` in order; bands are padded to the highest degree among them."""
    degree = max(part.sh_degree for part in parts)
    padded = [part.with_sh_degree(degree) for part in parts]
    return Gaussians(**{f.name: torch.cat([getattr(part, f.name) for part in padded]) for f in fields(Gaussians)})


def empty(sh_degree: int = 0) -> Gaussians:
    """No Gaussians at all."""
    return Gaussians(
        means=torch.zeros(0, 3),
        log_scales=torch.zeros(0, 3),
        quaternions=torch.zeros(0, 4),
        opacity_logits=torch.zeros(0),
        sh=torch.zeros(0, spherical_harmonics.coefficient_count(sh_degree), 3),
    )
