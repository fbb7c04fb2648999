"""The value `ExportSource`, a scene to export with its parts and cameras; its frame, first view, and a camera path."""

import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.bounds import bounding_sphere
from splatgraft.core.cameras import Cameras, look_at, pinhole
from splatgraft.core.capture_orientation import focus_point
from splatgraft.core.directions import tangents
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.rotations import rotation_between
from splatgraft.core.similarity import Similarity
from splatgraft.evaluation import TurntableOptions, turntable_cameras
from splatgraft.formats import SceneMetadata

_DOWN_Y = (0.0, -1.0, 0.0)
"""Up in the axes of a .ply, whose y points down; formats whose y points up turn it on writing."""
_FOV_DEG = 45.0
_ASPECT = 4 / 3
_DISTANCE = 2.2  # distance of the first view from the middle of a scene without cameras, in radii
_ELEVATION_DEG = 20.0
_IN_FRONT = 0.5  # smallest cosine of the angle between the first view's direction and the photographed side
_CENTRAL = 0.6  # largest distance of the object's middle from the first view's centre, over half of the sides

Point = tuple[float, float, float]


@dataclass(frozen=True)
class ExportSource:
    """A scene and, if it is the result of a transfer, the scenes before it; all in one frame."""

    scene: Gaussians
    """The scene, n Gaussians; the relit composite after a transfer."""
    title: str
    """Title of pages."""
    is_object: Bool[Tensor, "n"] | None = None
    """Whether each Gaussian of `scene` belongs to an object; None if unknown."""
    pasted: Gaussians | None = None
    """The composite before the light transfer."""
    place: Gaussians | None = None
    """The target scene without object and shadow."""
    cameras: Cameras | None = None
    """Cameras of the capture from which the scene was made."""
    photographed_side: Float[Tensor, "3"] | None = None
    """Horizontal direction from the object to the side that its photographs show; None if they show all sides."""
    metadata: SceneMetadata = field(default_factory=SceneMetadata)
    """Up direction and size of a world unit, if they are known."""


@dataclass(frozen=True)
class FirstView:
    """First camera of a viewer and the point around which it turns; world units."""

    eye: Point
    """Position of the camera."""
    center: Point
    """Point in the middle of the picture, around which the camera turns."""
    up: Point
    """Unit up direction."""
    fov_deg: float
    """Vertical field of view, degrees."""
    aspect: float
    """Width of the picture over its height."""

    def camera(self, width: int) -> Cameras:
        """Make the camera of this view for pictures `width` pixels wide."""
        height = max(2, round(width / self.aspect))
        focal = height / 2 / math.tan(math.radians(self.fov_deg) / 2)
        eye, center, up = (torch.tensor(point) for point in (self.eye, self.center, self.up))
        return pinhole(look_at(eye[None], center, up), focal, width=width, height=height)


def first_view(source: ExportSource) -> tuple[FirstView, tuple[str, ...]]:
    """Choose the first view; gives sentences on assumptions, too.

    With cameras it is the captured view nearest to the object's middle. It must show the middle centrally, from the
    side that was photographed if there is only one. Without cameras the view is from a little above, towards the middle
    of the dense part.
    """
    center = middle_of(source)
    up, said = up_of(source)
    if source.cameras is None:
        sphere = bounding_sphere(source.scene)
        level, _ = tangents(up)
        angle = math.radians(_ELEVATION_DEG)
        eye = center + _DISTANCE * sphere.radius * (math.cos(angle) * level + math.sin(angle) * up)
        return FirstView(_point(eye), _point(center), _point(up), _FOV_DEG, _ASPECT), said
    camera = source.cameras[_nearest(source, center)]
    width, height = camera.sizes[0].tolist()
    fov = 2 * math.degrees(math.atan(height / 2 / float(camera.intrinsics[0, 1, 1])))
    return FirstView(_point(camera.centers[0]), _point(center), _point(up), fov, width / height), said


def middle_of(source: ExportSource) -> Float[Tensor, "3"]:
    """Compute the median of the object's centres, else the cameras' focus point, else the middle of the dense part."""
    if source.is_object is not None and bool(source.is_object.any()):
        return source.scene.means[source.is_object].median(0).values
    if source.cameras is not None:
        try:
            return focus_point(source.cameras)
        except ValueError:  # the cameras look outwards
            return source.scene.means.median(0).values
    return bounding_sphere(source.scene).center


def up_of(source: ExportSource) -> tuple[Float[Tensor, "3"], tuple[str, ...]]:
    """Return the up direction, and a sentence if it is not known."""
    if source.metadata.up is not None:
        return torch.nn.functional.normalize(torch.tensor(source.metadata.up), dim=0), ()
    return torch.tensor(_DOWN_Y), (
        "the up direction is not known and taken to be -y, as of a level camera; give it by --cameras",
    )


def _nearest(source: ExportSource, center: Float[Tensor, "3"]) -> int:
    cameras = source.cameras
    assert cameras is not None
    in_camera = torch.einsum("vij,j->vi", cameras.camera_from_world[:, :3], torch.cat([center, torch.ones(1)]))
    projected = torch.einsum("vij,vj->vi", cameras.intrinsics, in_camera)
    half = cameras.sizes / 2
    off = ((projected[:, :2] / projected[:, 2:].clamp_min(1e-6) - half) / half).abs().amax(1)
    seen = (in_camera[:, 2] > 0) & (off < _CENTRAL)
    distance = in_camera.norm(dim=1)
    if source.photographed_side is not None:
        seen &= torch.nn.functional.normalize(cameras.centers - center, dim=1) @ source.photographed_side > _IN_FRONT
    return int(torch.where(seen, distance, distance + 1e6).argmin())


def _point(values: Float[Tensor, "3"]) -> Point:
    x, y, z = values.tolist()
    return x, y, z


def path_around(source: ExportSource, view: FirstView, *, frames: int, width: int) -> Cameras:
    """Make cameras on a closed path around the view's centre.

    The path lies between the captured viewpoints, or without cameras on a circle through the first view. The sides of
    the pictures are even numbers of pixels, because video requires that.
    """
    if frames < 2:
        raise ValueError(f"--frames: expected 2 or more, found {frames}")
    if source.cameras is not None:
        center, up = torch.tensor(view.center), torch.tensor(view.up)
        options = TurntableOptions(frames=frames, start=source.photographed_side)
        cameras = turntable_cameras(source.cameras, center, up=up, options=options)
        cameras = cameras.resized(width / float(cameras.sizes[0, 0]))
        wide, high = cameras.sizes[0].tolist()
        return cameras.cropped([(0, 0, wide - wide % 2, high - high % 2)] * frames)
    up, center = torch.tensor(view.up), torch.tensor(view.center)
    across, along = tangents(up)
    offset = torch.tensor(view.eye) - center
    start, ring = torch.atan2(offset @ along, offset @ across), torch.hypot(offset @ across, offset @ along)
    angles = start + 2 * math.pi * torch.arange(frames) / frames
    eyes = center + ring * (angles.cos()[:, None] * across + angles.sin()[:, None] * along) + (offset @ up) * up
    first = view.camera(width - width % 2)
    height = first.height - first.height % 2
    return pinhole(look_at(eyes, center, up), float(first.intrinsics[0, 0, 0]), width=first.width, height=height)


def upright(source: ExportSource) -> tuple[Similarity, SceneMetadata, tuple[str, ...]]:
    """Compute the transform to a frame whose y axis is vertical and whose unit is a metre.

    The origin stays, and the scene turns as little as possible. Gives the metadata in that frame and sentences on
    assumptions, too.
    """
    up, said = up_of(source)
    metres = source.metadata.metres_per_unit
    rotation = rotation_between(up, torch.tensor(_DOWN_Y))
    moved = Similarity(scale=metres or 1.0, rotation=rotation, translation=torch.zeros(3))
    size = (
        "its size is not known: a unit of the capture is written as a metre; `splatgraft scale` sets the size"
        if metres is None
        else f"one unit is a metre; one of the capture was {metres:.4g} m"
    )
    return moved, SceneMetadata(_DOWN_Y, None if metres is None else 1.0), (*said, "turned upright", size)
