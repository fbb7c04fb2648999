"""What a rendered pair's folder says of its surfaces: points as surfels, pixels as points. Knows no light."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.directions import frames_along
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import read_mask, read_rgb
from splatgraft.core.rotations import quaternion_from_rotation
from splatgraft.core.spherical_harmonics import C0


@dataclass(frozen=True)
class SurfacePixels:
    """The surfaces that the pictures of one object's take show, all cameras."""

    points: Float[Tensor, "v h w 3"]
    """World, metres."""
    normals: Float[Tensor, "v h w 3"]
    """Unit, world."""
    mask: Float[Tensor, "v h w"]
    """How much of each pixel is the object."""
    there: Bool[Tensor, "v h w"]
    """Whether anything is."""


def read_pixels(folder: Path, object_: str, cameras: Cameras) -> SurfacePixels:
    """The pixels of a take, lifted by their depth.

    Raises: ValueError where a picture is missing or broken.
    """
    take, points, normals, masks = folder / object_, [], [], []
    for i in range(len(cameras)):
        path = take / f"{i:04d}_depth.npy"
        try:
            depth = torch.from_numpy(np.load(path, allow_pickle=False).astype(np.float32))
        except (OSError, ValueError) as error:
            raise ValueError(f"{path}: expected a depth map, found {error}") from error
        k, pose = cameras.intrinsics[i], cameras.world_from_camera[i]
        h, w = depth.shape
        v, u = torch.meshgrid(torch.arange(h) + 0.5, torch.arange(w) + 0.5, indexing="ij")
        rays = torch.stack([(u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], torch.ones_like(u)], -1)
        points.append((rays * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3])
        normal = read_rgb(take / f"{i:04d}_normal.png") * 2 - 1
        normals.append(torch.nn.functional.normalize(normal, dim=-1))
        masks.append(torch.where(depth > 0, read_mask(take / f"{i:04d}_mask.png"), -1.0))
    mask = torch.stack(masks)
    return SurfacePixels(torch.stack(points), torch.stack(normals), mask.clamp_min(0), mask >= 0)


def read_surfels(folder: Path, name: str, color: Float[Tensor, "3"]) -> Gaussians:
    """The points of a surface as flat, opaque Gaussians that close it, of one sRGB colour.

    Raises: ValueError where they are missing or broken.
    """
    path = folder / f"{name}_surface" / "0000.npy"
    try:
        found = torch.from_numpy(np.load(path, allow_pickle=False).astype(np.float32))
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: expected points on surfaces, found {error}") from error
    if found.ndim != 2 or found.shape[1] != 6 or len(found) < 10:
        raise ValueError(f"{path}: expected (n, 6) points and normals, found {tuple(found.shape)}")
    return surfels(found[:, :3], torch.nn.functional.normalize(found[:, 3:], dim=1), color)


def surfels(points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], color: Float[Tensor, "3"]) -> Gaussians:
    """Flat, opaque Gaussians as wide as the points are apart."""
    distances, _ = KDTree(points.numpy()).query(points.numpy()[::7], k=5)
    width = max(1e-4, 0.6 * float(np.median(distances[:, -1])))
    rotations = frames_along(-normals).transpose(1, 2)
    return Gaussians(
        means=points,
        log_scales=torch.tensor([width, width, 0.1 * width]).log().repeat(len(points), 1),
        quaternions=quaternion_from_rotation(rotations),
        opacity_logits=torch.full((len(points),), 3.0),
        sh=((color - 0.5) / C0).repeat(len(points), 1)[:, None],
    )
