"""Views of an object alone from the cameras of its capture: cut to the object, with the map from Gaussians to pixels.

The transposed map takes an average of an image over the pixels that each Gaussian covers, weighted by how much it
contributes to them; hidden Gaussians have no weight.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering import ViewOperator, view_operator


@dataclass(frozen=True)
class ObjectViewSettings:
    """Number and size of the views."""

    most_views: int = 16
    """Cameras, spread over the capture."""
    pixels: float = 2.0
    """Width of a view in pixels, per square root of the number of Gaussians: a Gaussian in front then covers a few."""
    least_width: int = 48
    """Pixels."""
    most_width: int = 192
    """Pixels; bounds the time."""
    filled: float = 0.95
    """Share of the width that the bounding sphere fills."""


@dataclass(frozen=True)
class ObjectView:
    """One view of an object of n Gaussians."""

    camera: Cameras
    """A single one, of the cut image."""
    operator: ViewOperator
    """Of the object alone."""
    directions: Float[Tensor, "n 3"]
    """Unit, from the camera to each Gaussian."""


def object_views(
    gaussians: Gaussians,
    sphere: BoundingSphere,
    cameras: Cameras,
    *,
    settings: ObjectViewSettings = ObjectViewSettings(),
) -> tuple[ObjectView, ...]:
    """Views of an object from some of the cameras that have its middle in their image.

    Args:
        gaussians: The n Gaussians of the object.
        sphere: Their bounding sphere.
        cameras: Of the capture, in the same frame.
        settings: Number and size.
    """
    if gaussians.count == 0:
        return ()
    center = torch.einsum("vij,j->vi", cameras.camera_from_world[:, :3, :3], sphere.center)
    center = center + cameras.camera_from_world[:, :3, 3]
    depth = center[:, 2]
    focal = torch.stack([cameras.intrinsics[:, 0, 0], cameras.intrinsics[:, 1, 1]], 1)
    at_px = center[:, :2] / depth[:, None].clamp_min(1e-9) * focal + cameras.intrinsics[:, :2, 2]
    inside = (at_px >= 0).all(1) & (at_px < cameras.sizes).all(1)
    chosen = cameras[(depth > sphere.radius) & inside].spread(settings.most_views)
    wanted = round(settings.pixels * math.sqrt(gaussians.count))
    width = min(max(wanted, settings.least_width), settings.most_width)
    views = []
    for camera in chosen:
        cut = _cut(camera, sphere, width, settings.filled)
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
