"""The value `ExportSource`, a scene to export and what is known of it; its frame, first view and a path around it."""

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
_DISTANCE = 2.2  # from the middle of a scene without cameras, in its radii
_ELEVATION_DEG = 20.0
_IN_FRONT = 0.5  # cosine of the angle between a camera that may be the first one and the side that was photographed
_CENTRAL = 0.6  # half of the picture's sides within which the object's middle lies in a view that may be the first one

Point = tuple[float, float, float]


@dataclass(frozen=True)
class ExportSource:
    """A scene, and where it is the result of a transfer, what it was made from; all in one frame."""

    scene: Gaussians
    """The scene; of a transfer the relit one, n Gaussians."""
    title: str
    """What pages call it."""
    is_object: Bool[Tensor, "n"] | None = None
    """Which Gaussians of `scene` belong to an object; None where it is not known."""
    pasted: Gaussians | None = None
    """The same scene before the light transfer."""
    place: Gaussians | None = None
    """The target without object and shadow."""
    cameras: Cameras | None = None
    """Those of the capture that the scene was made from."""
    photographed_side: Float[Tensor, "3"] | None = None
    """Horizontal direction from the object to the side that its photographs show; None where they show all."""
    metadata: SceneMetadata = field(default_factory=SceneMetadata)
    """Up direction and size of a world unit, where they are known."""


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
    picture, on the side that was photographed where that is one. Without: from a little above, towards the middle of
    the dense part.
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
    """Cameras on a closed path around the view's centre.

    Between the captured viewpoints where there are cameras, else on a circle through the first view. Sides are even
    numbers of pixels, as video needs them.
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
    """The transform to a frame whose y is vertical and whose unit is a metre, what is known of it, and what to say.

    The origin stays, and the scene turns as little as it can.
    """
    up, said = up_of(source)
    metres = source.metadata.metres_per_unit
    rotation = rotation_between(up, torch.tensor(_DOWN_Y))
    moved = Similarity(scale=metres or 1.0, rotation=rotation, translation=torch.zeros(3))
    size = (
        "its size is not known: a unit of the capture is written as a metre; `splatgraft scale` says how large it is"
        if metres is None
        else f"one unit is a metre; one of the capture was {metres:.4g} m"
    )
    return moved, SceneMetadata(_DOWN_Y, None if metres is None else 1.0), (*said, "turned upright", size)
