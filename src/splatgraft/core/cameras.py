"""The value `Cameras`: undistorted pinhole cameras with poses, and their resizing, cropping and selection."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

Window = tuple[int, int, int, int]
"""A part of an image: left, top, right, bottom, pixels; right and bottom excluded."""


@dataclass(frozen=True)
class Cameras:
    """v pinhole cameras; OpenCV axes (x right, y down, z forward), pixel centres at +0.5."""

    world_from_camera: Float[Tensor, "v 4 4"]
    """Rigid poses, from camera to world coordinates."""
    intrinsics: Float[Tensor, "v 3 3"]
    """Camera matrices of fx, fy, cx, cy, pixels; no skew."""
    sizes: Int[Tensor, "v 2"]
    """Width and height of each image, pixels."""
    names: tuple[str, ...]
    """Unique names of the cameras; the image file's name if there is one."""

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, which: int | slice | list[int] | Int[Tensor, "m"] | Bool[Tensor, "v"]) -> "Cameras":
        """Select cameras; an integer gives a batch of one camera."""
        indices = torch.arange(len(self))[[which] if isinstance(which, int) else which]
        return Cameras(
            world_from_camera=self.world_from_camera[indices],
            intrinsics=self.intrinsics[indices],
            sizes=self.sizes[indices],
            names=tuple(self.names[int(i)] for i in indices),
        )

    def __iter__(self) -> Iterator["Cameras"]:
        return (self[i] for i in range(len(self)))

    @property
    def same_size(self) -> bool:
        """Whether all images have one size, so that they can be stacked."""
        return len(self) == 0 or bool((self.sizes == self.sizes[0]).all())

    @property
    def width(self) -> int:
        """Image width that all share, pixels.

        Raises: ValueError if sizes differ.
        """
        return self._shared_size(0)

    @property
    def height(self) -> int:
        """Image height that all share, pixels.

        Raises: ValueError if sizes differ.
        """
        return self._shared_size(1)

    def _shared_size(self, axis: int) -> int:
        if len(self) == 0 or not self.same_size:
            found = sorted({tuple(size) for size in self.sizes.tolist()})
            raise ValueError(f"cameras: expected one image size for all views, found {found}")
        return int(self.sizes[0, axis])

    @property
    def centers(self) -> Float[Tensor, "v 3"]:
        """Optical centres in the world."""
        return self.world_from_camera[:, :3, 3]

    @property
    def camera_from_world(self) -> Float[Tensor, "v 4 4"]:
        """Inverse poses, from world to camera coordinates."""
        rotation = self.world_from_camera[:, :3, :3].transpose(1, 2)
        out = torch.eye(4, dtype=rotation.dtype, device=rotation.device).repeat(len(self), 1, 1)
        out[:, :3, :3] = rotation
        out[:, :3, 3] = -(rotation @ self.centers[..., None])[..., 0]
        return out

    def resized(self, factor: float) -> "Cameras":
        """Resample all images by `factor`; sizes are rounded, and intrinsics fit the rounded sizes exactly."""
        return self._of_size(self.sizes * factor)

    def limited(self, longest_px: int) -> "Cameras":
        """Resample each larger image to this longest side."""
        longest = self.sizes.max(1, keepdim=True).values
        return self._of_size(self.sizes * (longest_px / longest).clamp_max(1))

    def _of_size(self, sizes: Float[Tensor, "v 2"]) -> "Cameras":
        sizes = sizes.round().clamp_min(1).to(self.sizes.dtype)
        ratio = (sizes / self.sizes).to(self.intrinsics)
        scale = torch.diag_embed(torch.cat([ratio, torch.ones_like(ratio[:, :1])], 1))
        return replace(self, intrinsics=scale @ self.intrinsics, sizes=sizes)

    def turned(self, quarters: Int[Tensor, "v"]) -> "Cameras":
        """Turn each image counterclockwise by its number of quarters, like torch.rot90; centres stay."""
        poses, intrinsics, sizes = self.world_from_camera.clone(), self.intrinsics.clone(), self.sizes.clone()
        once = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).to(poses)
        for i, count in enumerate(quarters.tolist()):
            for _ in range(count % 4):
                # the pixel at x, y goes to y, width - x
                pixels = torch.tensor([[0.0, 1, 0], [-1, 0, float(sizes[i, 0])], [0, 0, 1]]).to(intrinsics)
                intrinsics[i] = pixels @ intrinsics[i] @ once.to(intrinsics)
                poses[i, :3, :3] = poses[i, :3, :3] @ once
                sizes[i] = sizes[i].flip(0)
        return replace(self, world_from_camera=poses, intrinsics=intrinsics, sizes=sizes)

    def cropped(self, windows: Sequence[Window]) -> "Cameras":
        """Crop each image to its window; names and poses stay."""
        intrinsics = self.intrinsics.clone()
        edges = torch.tensor(windows, dtype=torch.int64).reshape(-1, 4)
        intrinsics[:, :2, 2] -= edges[:, :2].to(intrinsics)
        sizes = (edges[:, 2:] - edges[:, :2]).to(self.sizes.dtype)
        return replace(self, intrinsics=intrinsics, sizes=sizes)

    def rays(self) -> Float[Tensor, "h w 3"]:
        """Compute directions to the pixel centres of the first camera, in its axes, scaled to depth 1."""
        rows, columns = (torch.arange(n, device=self.intrinsics.device) + 0.5 for n in (self.height, self.width))
        v, u = torch.meshgrid(rows, columns, indexing="ij")
        return torch.stack([u, v, torch.ones_like(u)], -1) @ torch.linalg.inv(self.intrinsics[0]).T

    def world_rays(self) -> Float[Tensor, "h w 3"]:
        """Compute directions to the pixel centres of the first camera, in the world, scaled to depth 1."""
        return self.rays() @ self.world_from_camera[0, :3, :3].T

    def unproject(self, depth: Float[Tensor, "h w"]) -> Float[Tensor, "h w 3"]:
        """Compute the world points of the first camera's pixels from their depths along its optical axis."""
        pose = self.world_from_camera[0].to(depth)
        # in the camera first: rays in the world times depth round differently
        return (self.rays().to(depth) * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]

    def project(self, points: Float[Tensor, "*n 3"]) -> tuple[Float[Tensor, "*n 2"], Float[Tensor, "*n"]]:
        """Project world points into the first camera.

        Returns:
            Pixels x and y, which have no meaning unless the depth is above 0, and depths along the optical axis.
        """
        pose, intrinsics = self.camera_from_world[0].to(points), self.intrinsics[0].to(points)
        in_camera = points @ pose[:3, :3].T + pose[:3, 3]
        depth = in_camera[..., 2]
        return (in_camera @ intrinsics.T)[..., :2] / depth[..., None].clamp_min(1e-9), depth

    def spread(self, count: int) -> "Cameras":
        """Select at most `count` cameras, evenly spaced in their order, with the first and the last."""
        return self[torch.linspace(0, len(self) - 1, min(count, len(self))).round().long()]

    def to(self, device: torch.device | str) -> "Cameras":
        """Move the cameras to `device`; sizes stay on the CPU."""
        return replace(self, world_from_camera=self.world_from_camera.to(device), intrinsics=self.intrinsics.to(device))


def pinhole(
    world_from_camera: Float[Tensor, "v 4 4"], focal_px: float, *, width: int, height: int, prefix: str = "view"
) -> Cameras:
    """Make cameras with one focal length and the principal point at the image centre.

    Args:
        world_from_camera: Rigid poses.
        focal_px: Focal length, pixels.
        width: Image width, pixels.
        height: Image height, pixels.
        prefix: Start of the cameras' names.

    Returns:
        v cameras called PREFIX_0000 and so on.
    """
    v = len(world_from_camera)
    intrinsics = torch.tensor([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]]).repeat(v, 1, 1)
    return Cameras(
        world_from_camera=world_from_camera,
        intrinsics=intrinsics.to(world_from_camera),
        sizes=torch.tensor([[width, height]]).repeat(v, 1),
        names=tuple(f"{prefix}_{i:04d}" for i in range(v)),
    )


def look_at(eye: Float[Tensor, "v 3"], target: Float[Tensor, "3"], up: Float[Tensor, "3"]) -> Float[Tensor, "v 4 4"]:
    """Compute the poses of cameras that look at one point.

    Args:
        eye: Optical centres, world units.
        target: The point at the image centre, world units.
        up: Direction that points upwards in the image, not parallel to a line of sight.

    Returns:
        The poses `world_from_camera` (OpenCV axes).
    """
    forward = torch.nn.functional.normalize(target - eye, dim=-1)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up.expand_as(forward)), dim=-1)
    down = torch.linalg.cross(forward, right)
    out = torch.eye(4, dtype=eye.dtype, device=eye.device).repeat(len(eye), 1, 1)
    out[:, :3, :3] = torch.stack([right, down, forward], -1)
    out[:, :3, 3] = eye
    return out
