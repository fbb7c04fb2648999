"""The value `Gaussians`: a 3D Gaussian Splatting scene in the raw parametrisation that its .ply stores."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.rotations import rotation_from_quaternion
from splatgraft.runtime.notebook import draw_in_notebook


@dataclass(frozen=True)
class Gaussians:
    """n 3D Gaussians with view-dependent colour, in the raw parametrisation that a 3DGS .ply stores."""

    means: Float[Tensor, "n 3"]
    """Centres, world units."""
    log_scales: Float[Tensor, "n 3"]
    """Natural logarithms of the standard deviations along the own axes, world units."""
    quaternions: Float[Tensor, "n 4"]
    """Rotations from own to world axes, wxyz, of any length above zero."""
    opacity_logits: Float[Tensor, "n"]
    """Opacities before the sigmoid."""
    sh: Float[Tensor, "n k 3"]
    """Spherical-harmonic coefficients of sRGB minus one half, k = (degree + 1)^2."""

    def __repr__(self) -> str:
        return f"Gaussians({self.count:,} of SH degree {self.sh_degree})"

    _repr_png_ = draw_in_notebook

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
        """Device of the tensors."""
        return self.means.device

    @property
    def scales(self) -> Float[Tensor, "n 3"]:
        """Standard deviations along the own axes, world units."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Float[Tensor, "n"]:
        """Opacities in (0, 1)."""
        return self.opacity_logits.sigmoid()

    @property
    def rotations(self) -> Float[Tensor, "n 3 3"]:
        """Rotations from own to world axes; columns are the own axes."""
        return rotation_from_quaternion(self.quaternions)

    @property
    def covariances(self) -> Float[Tensor, "n 3 3"]:
        """World-space covariances R S S^T R^T (3DGS, Eq. 6)."""
        half = self.rotations * self.scales[:, None, :]
        return half @ half.transpose(1, 2)

    def select(self, which: Bool[Tensor, "n"] | Int[Tensor, "m"]) -> Self:
        """Select the Gaussians where the mask is true, or those at the given indices, in their order."""
        rows = which.nonzero()[:, 0] if which.dtype == torch.bool else which
        return self.map(lambda tensor: tensor.index_select(0, rows))

    def map(self, function: Callable[[Tensor], Tensor]) -> Self:
        """Apply `function` to every tensor."""
        return replace(self, **{field.name: function(getattr(self, field.name)) for field in fields(self)})

    def to(self, device: torch.device | str) -> Self:
        """Move the Gaussians to `device`."""
        return self.map(lambda tensor: tensor.to(device))

    def with_sh_degree(self, degree: int) -> Self:
        """Cut off higher bands, or pad with zeros."""
        return replace(self, sh=spherical_harmonics.with_degree(self.sh, degree))


def concatenate(parts: Sequence[Gaussians]) -> Gaussians:
    """Concatenate `parts` in order; bands are padded to the highest degree among them."""
    degree = max(part.sh_degree for part in parts)
    padded = [part.with_sh_degree(degree) for part in parts]
    return Gaussians(**{f.name: torch.cat([getattr(part, f.name) for part in padded]) for f in fields(Gaussians)})


def empty(sh_degree: int = 0) -> Gaussians:
    """Make a scene of zero Gaussians."""
    return Gaussians(
        means=torch.zeros(0, 3),
        log_scales=torch.zeros(0, 3),
        quaternions=torch.zeros(0, 4),
        opacity_logits=torch.zeros(0),
        sh=torch.zeros(0, spherical_harmonics.coefficient_count(sh_degree), 3),
    )


@dataclass(frozen=True)
class KnownSurface(Gaussians):
    """Gaussians on a surface of known shape and material, such as a mesh's; their colour is the surface's albedo."""

    normals: Float[Tensor, "n 3"]
    """Unit, outward; in the frame of the means."""
    metallic: Float[Tensor, "n"]
    """Share of metal, in [0, 1]; the albedo is then the colour of reflections."""
    roughness: Float[Tensor, "n"]
    """Perceptual roughness, in [0, 1]; its square is GGX's alpha."""
    emission: Float[Tensor, "n 3"]
    """Emitted linear rgb; white is 1."""
