"""Views of an object alone from the cameras of its capture, and its normals from their depth.

The map from Gaussians to pixels, transposed, takes an average of an image over the pixels that each Gaussian covers,
weighted by how much it contributes to them; hidden Gaussians have no weight. The inverse depth of a plane is linear in
the pixel, so its gradient, fitted over a small window, is the normal. Every Gaussian takes the mean over its pixels in
all views; the shape of the surrounding Gaussians decides as far as it is flat, and wherever no camera looks.
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

# number and size of the views
_MAX_VIEWS = 16  # cameras, spread over the capture
_PIXELS = 2.0
"""Width of a view in pixels, per square root of the number of Gaussians: a Gaussian in front then covers a few."""
_MIN_WIDTH = 48  # pixels
_MAX_WIDTH = 128  # pixels; bounds the time
_FILLED = 0.95  # share of the width that the bounding sphere fills


@dataclass(frozen=True)
class ObjectView:
    """One view of an object of n Gaussians."""

    camera: Cameras
    """A single one, of the cut image."""
    operator: ViewOperator
    """The view's linear map for the object alone."""
    directions: Float[Tensor, "n 3"]
    """Unit, from the camera to each Gaussian."""


def object_views(gaussians: Gaussians, sphere: BoundingSphere, cameras: Cameras) -> tuple[ObjectView, ...]:
    """Views of an object from some of the cameras that have its middle in their image.

    Args:
        gaussians: The n Gaussians of the object.
        sphere: Their bounding sphere.
        cameras: Of the capture, in the same frame.
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
    wanted = round(_PIXELS * math.sqrt(gaussians.count))
    width = min(max(wanted, _MIN_WIDTH), _MAX_WIDTH)
    views = []
    for camera in chosen:
        cut = _cut(camera, sphere, width, _FILLED)
        directions = torch.nn.functional.normalize(gaussians.means - cut.centers[0], dim=1)
        views.append(ObjectView(cut, view_operator(gaussians, cut), directions))
    return tuple(views)


def _cut(camera: Cameras, sphere: BoundingSphere, width: int, filled: float) -> Cameras:
    """The camera with a square image that the sphere fills."""
    pose = camera.camera_from_world[0]
    x, y, z = (pose[:3, :3] @ sphere.center + pose[:3, 3]).tolist()
    focal = filled * 0.5 * width * z / sphere.radius
    middle = 0.5 * width
    intrinsics = torch.tensor([[focal, 0, middle - focal * x / z], [0, focal, middle - focal * y / z], [0, 0, 1]])
    return Cameras(
        world_from_camera=camera.world_from_camera,
        intrinsics=intrinsics[None],
        sizes=torch.tensor([[width, width]]),
        names=camera.names,
    )


_normalize = torch.nn.functional.normalize

# how depth becomes normals; chosen on eight scenes with true normals, flat around these values
_REACH = 2  # pixels from the middle of the fitted window to its edge; the best of 1, 2, 3
_WINDOW = 1.4  # pixels; standard deviation of the window's weights
_SAME_SURFACE = 0.1  # radii of the object; standard deviation of depth within a window, so that edges are not bridged
_COVERED = 0.5  # A pixel of at least this alpha shows the object
_MIN_FILLED = 0.3  # share of the window's weight that must lie on the object
_MIN_PIXELS = 0.5  # pixels that a Gaussian covers in all views together, where depth and neighbours count alike
_NEIGHBOURS = 2.0
"""Weight of the neighbours' normal times the third power of its confidence, beside the depth's of 1: on a smooth
surface more of them average more noise (5.0 degrees instead of 7.5), near edges they mislead."""


def fuse_normals(gaussians: Gaussians, views: tuple[ObjectView, ...], neighbours: Normals, *, radius: float) -> Normals:
    """Normals from depth images and neighbours together.

    Args:
        gaussians: The n Gaussians of an object.
        views: Of the object alone.
        neighbours: Estimate from the Gaussians' own shapes; returned as it is where there are no views.
        radius: Of the object, world units.

    Returns:
        Normals, of which `confidence` is the agreement of both, in [0, 1].
    """
    total = torch.zeros(gaussians.count, 4)
    for view in views:
        normals, weight = _normals_of(_inverse_depth(gaussians, view), view, radius)
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
    """Mean inverse depth given a hit; 0 where the object is not."""
    pose = view.camera.camera_from_world[0]
    depth = (gaussians.means @ pose[:3, :3].T + pose[:3, 3])[:, 2:3]
    alpha = view.operator.alpha
    mean = view.operator.blend(1 / depth.clamp_min(1e-9))[..., 0] / alpha.clamp_min(1e-6)
    return torch.where(alpha > _COVERED, mean, torch.zeros(()))


def _normals_of(
    inverse: Float[Tensor, "h w"], view: ObjectView, radius: float
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w 1"]]:
    """World normals towards the camera by weighted least squares over windows, and their weight: cosine to the view."""
    h, w = inverse.shape
    reach = _REACH
    steps = torch.arange(-reach, reach + 1.0)
    down, across = (s.reshape(-1, 1) for s in torch.meshgrid(steps, steps, indexing="ij"))
    gauss = torch.exp(-(across**2 + down**2) / (2 * _WINDOW**2))
    # rows: pixels of the window; columns: its middle
    values = torch.nn.functional.unfold(inverse[None, None], 2 * reach + 1, padding=reach)[0]
    middle = inverse.reshape(1, -1)
    depth = 1 / middle.clamp_min(1e-9)
    off = (values - middle) * depth * depth / (_SAME_SURFACE * radius)
    weight = gauss * (values > 0) * (middle > 0) * torch.exp(-0.5 * off**2)
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
