"""Initial Gaussians of a reconstruction, one per seed point (Kerbl et al. 2023, 3D Gaussian Splatting).

Seed points are the sparse points, random points in the volume that most cameras see, and the points of a far shell.

Sparse points lie only where features do. Plain walls, windows and sky behind them would start without Gaussians, and
the fit would cover them with Gaussians close to the cameras. The shell lies behind the scene and has the photographs'
colours (Kerbl et al. 2024, A Hierarchical 3D Gaussian Representation, put a sphere of Gaussians around a scene).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import nearest_to_axes
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.spherical_harmonics import dc_from_rgb

_CANDIDATES = 200_000  # random points drawn at a time


@dataclass(frozen=True)
class SeedPoints:
    """Positions, colours and largest widths of m initial Gaussians."""

    points: Float[Tensor, "m 3"]
    """Centres, world units."""
    colors: Float[Tensor, "m 3"]
    """Colours, sRGB in [0, 1]."""
    widest: Float[Tensor, "m"]
    """Upper bound of the Gaussian's standard deviation, world units; may be infinite."""

    def __len__(self) -> int:
        return len(self.points)

    @staticmethod
    def none() -> "SeedPoints":
        """Return no points."""
        return SeedPoints(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0))

    def drawn(self, count: int, seed: int) -> "SeedPoints":
        """Draw at most `count` of the points at random and keep their order."""
        return self.select(
            torch.randperm(len(self), generator=torch.Generator().manual_seed(seed))[:count].sort().values
        )

    def select(self, which: Int[Tensor, "k"] | Bool[Tensor, "m"]) -> "SeedPoints":
        """Return the chosen points."""
        return SeedPoints(self.points[which], self.colors[which], self.widest[which])

    def joined(self, other: "SeedPoints") -> "SeedPoints":
        """Return these points, followed by the others."""
        return SeedPoints(
            torch.cat([self.points, other.points]),
            torch.cat([self.colors, other.colors]),
            torch.cat([self.widest, other.widest]),
        )


def scene_extent(cameras: Cameras) -> float:
    """Compute 1.1 times the largest distance of a camera from the mean camera, world units (3DGS).

    The extent is 1 if all cameras are in one place.
    """
    centers = cameras.centers.cpu()
    radius = 1.1 * float((centers - centers.mean(0)).norm(dim=1).max())
    return radius if radius > 1e-6 else 1.0


def from_points(seeds: SeedPoints) -> Gaussians:
    """Make isotropic Gaussians of opacity 0.5 with the RMS distance to the three nearest points as width.

    Widths are bounded by `seeds.widest` and by ten times the median width.
    """
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
    """Draw points of random colours, uniformly in the volume that most cameras see.

    Candidates lie in a sphere around the point nearest to all optical axes, with the cameras' mean distance as radius.
    A candidate is kept if the number of cameras that see it is more than half of the largest such number.

    Args:
        cameras: Cameras of the capture.
        count: Number of points.
        seed: Seed of positions and colours.
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
    """Compute the point nearest to most optical axes, and the cameras' mean distance from it, world units."""
    # axes closer than two degrees do not determine a distance
    focus = nearest_to_axes(cameras, prior_weight=1e-3)
    return focus, float((cameras.centers.double().cpu() - focus).norm(dim=1).mean())


def _views_that_see(points: Float[Tensor, "m 3"], cameras: Cameras) -> Float[Tensor, "m"]:
    count = torch.zeros(len(points), dtype=torch.float64)
    for camera in cameras:
        pixel, depth = camera.project(points)
        count += (depth > 0) & (pixel >= 0).all(1) & (pixel < camera.sizes[0]).all(1)
    return count


# the far shell; set by hand
_QUANTILE = 0.99  # quantile of the sparse points' distances from the focus point; wrong points are farther
_BEYOND = 1.5  # radius of the shell over that distance
MIN_RADIUS = 6.0
"""Smallest radius of the shell, over the cameras' mean distance from their focus point."""
_MIN_DIRECTIONS = 64  # fewest directions that estimate the seen share of the sphere
_NEIGHBOURS = 8  # nearest seen points whose mean colour an unseen point takes
_PLAIN_SHARE = 0.05  # share of edge pixels above which their colour is a background; photos of a bonsai have .01 black
_PLAIN_TOLERANCE = 2.5 / 255  # largest difference of a pixel from the background, sRGB


def shell_radius(points: Float[Tensor, "m 3"], focus: Float[Tensor, "3"], reach: float) -> float:
    """Compute the radius of the shell around `focus`, world units; `reach` is the cameras' mean distance from it."""
    if not len(points):
        return MIN_RADIUS * reach
    distances = (points.double() - focus.to(points.device)).norm(dim=1)
    return max(MIN_RADIUS * reach, _BEYOND * float(distances.quantile(_QUANTILE)))


def shows_surroundings(images: Sequence[Float[Tensor, "_ _ 3"]], background: tuple[float, float, float]) -> bool:
    """Test whether images show surroundings, and not an object cut out in front of the colour `background`."""
    edges = torch.cat([torch.cat([image[0], image[-1], image[:, 0], image[:, -1]]) for image in images])
    plain = ((edges - torch.tensor(background)).abs() <= _PLAIN_TOLERANCE).all(1)
    return float(plain.double().mean()) <= _PLAIN_SHARE


def shell_points(
    cameras: Sequence[Cameras],
    images: Sequence[Float[Tensor, "_ _ 3"]],
    *,
    center: Float[Tensor, "3"],
    radius: float,
    count: int,
    margin_deg: float = 15.0,
) -> SeedPoints:
    """Distribute points evenly over the part of a sphere that cameras see.

    A margin of unseen points is added, so that walls do not end at the edge of a photograph.

    Args:
        cameras: One batch of 1 per image.
        images: sRGB in [0, 1].
        center: Centre of the sphere, world units.
        radius: Radius of the sphere, world units.
        count: Approximate number of points.
        margin_deg: Width of the unseen margin, as an angle at the centre.

    Returns:
        Points with the mean colour of all images that show them. Unseen points have the colour of the nearest seen
        ones.
    """
    center = center.float()
    trial = _directions(max(count, _MIN_DIRECTIONS))
    share = float(_near(trial, _colors(center + radius * trial, cameras, images)[1], margin_deg).double().mean())
    if share == 0:
        return SeedPoints.none()
    directions = _directions(max(1, round(count / share)))
    points = center + radius * directions
    colors, seen = _colors(points, cameras, images)
    neighbours = min(_NEIGHBOURS, int(seen.sum()))
    nearest = KDTree(directions[seen].numpy()).query(directions.numpy(), k=neighbours)[1]
    around = colors[seen][torch.from_numpy(nearest.reshape(len(directions), -1))].mean(1)
    spacing = radius * math.sqrt(4 * math.pi / len(directions))
    shell = SeedPoints(points, torch.where(seen[:, None], colors, around), torch.full((len(points),), spacing))
    return shell.select(_near(directions, seen, margin_deg))


def _colors(
    points: Float[Tensor, "m 3"], cameras: Sequence[Cameras], images: Sequence[Tensor]
) -> tuple[Float[Tensor, "m 3"], Bool[Tensor, "m"]]:
    """Compute the mean colour of points over all images that show them, and which points are shown."""
    total, count = torch.zeros(len(points), 3), torch.zeros(len(points))
    for camera, image in zip(cameras, images, strict=True):
        pixels, depth = camera.project(points)
        size = torch.tensor([camera.width, camera.height])
        inside = (depth > 0) & (pixels >= 0).all(1) & (pixels < size).all(1)
        column, row = pixels[inside].long().T
        total[inside] += image[row, column]
        count[inside] += 1
    return total / count.clamp_min(1)[:, None], count > 0


def _near(directions: Float[Tensor, "m 3"], seen: Bool[Tensor, "m"], margin_deg: float) -> Bool[Tensor, "m"]:
    """Test which directions are seen, or within the margin of a seen one."""
    if not seen.any():
        return seen
    distance = KDTree(directions[seen].numpy()).query(directions.numpy())[0]
    return torch.from_numpy(distance <= 2 * math.sin(math.radians(margin_deg) / 2))


def _directions(count: int) -> Float[Tensor, "m 3"]:
    """Return unit vectors on a Fibonacci lattice."""
    i = torch.arange(count, dtype=torch.float64) + 0.5
    z, turn = 1 - 2 * i / count, i * math.pi * (3 - math.sqrt(5))
    across = (1 - z.square()).clamp_min(0).sqrt()
    return torch.stack([across * turn.cos(), across * turn.sin(), z], 1).float()
