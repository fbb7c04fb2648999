"""Initial Gaussians of a reconstruction: one per seed point (3DGS), and random seeds where the cameras look."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.spherical_harmonics import dc_from_rgb

_CANDIDATES = 200_000
"""Random points drawn at a time."""


@dataclass(frozen=True)
class SeedPoints:
    """m points from which Gaussians start."""

    points: Float[Tensor, "m 3"]
    """World units."""
    colors: Float[Tensor, "m 3"]
    """sRGB in [0, 1]."""
    widest: Float[Tensor, "m"]
    """Bound on the Gaussian's standard deviation, world units; may be infinite."""

    def __len__(self) -> int:
        return len(self.points)

    @staticmethod
    def none() -> "SeedPoints":
        """No points."""
        return SeedPoints(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0))

    def drawn(self, count: int, seed: int) -> "SeedPoints":
        """At most `count` of the points, drawn at random, in their order."""
        return self.select(
            torch.randperm(len(self), generator=torch.Generator().manual_seed(seed))[:count].sort().values
        )

    def select(self, which: Int[Tensor, "k"] | Bool[Tensor, "m"]) -> "SeedPoints":
        """The chosen points."""
        return SeedPoints(self.points[which], self.colors[which], self.widest[which])

    def joined(self, other: "SeedPoints") -> "SeedPoints":
        """These points, then the others."""
        return SeedPoints(
            torch.cat([self.points, other.points]),
            torch.cat([self.colors, other.colors]),
            torch.cat([self.widest, other.widest]),
        )


def scene_extent(cameras: Cameras) -> float:
    """1.1 times the largest distance of a camera from the cameras' mean, world units (3DGS); 1 for a single place."""
    centers = cameras.centers.cpu()
    radius = 1.1 * float((centers - centers.mean(0)).norm(dim=1).max())
    return radius if radius > 1e-6 else 1.0


def from_points(seeds: SeedPoints) -> Gaussians:
    """Isotropic Gaussians of opacity one half, as wide as the rms distance to the three nearest points at most."""
    points, colors = seeds.points, seeds.colors
    n = len(points)
    array = points.double().numpy()
    neighbours = min(4, n)
    distances = KDTree(array).query(array, k=neighbours)[0].reshape(n, -1)[:, 1:] if n > 1 else np.full((n, 1), 1.0)
    spacing = np.sqrt((distances**2).mean(1))
    # an isolated point would start as a Gaussian that covers every image
    spacing = spacing.clip(max(1e-7, 1e-3 * float(np.median(spacing))), 10 * float(np.median(spacing)) + 1e-7)
    spacing = np.minimum(spacing, seeds.widest.double().numpy())
    log_scales = torch.from_numpy(np.log(spacing)).float()[:, None].repeat(1, 3)
    return Gaussians(
        means=points.float().clone(),
        log_scales=log_scales,
        quaternions=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        opacity_logits=torch.zeros(n),
        sh=dc_from_rgb(colors.float())[:, None, :].clone(),
    )


def random_seeds(cameras: Cameras, *, count: int, seed: int) -> SeedPoints:
    """`count` points of random colours, uniform in the volume that most cameras see; each lies in front of a camera.

    They are drawn in a sphere around the point nearest to all optical axes, with the cameras' mean distance as radius;
    a point stays if more than half as many cameras see it as see the best-seen point.
    """
    generator = torch.Generator().manual_seed(seed)
    focus, reach = looked_at(cameras)
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
    colors = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed))
    return SeedPoints(torch.cat(kept), colors, torch.full((count,), torch.inf))


def looked_at(cameras: Cameras) -> tuple[Float[Tensor, "3"], float]:
    """The point nearest to all optical axes, and the cameras' mean distance from it, world units."""
    centers, forward = cameras.centers.double().cpu(), cameras.world_from_camera[:, :3, 2].double().cpu()
    focus = _nearest_to_axes(centers, forward)
    return focus, float((centers - focus).norm(dim=1).mean())


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
