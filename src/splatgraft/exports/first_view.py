"""Where a viewer's camera starts and what it turns around: a captured view of the object, or of a scene's middle."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.bounds import bounding_sphere
from splatgraft.core.cameras import Cameras, look_at, pinhole
from splatgraft.core.capture_orientation import focus_point
from splatgraft.core.directions import tangents
from splatgraft.exports.export_source import ExportSource

_DOWN_Y = (0.0, -1.0, 0.0)
_FOV_DEG = 45.0
_ASPECT = 4 / 3
_DISTANCE = 2.2
"""From the middle of a scene without cameras, in its radii."""
_ELEVATION_DEG = 20.0
_CENTRAL = 0.6
"""Half of the picture's sides within which the object's middle lies in a view that may be the first one."""

Point = tuple[float, float, float]


@dataclass(frozen=True)
class FirstView:
    """Where the viewer's camera starts, and what it turns around; world units."""

    eye: Point
    """Position of the camera."""
    center: Point
    """The point in the middle of the picture."""
    up: Point
    """Unit vector."""
    fov_deg: float
    """Vertical field of view of a picture `aspect` wide, degrees."""
    aspect: float
    """Width over height."""

    def camera(self, width: int) -> Cameras:
        """The same view as a camera of pictures `width` pixels wide."""
        height = max(2, round(width / self.aspect))
        focal = height / 2 / math.tan(math.radians(self.fov_deg) / 2)
        eye, center, up = (torch.tensor(point) for point in (self.eye, self.center, self.up))
        return pinhole(look_at(eye[None], center, up), focal, width=width, height=height)


def first_view(source: ExportSource) -> tuple[FirstView, tuple[str, ...]]:
    """The view, and sentences on what was assumed.

    With cameras: from the one that is nearest to the object's middle among those that have it near the middle of their
    picture. Without: from a little above, towards the middle of the dense part.
    """
    center = middle_of(source)
    up, said = up_of(source)
    if source.cameras is None:
        sphere = bounding_sphere(source.scene)
        level, _ = tangents(up)
        angle = math.radians(_ELEVATION_DEG)
        eye = center + _DISTANCE * sphere.radius * (math.cos(angle) * level + math.sin(angle) * up)
        return FirstView(_point(eye), _point(center), _point(up), _FOV_DEG, _ASPECT), said
    camera = source.cameras[_nearest(source.cameras, center)]
    width, height = camera.sizes[0].tolist()
    fov = 2 * math.degrees(math.atan(height / 2 / float(camera.intrinsics[0, 1, 1])))
    return FirstView(_point(camera.centers[0]), _point(center), _point(up), fov, width / height), said


def middle_of(source: ExportSource) -> Float[Tensor, "3"]:
    """The median of the object's centres, else what the cameras look at, else the middle of the dense part."""
    if source.is_object is not None and bool(source.is_object.any()):
        return source.scene.means[source.is_object].median(0).values
    if source.cameras is not None:
        try:
            return focus_point(source.cameras)
        except ValueError:  # cameras that look outwards
            return source.scene.means.median(0).values
    return bounding_sphere(source.scene).center


def up_of(source: ExportSource) -> tuple[Float[Tensor, "3"], tuple[str, ...]]:
    """The up direction, and a sentence where it is not known."""
    if source.metadata.up is not None:
        return torch.nn.functional.normalize(torch.tensor(source.metadata.up), dim=0), ()
    return torch.tensor(_DOWN_Y), ("up is not known and taken to be -y, as of a level camera; --cameras says it",)


def _nearest(cameras: Cameras, center: Float[Tensor, "3"]) -> int:
    in_camera = torch.einsum("vij,j->vi", cameras.camera_from_world[:, :3], torch.cat([center, torch.ones(1)]))
    projected = torch.einsum("vij,vj->vi", cameras.intrinsics, in_camera)
    half = cameras.sizes / 2
    off = ((projected[:, :2] / projected[:, 2:].clamp_min(1e-6) - half) / half).abs().amax(1)
    seen = (in_camera[:, 2] > 0) & (off < _CENTRAL)
    distance = in_camera.norm(dim=1)
    return int(torch.where(seen, distance, distance + 1e6).argmin())


def _point(values: Float[Tensor, "3"]) -> Point:
    x, y, z = values.tolist()
    return x, y, z
