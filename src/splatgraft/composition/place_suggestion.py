"""Where in a scene an object would stand well, and at what size. Knows nothing about the object but its proportions."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.composition.burial import project, spread_cameras, visible_points
from splatgraft.composition.height_map import HeightMap, height_map
from splatgraft.composition.object_base import ObjectBase
from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import focus_point
from splatgraft.core.gaussians import Gaussians

_VIEWS = 12
_IMAGE_SHARE = 0.3
"""Of the image's height that an object fills in a typical view: large enough to see, small enough to have a place."""


@dataclass(frozen=True)
class Suggestion:
    """A place for an object."""

    point: Float[Tensor, "3"]
    """On the surface, world units."""
    scale: float
    """Size in the target over size in the object's capture."""
    flat_fraction: float
    """Share of the ground under the object that is level, in [0, 1]."""
    visible_fraction: float
    """Share of the views that show the object's foot, in [0, 1]."""


def suggest_place(
    target: Gaussians,
    base: ObjectBase,
    *,
    cameras: Cameras,
    up: Float[Tensor, "3"],
    scale: float | None = None,
) -> Suggestion:
    """A level, visible spot near what the cameras look at; without `scale`, a size that fits the views and the spot.

    Captures have no common unit, so a size that is not given is a guess: three tenths of the image's height, less
    where no level place is so large.

    Raises: ValueError where the cameras look at no common place, or nothing level is in view.
    """
    focus = focus_point(cameras)
    up = torch.nn.functional.normalize(up.to(focus), dim=0)
    away = cameras.centers - focus
    across = (away - (away @ up)[:, None] * up).norm(dim=-1)
    reach = 0.7 * float(across.median())
    # what most cameras look down on lies below them; ceilings and lamps do not
    top = float((away @ up).median())
    seen = height_map(target, focus, up=up, radius=reach, top=max(top, 0.05 * reach), size=128)
    visible = _visible_share(target, seen, cameras=cameras)
    size = scale if scale is not None else size_in_view(base, focus, cameras=cameras)
    for _ in range(8):
        flat = _flatness(seen, radius=max(size * base.radius, 2 * seen.pixel))
        distance = (seen.points - focus).norm(dim=-1)
        score = flat**2 * visible * torch.exp(-0.5 * (distance / (0.5 * reach)) ** 2)
        best = int(score.argmax())
        if float(flat.flatten()[best]) > 0.8 or scale is not None:
            break
        size *= 0.8
    if not float(score.flatten()[best]) > 0.01:
        raise ValueError("placement: expected a level surface in view of the cameras, found none; name a point")
    return Suggestion(
        point=seen.points.reshape(-1, 3)[best],
        scale=size,
        flat_fraction=float(flat.flatten()[best]),
        visible_fraction=float(visible.flatten()[best]),
    )


def size_in_view(base: ObjectBase, focus: Float[Tensor, "3"], *, cameras: Cameras) -> float:
    """Scale at which the object at `focus` fills three tenths of the image's height in the median view."""
    distance = (cameras.centers - focus).norm(dim=-1)
    image_height = cameras.sizes[:, 1] / cameras.intrinsics[:, 1, 1] * distance
    return _IMAGE_SHARE * float(image_height.median()) / max(base.height, 2 * base.radius)


def _flatness(seen: HeightMap, *, radius: float) -> Float[Tensor, "s s"]:
    """Share of the disc of `radius` around each pixel that lies at that pixel's level; 0 where nothing solid is."""
    solid = seen.alpha > 0.5
    pixels = max(1, round(radius / seen.pixel))
    steps = torch.arange(-pixels, pixels + 1)
    stride = max(1, pixels // 6)
    v, u = torch.meshgrid(steps[::stride], steps[::stride], indexing="ij")
    inside = u**2 + v**2 <= pixels**2
    padded_height = torch.nn.functional.pad(seen.heights, (pixels,) * 4)
    padded_solid = torch.nn.functional.pad(solid, (pixels,) * 4)
    size = len(seen.heights)
    level = torch.zeros_like(seen.heights)
    for dv, du in zip(v[inside].tolist(), u[inside].tolist(), strict=True):
        rows, columns = slice(pixels + dv, pixels + dv + size), slice(pixels + du, pixels + du + size)
        # two degrees of slope and the noise of a reconstructed surface
        same = (padded_height[rows, columns] - seen.heights).abs() < 0.08 * radius + 0.5 * seen.pixel
        level += same & padded_solid[rows, columns]
    return level / float(inside.sum()) * solid


def _visible_share(target: Gaussians, seen: HeightMap, *, cameras: Cameras) -> Float[Tensor, "s s"]:
    """Share of the views in which each surface point is in the middle nine tenths of the image and not hidden."""
    points = seen.points.reshape(-1, 3)
    views = spread_cameras(cameras, _VIEWS)
    count = torch.zeros(len(points))
    for camera in views:
        _, pixels, _ = project(points, camera)
        size = camera.sizes[0].to(points)
        central = ((pixels > 0.05 * size) & (pixels < 0.95 * size)).all(-1)
        count += central & visible_points(target, points, camera=camera, slack=3 * seen.pixel)
    return (count / len(views)).reshape(seen.heights.shape)
