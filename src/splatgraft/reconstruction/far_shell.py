"""A shell of Gaussians behind the scene, in the colours that the photographs show around it.

Sparse points end where features do. What lies behind them, such as plain walls, windows and sky, then has no Gaussian,
and fits fill it by Gaussians close to the cameras. (Kerbl et al. 2024, A Hierarchical 3D Gaussian Representation, put a
sphere of Gaussians around a scene as its sky.)
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.reconstruction.initialization import SeedPoints

# set by hand
_QUANTILE = 0.99
"""Quantile of the known points' distances from where the cameras look; wrong points lie beyond."""
_BEYOND = 1.5
"""Radius of the shell over that distance."""
MIN_RADIUS = 6.0
"""Smallest radius, over the cameras' distance from where they look."""
_MIN_DIRECTIONS = 64
"""Directions by which the seen share of the sphere is found."""
_NEIGHBOURS = 8
"""Seen points whose mean colour continues beyond them."""
_PLAIN_SHARE = 0.05
"""Share of the pixels at the images' edges above which a colour is taken for what was put behind the scene; that of
black in the bonsai's photos is .01."""
_PLAIN_TOLERANCE = 2.5 / 255
"""How far a pixel of that colour may be from it, sRGB."""


def shell_radius(points: Float[Tensor, "m 3"], focus: Float[Tensor, "3"], reach: float) -> float:
    """Distance of the shell from `focus`, world units; `reach` is the cameras' mean distance from it."""
    if not len(points):
        return MIN_RADIUS * reach
    distances = (points.double() - focus.to(points.device)).norm(dim=1)
    return max(MIN_RADIUS * reach, _BEYOND * float(distances.quantile(_QUANTILE)))


def shows_surroundings(images: Sequence[Float[Tensor, "_ _ 3"]], background: tuple[float, float, float]) -> bool:
    """Whether images show what is around, and not a scene cut out before the colour `background`."""
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
    """About `count` points on a sphere that some camera sees, even, in the mean colour of all photographs there.

    Points that no camera sees lie up to `margin_deg` from a seen one, so that walls do not end at the edge of a
    photograph; they have the colours of the nearest that are seen.
    """
    center = center.float()
    trial = _directions(max(count, _MIN_DIRECTIONS))
    share = float(_near(trial, _colors(center + radius * trial, cameras, images)[1], margin_deg).double().mean())
    if share == 0:
        return SeedPoints.none()
    directions = _directions(max(1, round(count / share)))
    points = center + radius * directions
    colors, seen = _colors(points, cameras, images)
    # where nothing is seen, the mean colour of the nearest directions that are
    neighbours = min(_NEIGHBOURS, int(seen.sum()))
    nearest = KDTree(directions[seen].numpy()).query(directions.numpy(), k=neighbours)[1]
    around = colors[seen][torch.from_numpy(nearest.reshape(len(directions), -1))].mean(1)
    spacing = radius * math.sqrt(4 * math.pi / len(directions))
    shell = SeedPoints(points, torch.where(seen[:, None], colors, around), torch.full((len(points),), spacing))
    return shell.select(_near(directions, seen, margin_deg))


def _colors(
    points: Float[Tensor, "m 3"], cameras: Sequence[Cameras], images: Sequence[Tensor]
) -> tuple[Float[Tensor, "m 3"], Bool[Tensor, "m"]]:
    """Mean colour of the points in all images, and which any camera sees."""
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
    return total / count.clamp_min(1)[:, None], count > 0


def _near(directions: Float[Tensor, "m 3"], seen: Bool[Tensor, "m"], margin_deg: float) -> Bool[Tensor, "m"]:
    """Which directions are seen, or closer than this to one that is."""
    if not seen.any():
        return seen
    distance = KDTree(directions[seen].numpy()).query(directions.numpy())[0]
    return torch.from_numpy(distance <= 2 * math.sin(math.radians(margin_deg) / 2))


def _directions(count: int) -> Float[Tensor, "m 3"]:
    """Unit vectors on a Fibonacci lattice."""
    i = torch.arange(count, dtype=torch.float64) + 0.5
    z, turn = 1 - 2 * i / count, i * math.pi * (3 - math.sqrt(5))
    across = (1 - z.square()).clamp_min(0).sqrt()
    return torch.stack([across * turn.cos(), across * turn.sin(), z], 1).float()
