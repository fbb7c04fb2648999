"""A shell of Gaussians behind the scene, in the colours that the photographs show around it.

Sparse points end where features do. What lies behind them, such as plain walls, windows and sky, then has no Gaussian,
and fits fill it by Gaussians close to the cameras. (Kerbl et al. 2024, A Hierarchical 3D Gaussian Representation, put a
sphere of Gaussians around a scene as its sky.)
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.reconstruction.initialization import SeedPoints

_FEWEST = 64
"""Directions by which the seen share of the sphere is found."""
_NEIGHBOURS = 8
"""Seen points whose mean colour continues beyond them."""


@dataclass(frozen=True)
class ShellOptions:
    """Size of the shell; set by hand."""

    share: float = 0.05
    """Gaussians of the shell over the budget."""
    quantile: float = 0.99
    """Of the known points' distances from where the cameras look; wrong points lie beyond."""
    beyond: float = 1.5
    """Radius over that distance."""
    nearest: float = 6.0
    """Least radius, over the cameras' distance from where they look."""
    margin_deg: float = 15.0
    """How far the shell goes on beyond what photographs show, so that walls do not end at the edge of a photograph."""
    longest_side_px: int = 160
    """Size of the images whose colours are taken."""
    plain: float = 0.05
    """Share of the pixels at the images' edges above which a colour is taken for what was put behind the scene; that of
    black in the bonsai's photos is .01."""
    plain_tolerance: float = 2.5 / 255
    """How far a pixel of that colour may be from it, sRGB."""


def shell_radius(points: Float[Tensor, "m 3"], focus: Float[Tensor, "3"], reach: float, options: ShellOptions) -> float:
    """Distance of the shell from `focus`, world units.

    Args:
        points: Known points of the scene.
        focus: Where the cameras look.
        reach: Their mean distance from it.
        options: Size of the shell.
    """
    least = options.nearest * reach
    if not len(points):
        return least
    distances = (points.double() - focus.to(points.device)).norm(dim=1)
    return max(least, options.beyond * float(distances.quantile(options.quantile)))


def shows_surroundings(
    images: Sequence[Float[Tensor, "_ _ 3"]], background: tuple[float, float, float], options: ShellOptions
) -> bool:
    """Whether images show what is around, and not a scene cut out before the colour `background`."""
    edges = torch.cat([torch.cat([image[0], image[-1], image[:, 0], image[:, -1]]) for image in images])
    plain = ((edges - torch.tensor(background)).abs() <= options.plain_tolerance).all(1)
    return float(plain.double().mean()) <= options.plain


def shell_points(
    cameras: Sequence[Cameras],
    images: Sequence[Float[Tensor, "_ _ 3"]],
    *,
    center: Float[Tensor, "3"],
    radius: float,
    count: int,
    margin_deg: float,
) -> SeedPoints:
    """Points on a sphere that some camera sees, evenly distributed, in the mean colour of all photographs there.

    Args:
        cameras: One batch of 1 per image.
        images: sRGB.
        center: Of the sphere, world units.
        radius: Of the sphere, world units.
        count: About how many points there are.
        margin_deg: How far from a seen point, as an angle at the centre, there are points that no camera sees; they
            have the colours of the nearest that are seen.

    Returns:
        No points where no camera sees the sphere.
    """
    trial = _Colors.of(_directions(max(count, _FEWEST)), center.float(), radius, cameras, images)
    share = float(trial.near(margin_deg).double().mean())
    if share == 0:
        return SeedPoints.none()
    directions = _directions(max(1, round(count / share)))
    found = _Colors.of(directions, center.float(), radius, cameras, images)
    spacing = radius * math.sqrt(4 * math.pi / len(directions))
    points = center.float() + radius * directions
    return SeedPoints(points, found.filled(), torch.full((len(points),), spacing)).select(found.near(margin_deg))


@dataclass(frozen=True)
class _Colors:
    """What cameras see in directions from the centre."""

    directions: Float[Tensor, "m 3"]
    colors: Float[Tensor, "m 3"]
    seen: Bool[Tensor, "m"]

    @staticmethod
    def of(
        directions: Tensor, center: Tensor, radius: float, cameras: Sequence[Cameras], images: Sequence[Tensor]
    ) -> "_Colors":
        points = center + radius * directions
        total, count = torch.zeros(len(points), 3), torch.zeros(len(points))
        for camera, image in zip(cameras, images, strict=True):
            pose, k = camera.camera_from_world[0].float(), camera.intrinsics[0].float()
            x = points @ pose[:3, :3].T + pose[:3, 3]
            pixels = (x @ k.T)[:, :2] / x[:, 2:].clamp_min(1e-6)
            size = torch.tensor([camera.width, camera.height])
            inside = (x[:, 2] > 0) & (pixels >= 0).all(1) & (pixels < size).all(1)
            column, row = pixels[inside].long().T
            total[inside] += image[row, column]
            count[inside] += 1
        return _Colors(directions, total / count.clamp_min(1)[:, None], count > 0)

    def near(self, margin_deg: float) -> Bool[Tensor, "m"]:
        """Which directions are seen, or closer than this to one that is."""
        if not self.seen.any():
            return self.seen
        distance = KDTree(self.directions[self.seen].numpy()).query(self.directions.numpy())[0]
        return torch.from_numpy(distance <= 2 * math.sin(math.radians(margin_deg) / 2))

    def filled(self) -> Float[Tensor, "m 3"]:
        """Colours, where nothing is seen the mean of the nearest that are."""
        neighbours = min(_NEIGHBOURS, int(self.seen.sum()))
        nearest = KDTree(self.directions[self.seen].numpy()).query(self.directions.numpy(), k=neighbours)[1]
        around = self.colors[self.seen][torch.from_numpy(nearest.reshape(len(self.directions), -1))].mean(1)
        return torch.where(self.seen[:, None], self.colors, around)


def _directions(count: int) -> Float[Tensor, "m 3"]:
    """Unit vectors on a Fibonacci lattice."""
    i = torch.arange(count, dtype=torch.float64) + 0.5
    z, turn = 1 - 2 * i / count, i * math.pi * (3 - math.sqrt(5))
    across = (1 - z.square()).clamp_min(0).sqrt()
    return torch.stack([across * turn.cos(), across * turn.sin(), z], 1).float()
