"""Surfaces of a rendered pair: pixels lifted to points by their depth, and sampled points as surfels."""

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
class SurfelSettings:
    """Shape of the surfels, set by hand."""

    neighbor: int = 4
    """The spacing of points is the median distance to this nearest neighbour."""
    spacing_stride: int = 7
    """Every so manyth point is used to measure the spacing."""
    width: float = 0.6
    """Standard deviation in the surface over the spacing."""
    min_width: float = 1e-4
    """Smallest standard deviation in the surface, metres."""
    flatness: float = 0.1
    """Standard deviation along the normal over that in the surface."""
    opacity_logit: float = 3.0


@dataclass(frozen=True)
class SurfacePixels:
    """The surface points visible in the pixels of all cameras, with one object in the scene."""

    points: Float[Tensor, "v h w 3"]
    """World, metres."""
    normals: Float[Tensor, "v h w 3"]
    """Unit, world."""
    mask: Float[Tensor, "v h w"]
    """Coverage by the object, in [0, 1]."""
    hit: Bool[Tensor, "v h w"]
    """False where the pixel shows the sky."""


def read_pixels(folder: Path, object_: str, cameras: Cameras) -> SurfacePixels:
    """Read the pixels of an object's take and lift them to points by their depth.

    Args:
        folder: of a rendered scene.
        object_: name of the object.
        cameras: of the scene.

    Raises:
        ValueError: a file is missing or broken.
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
    """Read points sampled on a surface as surfels, see `surfels`.

    Args:
        folder: of a rendered scene.
        name: of the object, or `scene`.
        color: of all surfels, sRGB.

    Raises:
        ValueError: the points are missing or broken.
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
    """Make flat, opaque Gaussians whose width follows the spacing of the points, so that they close the surface."""
    settings = SurfelSettings()
    samples = points.numpy()[:: settings.spacing_stride]
    distances, _ = KDTree(points.numpy()).query(samples, k=settings.neighbor + 1)
    width = max(settings.min_width, settings.width * float(np.median(distances[:, -1])))
    rotations = frames_along(-normals).transpose(1, 2)
    return Gaussians(
        means=points,
        log_scales=torch.tensor([width, width, settings.flatness * width]).log().repeat(len(points), 1),
        quaternions=quaternion_from_rotation(rotations),
        opacity_logits=torch.full((len(points),), settings.opacity_logit),
        sh=((color - 0.5) / C0).repeat(len(points), 1)[:, None],
    )
