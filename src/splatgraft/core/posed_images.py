"""The value `PosedImages`: a capture with poses and sparse points; image files are read on access."""

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.distortion import Distortion
from splatgraft.core.images import read_alpha, read_mask, read_stored_rgb, resize
from splatgraft.runtime.notebook import draw_in_notebook


@dataclass(frozen=True)
class LeftOut:
    """An unused image of a capture, or the unused mask of one."""

    name: str
    """Name of the image in the capture."""
    reason: str
    """Reason in one line: the expected and the found value."""
    mask_only: bool = False
    """Whether only the mask is left out."""

    def __str__(self) -> str:
        """Name the image or the mask for a message."""
        return f"the mask of {self.name}" if self.mask_only else self.name


@dataclass(frozen=True)
class PosedImages:
    """v images with their cameras, and m sparse points from structure from motion."""

    image_paths: tuple[Path, ...]
    """Image files in the cameras' order, as photographed; `image` undistorts them."""
    cameras: Cameras
    """Poses and intrinsics, for the size to which images are resampled."""
    points: Float[Tensor, "m 3"]
    """Sparse surface points, world units; m may be 0."""
    point_colors: Float[Tensor, "m 3"]
    """Colours of the points, sRGB in [0, 1]."""
    mask_paths: tuple[Path | None, ...] = ()
    """Object mask of each image, or None; the image's own path if its alpha channel is the mask. Empty if the capture
    has no masks."""
    distortions: tuple[Distortion | None, ...] = ()
    """Lens distortion of each image file, removed on reading; empty if no file has any."""
    left_out: tuple[LeftOut, ...] = ()
    """Images and masks that the capture names but that cannot be used; for messages."""

    def __len__(self) -> int:
        return len(self.cameras)

    def __repr__(self) -> str:
        masks = sum(path is not None for path in self.mask_paths)
        size = f" of {self.cameras.width} x {self.cameras.height}" if len(self) and self.cameras.same_size else ""
        return f"PosedImages({len(self)} images{size}, {masks} masks, {len(self.points):,} points)"

    _repr_png_ = draw_in_notebook

    def image(self, index: int) -> Float[Tensor, "h w 3"]:
        """Read the image of camera `index`, sRGB, undistorted and resampled to the camera's size."""
        return self._resampled(read_stored_rgb(self.image_paths[index], self._size(index)), index)

    def reduced_image(self, index: int) -> Float[Tensor, "h w 3"]:
        """Read the image like `image`, but decode a file much larger than the camera's size at a reduced size."""
        size = self._size(index)
        # removing distortion interpolates, which softens less at twice the size
        factor = 2 if self.distortions and self.distortions[index] is not None else 1
        return self._resampled(read_stored_rgb(self.image_paths[index], size, longest_px=factor * max(size)), index)

    def mask(self, index: int) -> Float[Tensor, "h w"] | None:
        """Read the object mask of camera `index` in [0, 1], or None."""
        path = self.mask_paths[index] if self.mask_paths else None
        if path is None:
            return None
        own = path == self.image_paths[index]
        return self._resampled(read_alpha(path, self._size(index)) if own else read_mask(path), index)

    def _size(self, index: int) -> tuple[int, int]:
        """Return the width and height to which the image is resampled."""
        width, height = self.cameras.sizes[index].tolist()
        return width, height

    def _resampled(self, pixels: Float[Tensor, "h w *c"], index: int) -> Float[Tensor, "j i *c"]:
        width, height = self._size(index)
        distortion = self.distortions[index] if self.distortions else None
        if distortion is not None:
            pixels = distortion.undistort(pixels, self.cameras.intrinsics[index], width=width, height=height)
        return resize(pixels, width, height)

    def select(self, which: Bool[Tensor, "v"]) -> "PosedImages":
        """Select views by a mask; points stay."""
        indices = [int(i) for i in torch.nonzero(which).flatten()]
        return replace(
            self,
            image_paths=tuple(self.image_paths[i] for i in indices),
            cameras=self.cameras[indices],
            mask_paths=tuple(self.mask_paths[i] for i in indices) if self.mask_paths else (),
            distortions=tuple(self.distortions[i] for i in indices) if self.distortions else (),
        )

    def with_masks(self) -> "PosedImages":
        """Select the views that have an object mask."""
        paths = self.mask_paths or (None,) * len(self)
        return self.select(torch.tensor([path is not None for path in paths], dtype=torch.bool))

    def resized(self, factor: float) -> "PosedImages":
        """Resample all images by `factor`."""
        return replace(self, cameras=self.cameras.resized(factor))

    def limited(self, longest_px: int) -> "PosedImages":
        """Resample each larger image to this longest side."""
        return replace(self, cameras=self.cameras.limited(longest_px))


def held_out(count: int, every: int = 8) -> Bool[Tensor, "v"]:
    """Mark the test views among `count`: every 8th from the first, as in Mip-NeRF 360."""
    return torch.arange(count) % every == 0
