"""The value `Similarity`: uniform scale, rotation and translation, applied to Gaussians, cameras and points."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians, KnownSurface
from splatgraft.core.rotations import quaternion_from_rotation


@dataclass(frozen=True)
class Similarity:
    """Transform x_in_a = scale * rotation @ x_in_b + translation; variables are named a_from_b."""

    scale: float
    """Uniform scale, above zero."""
    rotation: Float[Tensor, "3 3"]
    """Orthonormal matrix with determinant 1."""
    translation: Float[Tensor, "3"]
    """Offset, units of frame a."""

    @staticmethod
    def identity() -> "Similarity":
        """Return the identity transform."""
        return Similarity(scale=1.0, rotation=torch.eye(3), translation=torch.zeros(3))

    def __matmul__(self, other: "Similarity") -> "Similarity":
        """Compose a_from_c = a_from_b @ b_from_c."""
        return Similarity(
            scale=self.scale * other.scale,
            rotation=self.rotation @ other.rotation,
            translation=self.scale * self.rotation @ other.translation + self.translation,
        )

    def inverse(self) -> "Similarity":
        """Invert a_from_b to b_from_a."""
        rotation = self.rotation.T
        return Similarity(
            scale=1 / self.scale, rotation=rotation, translation=-(rotation @ self.translation) / self.scale
        )

    def points(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Transform points from frame b to frame a."""
        return self.scale * points @ self.rotation.to(points).T + self.translation.to(points)

    def gaussians(self, gaussians: Gaussians) -> Gaussians:
        """Transform Gaussians from frame b to frame a; all SH bands are rotated."""
        if self.is_identity:
            return gaussians
        rotation = self.rotation.to(gaussians.means)
        if isinstance(gaussians, KnownSurface):
            gaussians = replace(gaussians, normals=gaussians.normals @ rotation.T)
        return replace(
            gaussians,
            means=self.points(gaussians.means),
            log_scales=gaussians.log_scales + torch.tensor(self.scale).log().to(gaussians.log_scales),
            quaternions=quaternion_from_rotation(rotation @ gaussians.rotations),
            sh=spherical_harmonics.rotate(gaussians.sh, rotation),
        )

    def cameras(self, cameras: Cameras) -> Cameras:
        """Transform cameras from frame b to frame a; they see the transformed scene as these see the original."""
        poses = cameras.world_from_camera.clone()
        poses[:, :3, :3] = self.rotation.to(poses) @ poses[:, :3, :3]
        poses[:, :3, 3] = self.points(poses[:, :3, 3])
        return replace(cameras, world_from_camera=poses)

    @property
    def is_identity(self) -> bool:
        """Whether the transform is exactly the identity."""
        return (
            self.scale == 1.0
            and torch.equal(self.rotation, torch.eye(3).to(self.rotation))
            and not self.translation.any()
        )
