"""Initial Gaussians of a reconstruction: one per sparse point (3DGS), and random points where the cameras look."""

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.spherical_harmonics import dc_from_rgb

_CANDIDATES = 200_000
"""Random points drawn at a time."""


def scene_extent(cameras: Cameras) -> float:
    """1.1 times the largest distance of a camera from the cameras' mean, world units (3DGS); 1 for a single place."""
    centers = cameras.centers.cpu()
    radius = 1.1 * float((centers - centers.mean(0)).norm(dim=1).max())
    return radius if radius > 1e-6 else 1.0


def from_points(points: Float[Tensor, "m 3"], colors: Float[Tensor, "m 3"], *, count: int, seed: int) -> Gaussians:
    """Isotropic Gaussians of opacity one half at the points, as wide as the rms distance to the three nearest points.

    Args:
        points: World units.
        colors: sRGB in [0, 1].
        count: Largest number of Gaussians; of more points, so many are drawn at random.
        seed: Of the draw.
    """
    if len(points) > count:
        order = torch.randperm(len(points), generator=torch.Generator().manual_seed(seed))[:count]
        points, colors = points[order.sort().values], colors[order.sort().values]
    n = len(points)
    array = points.double().numpy()
    neighbours = min(4, n)
    distances = KDTree(array).query(array, k=neighbours)[0].reshape(n, -1)[:, 1:] if n > 1 else np.full((n, 1), 1.0)
    spacing = np.sqrt((distances**2).mean(1))
    # an isolated point would start as a Gaussian that covers every image
    spacing = spacing.clip(max(1e-7, 1e-3 * float(np.median(spacing))), 10 * float(np.median(spacing)) + 1e-7)
    log_scales = torch.from_numpy(np.log(spacing)).float()[:, None].repeat(1, 3)
    return Gaussians(
        means=points.float().clone(),
        log_scales=log_scales,
        quaternions=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        opacity_logits=torch.zeros(n),
        sh=dc_from_rgb(colors.float())[:, None, :].clone(),
    )


def random_points(cameras: Cameras, *, count: int, seed: int) -> Float[Tensor, "m 3"]:
    """`count` points, uniform in the volume that most cameras see; each lies in front of a camera.

    They are drawn in a sphere around the point nearest to all optical axes, with the cameras' mean distance as radius;
    a point stays if more than half as many cameras see it as see the best-seen point.
    """
    generator = torch.Generator().manual_seed(seed)
    centers, forward = cameras.centers.double().cpu(), cameras.world_from_camera[:, :3, 2].double().cpu()
    focus = _nearest_to_axes(centers, forward)
    reach = float((centers - focus).norm(dim=1).mean())
    kept: list[Tensor] = []
    missing = count
    while missing > 0:
        directions = torch.randn(_CANDIDATES, 3, generator=generator, dtype=torch.float64)
        radius = reach * torch.rand(_CANDIDATES, 1, generator=generator, dtype=torch.float64) ** (1 / 3)
        candidates = focus + radius * torch.nn.functional.normalize(directions, dim=1)
        seen = _views_that_see(candidates, cameras)
        good = candidates[seen > 0.5 * seen.max()]
        kept.append(good[:missing].float())
        missing -= len(kept[-1])
    return torch.cat(kept)


def _nearest_to_axes(centers: Float[Tensor, "v 3"], forward: Float[Tensor, "v 3"]) -> Float[Tensor, "3"]:
    """Least-squares intersection of the optical axes, with a weak prior in front of the cameras for parallel axes."""
    across = torch.eye(3, dtype=torch.float64) - forward[:, :, None] * forward[:, None, :]
    spread = max(float((centers - centers.mean(0)).norm(dim=1).max()), 1e-3)
    prior = (centers + 2 * spread * forward).mean(0)
    weight = 1e-3 * len(centers)
    matrix = across.sum(0) + weight * torch.eye(3, dtype=torch.float64)
    return torch.linalg.solve(matrix, (across @ centers[..., None]).sum(0)[:, 0] + weight * prior)


def _views_that_see(points: Float[Tensor, "m 3"], cameras: Cameras) -> Float[Tensor, "m"]:
    count = torch.zeros(len(points), dtype=torch.float64)
    for pose, intrinsics, size in zip(
        cameras.camera_from_world.double().cpu(), cameras.intrinsics.double().cpu(), cameras.sizes, strict=True
    ):
        x = (points @ pose[:3, :3].T + pose[:3, 3]) @ intrinsics.T
        pixel = x[:, :2] / x[:, 2:].clamp_min(1e-9)
        count += (x[:, 2] > 0) & (pixel >= 0).all(1) & (pixel < size).all(1)
    return count
