"""The value `PosedImages`: a capture with poses and sparse points. Image files are read when asked for, not before."""

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.cameras import Cameras
from splatgraft.images import read_mask, read_rgb, resize


@dataclass(frozen=True)
class PosedImages:
    """v images with their cameras, and m sparse points from structure from motion."""

    image_paths: tuple[Path, ...]
    """One file per camera, in the cameras' order, undistorted."""
    cameras: Cameras
    """Poses and intrinsics, at the size at which images are served."""
    points: Float[Tensor, "m 3"]
    """Sparse surface points, world units; m may be 0."""
    point_colors: Float[Tensor, "m 3"]
    """sRGB in [0, 1]."""
    mask_paths: tuple[Path | None, ...] = ()
    """Object mask of each image where there is one; empty where the capture has none."""

    def __len__(self) -> int:
        return len(self.cameras)

    def image(self, index: int) -> Float[Tensor, "h w 3"]:
        """The image of camera `index`, sRGB, resampled to that camera's size."""
        width, height = self.cameras.sizes[index].tolist()
        return resize(read_rgb(self.image_paths[index]), width, height)

    def mask(self, index: int) -> Float[Tensor, "h w"] | None:
        """The object mask of camera `index` in [0, 1], or None."""
        path = self.mask_paths[index] if self.mask_paths else None
        if path is None:
            return None
        width, height = self.cameras.sizes[index].tolist()
        return resize(read_mask(path), width, height)

    def select(self, which: Bool[Tensor, "v"]) -> "PosedImages":
        """The views that the mask keeps; points stay."""
        indices = [int(i) for i in torch.nonzero(which).flatten()]
        return replace(
            self,
            image_paths=tuple(self.image_paths[i] for i in indices),
            cameras=self.cameras[indices],
            mask_paths=tuple(self.mask_paths[i] for i in indices) if self.mask_paths else (),
        )

    def resized(self, factor: float) -> "PosedImages":
        """The same capture served at `factor` times its size."""
        return replace(self, cameras=self.cameras.resized(factor))


def held_out(count: int, every: int = 8) -> Bool[Tensor, "v"]:
    """Which of `count` views are for testing: every 8th from the first, as in Mip-NeRF 360."""
    return torch.arange(count) % every == 0
