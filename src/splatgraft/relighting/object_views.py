"""Views of an object alone from the cameras of its capture, and its normals from their depth.

1. Draw the object alone in some cameras (`object_views`).
2. Fit the gradient of inverse depth in a small window around each pixel. The inverse depth of a plane is linear in the
   pixel, so the gradient gives the normal (`_normals_of`).
3. Average the pixels' normals for each Gaussian by the transposed map from Gaussians to pixels. It weights pixels by
   the Gaussian's contribution, so hidden Gaussians get no weight.
4. Add the normals from the neighbours' shapes, weighted by their confidence (`fuse_normals`). They alone give the
   normals of Gaussians that no camera sees.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.relighting.normals import Normals
from splatgraft.rendering import ViewOperator, view_operator

_MAX_VIEWS = 16  # cameras, spread over the capture
_MIN_WIDTH, _MAX_WIDTH = 48, 128  # pixels of a view; the larger one bounds the time


@dataclass(frozen=True)
class ObjectView:
    """One view of an object of n Gaussians."""

    camera: Cameras
    """A single camera, with an image cut to the object."""
    operator: ViewOperator
    """Linear map from values of the object's Gaussians to pixels."""
    directions: Float[Tensor, "n 3"]
    """Unit, from the camera to each Gaussian."""


def object_views(gaussians: Gaussians, sphere: BoundingSphere, cameras: Cameras) -> tuple[ObjectView, ...]:
    """Draw views of an object from cameras that have its middle in their image.

    Args:
        gaussians: The n Gaussians of the object.
        sphere: The object's bounding sphere.
        cameras: Cameras of the capture, in the same frame.

    Returns:
        At most 16 views.
    """
    if gaussians.count == 0:
        return ()
    center = torch.einsum("vij,j->vi", cameras.camera_from_world[:, :3, :3], sphere.center)
    center = center + cameras.camera_from_world[:, :3, 3]
    depth = center[:, 2]
    focal = torch.stack([cameras.intrinsics[:, 0, 0], cameras.intrinsics[:, 1, 1]], 1)
    at_px = center[:, :2] / depth[:, None].clamp_min(1e-9) * focal + cameras.intrinsics[:, :2, 2]
    inside = (at_px >= 0).all(1) & (at_px < cameras.sizes).all(1)
    chosen = cameras[(depth > sphere.radius) & inside].spread(_MAX_VIEWS)
    wanted = round(2 * math.sqrt(gaussians.count))  # a Gaussian in front covers a few pixels
    width = min(max(wanted, _MIN_WIDTH), _MAX_WIDTH)
    views = []
    for camera in chosen:
        cut = _cut(camera, sphere, width)
        directions = torch.nn.functional.normalize(gaussians.means - cut.centers[0], dim=1)
        views.append(ObjectView(cut, view_operator(gaussians, cut), directions))
    return tuple(views)


def _cut(camera: Cameras, sphere: BoundingSphere, width: int) -> Cameras:
    """Cut a camera to a square image; the sphere fills 95% of its width."""
    pose = camera.camera_from_world[0]
    x, y, z = (pose[:3, :3] @ sphere.center + pose[:3, 3]).tolist()
    focal = 0.95 * 0.5 * width * z / sphere.radius
    middle = 0.5 * width
    intrinsics = torch.tensor([[focal, 0, middle - focal * x / z], [0, focal, middle - focal * y / z], [0, 0, 1]])
    return Cameras(
        world_from_camera=camera.world_from_camera,
        intrinsics=intrinsics[None],
        sizes=torch.tensor([[width, width]]),
        names=camera.names,
    )


_normalize = torch.nn.functional.normalize

# normals from depth; chosen on eight scenes with true normals, flat around these values
_REACH = 2  # pixels from the middle of the fitted window to its edge; the best of 1, 2, 3
_WINDOW = 1.4  # pixels; standard deviation of the window's weights
_COVERED = 0.5  # smallest alpha of a pixel that shows the object
_MIN_FILLED = 0.3  # smallest share of the window's weight on the object
_MIN_PIXELS = 0.5  # pixels of a Gaussian in all views together at which the weight of its depth is half
_NEIGHBOURS = 2.0
"""Weight of the neighbours' normal of confidence 1, which falls with the third power; the weight of depth is 1.

On a smooth surface a larger weight averages more noise (5.0 degrees instead of 7.5); near edges it misleads."""


def fuse_normals(gaussians: Gaussians, views: tuple[ObjectView, ...], neighbours: Normals) -> Normals:
    """Fuse normals from depth images with normals from neighbours.

    Args:
        gaussians: The n Gaussians of an object.
        views: Views of the object alone; without any, `neighbours` is the result.
        neighbours: Estimate from the Gaussians' own shapes.

    Returns:
        Normals, with the agreement of both estimates as confidence, in [0, 1].
    """
    total = torch.zeros(gaussians.count, 4)
    for view in views:
        normals, weight = _normals_of(_inverse_depth(gaussians, view), view)
        total += view.operator.blend_transpose(torch.cat([normals * weight, weight], 2).contiguous())
    pixels = total[:, 3:]
    by_depth = _normalize(total[:, :3], dim=1) * pixels / (pixels + _MIN_PIXELS)
    by_shape = (_NEIGHBOURS * neighbours.confidence[:, None] ** 3 + 1e-3) * neighbours.vectors
    joined = by_depth + by_shape
    most = by_depth.norm(dim=1) + by_shape.norm(dim=1)
    seen = pixels[:, 0] > _MIN_PIXELS
    return Normals(
        vectors=torch.where(joined.norm(dim=1, keepdim=True) > 1e-6, _normalize(joined, dim=1), neighbours.vectors),
        confidence=torch.where(seen, joined.norm(dim=1) / most.clamp_min(1e-9), neighbours.confidence),
        seen=seen | neighbours.seen,
    )


def _inverse_depth(gaussians: Gaussians, view: ObjectView) -> Float[Tensor, "h w"]:
    """Draw the mean inverse depth of the object; 0 in pixels beside it."""
    pose = view.camera.camera_from_world[0]
    depth = (gaussians.means @ pose[:3, :3].T + pose[:3, 3])[:, 2:3]
    alpha = view.operator.alpha
    mean = view.operator.blend(1 / depth.clamp_min(1e-9))[..., 0] / alpha.clamp_min(1e-6)
    return torch.where(alpha > _COVERED, mean, torch.zeros(()))


def _normals_of(
    inverse: Float[Tensor, "h w"], view: ObjectView
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w 1"]]:
    """Fit world normals towards the camera by weighted least squares over windows, with the view's cosine as weight."""
    h, w = inverse.shape
    reach = _REACH
    steps = torch.arange(-reach, reach + 1.0)
    down, across = (s.reshape(-1, 1) for s in torch.meshgrid(steps, steps, indexing="ij"))
    gauss = torch.exp(-(across**2 + down**2) / (2 * _WINDOW**2))
    # rows: pixels of the window; columns: its middle
    values = torch.nn.functional.unfold(inverse[None, None], 2 * reach + 1, padding=reach)[0]
    weight = gauss * (values > 0) * (inverse.reshape(1, -1) > 0)
    sum_ = weight.sum(0).clamp_min(1e-9)

    def mean(term: Tensor) -> Tensor:
        return (weight * term).sum(0) / sum_

    x, y, v = mean(across), mean(down), mean(values)
    xx, yy, xy = mean(across**2) - x * x, mean(down**2) - y * y, mean(across * down) - x * y
    xv, yv = mean(across * values) - x * v, mean(down * values) - y * v
    determinant = (xx * yy - xy * xy).clamp_min(1e-4)
    slope_x, slope_y = (xv * yy - yv * xy) / determinant, (yv * xx - xv * xy) / determinant
    row, column = torch.meshgrid(torch.arange(h) + 0.5, torch.arange(w) + 0.5, indexing="ij")
    row, column = row.reshape(-1), column.reshape(-1)
    offset = v - slope_x * (column + x) - slope_y * (row + y)
    # on a plane n . p = d the inverse depth is (n / d) . ((u - cx) / fx, (v - cy) / fy, 1)
    k = view.camera.intrinsics[0]
    plane = torch.stack([slope_x * k[0, 0], slope_y * k[1, 1], offset + slope_x * k[0, 2] + slope_y * k[1, 2]], 1)
    normal = -_normalize(plane, dim=1)
    ray = torch.stack([(column - k[0, 2]) / k[0, 0], (row - k[1, 2]) / k[1, 1], torch.ones_like(row)], 1)
    cosine = -(normal * _normalize(ray, dim=1)).sum(1).clamp_max(0)
    used = cosine * (sum_ > _MIN_FILLED * gauss.sum())
    world = normal @ view.camera.camera_from_world[0, :3, :3]
    return world.reshape(h, w, 3), used.reshape(h, w, 1)
