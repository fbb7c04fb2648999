"""Suggests a level, visible place in a scene for an object and its size, from a height map around the focus point."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.composition.height_map import HeightMap, height_map
from splatgraft.composition.object_base import ObjectBase
from splatgraft.composition.point_visibility import project, small_cameras, visible_points
from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import focus_point
from splatgraft.core.gaussians import Gaussians


@dataclass(frozen=True)
class SuggestionOptions:
    """Where a place is searched and how it is scored; values set by hand."""

    views: int = 12
    """Cameras whose view of a place is tested, evenly spaced."""
    image_share: float = 0.3
    """Object height over image height in the median view, where the scale is not given."""
    reach: float = 0.7
    """Half width of the searched square over the cameras' median horizontal distance from the focus point."""
    least_top: float = 0.05
    """Least height of the searched space above the focus point, over the half width."""
    map_size: int = 128
    """Width and height of the height map, pixels."""
    center_spread: float = 0.5
    """Standard deviation of the distance from the focus point in the score, over the half width."""
    flat_enough: float = 0.8
    """Share of level ground at which the object is not made smaller."""
    shrink: float = 0.8
    """Factor on the scale where no place is level enough."""
    rounds: int = 8
    """Scales tried."""
    least_score: float = 0.01
    """Below it there is no place."""
    flat_slope: float = 0.08
    """Height difference that counts as level over the object's radius: noise and a slope of a few degrees."""
    image_margin: float = 0.05
    """Border of the image in which a place does not count as visible, over the image size."""


@dataclass(frozen=True)
class Suggestion:
    """A place and a size for an object."""

    point: Float[Tensor, "3"]
    """On the surface, world units."""
    scale: float
    """Size in the target over size in the object's capture."""
    flat_fraction: float
    """Share of the ground under the object that is level, in [0, 1]."""
    visible_fraction: float
    """Share of the views that show the object's base point, in [0, 1]."""


def suggest_place(
    target: Gaussians,
    base: ObjectBase,
    *,
    cameras: Cameras,
    up: Float[Tensor, "3"],
    scale: float | None = None,
    options: SuggestionOptions = SuggestionOptions(),
) -> Suggestion:
    """A level, visible place near the point that the cameras look at, and a scale.

    Captures have no common unit of length, so a scale that is not given is a guess from the size in the images; it is
    reduced where no level place is large enough.

    Args:
        target: The receiving scene.
        base: The object's base and size.
        cameras: Of the target.
        up: Of any length but zero.
        scale: Size in the target over size in the source; None guesses it.
        options: Search range and score.

    Raises:
        ValueError: Where the cameras do not look at one place, or no level surface is in view.
    """
    focus = focus_point(cameras)
    up = torch.nn.functional.normalize(up.to(focus), dim=0)
    away = cameras.centers - focus
    across = (away - (away @ up)[:, None] * up).norm(dim=-1)
    reach = options.reach * float(across.median())
    # surfaces lie below most cameras; ceilings and lamps do not
    top = float((away @ up).median())
    top = max(top, options.least_top * reach)
    ground = height_map(target, focus, up=up, radius=reach, top=top, size=options.map_size)
    visible = _visible_share(target, ground, cameras=cameras, options=options)
    size = scale if scale is not None else scale_in_view(base, focus, cameras=cameras, options=options)
    for _ in range(options.rounds):
        flat = _flatness(ground, radius=max(size * base.radius, 2 * ground.pixel), slope=options.flat_slope)
        distance = (ground.points - focus).norm(dim=-1)
        score = flat**2 * visible * torch.exp(-0.5 * (distance / (options.center_spread * reach)) ** 2)
        best = int(score.argmax())
        if float(flat.flatten()[best]) > options.flat_enough or scale is not None:
            break
        size *= options.shrink
    if not float(score.flatten()[best]) > options.least_score:
        raise ValueError("placement: expected a level surface in view of the cameras, found none; name a point")
    return Suggestion(
        point=ground.points.reshape(-1, 3)[best],
        scale=size,
        flat_fraction=float(flat.flatten()[best]),
        visible_fraction=float(visible.flatten()[best]),
    )


def scale_in_view(
    base: ObjectBase,
    focus: Float[Tensor, "3"],
    *,
    cameras: Cameras,
    options: SuggestionOptions = SuggestionOptions(),
) -> float:
    """Scale at which the object at `focus` fills `options.image_share` of the image's height in the median view."""
    distance = (cameras.centers - focus).norm(dim=-1)
    image_height = cameras.sizes[:, 1] / cameras.intrinsics[:, 1, 1] * distance
    return options.image_share * float(image_height.median()) / max(base.height, 2 * base.radius)


def _flatness(ground: HeightMap, *, radius: float, slope: float) -> Float[Tensor, "s s"]:
    """Share of the disc of `radius` around each pixel that lies at that pixel's level; 0 where nothing is solid."""
    solid = ground.alpha > 0.5
    pixels = max(1, round(radius / ground.pixel))
    steps = torch.arange(-pixels, pixels + 1)
    stride = max(1, pixels // 6)
    v, u = torch.meshgrid(steps[::stride], steps[::stride], indexing="ij")
    inside = u**2 + v**2 <= pixels**2
    padded_height = torch.nn.functional.pad(ground.heights, (pixels,) * 4)
    padded_solid = torch.nn.functional.pad(solid, (pixels,) * 4)
    size = len(ground.heights)
    level = torch.zeros_like(ground.heights)
    for dv, du in zip(v[inside].tolist(), u[inside].tolist(), strict=True):
        rows, columns = slice(pixels + dv, pixels + dv + size), slice(pixels + du, pixels + du + size)
        same = (padded_height[rows, columns] - ground.heights).abs() < slope * radius + 0.5 * ground.pixel
        level += same & padded_solid[rows, columns]
    return level / float(inside.sum()) * solid


def _visible_share(
    target: Gaussians, ground: HeightMap, *, cameras: Cameras, options: SuggestionOptions
) -> Float[Tensor, "s s"]:
    """Share of the views in which each surface point is off the image's border and not hidden."""
    points = ground.points.reshape(-1, 3)
    views = small_cameras(cameras, options.views)
    count = torch.zeros(len(points))
    for camera in views:
        _, pixels, _ = project(points, camera)
        size = camera.sizes[0].to(points)
        central = ((pixels > options.image_margin * size) & (pixels < (1 - options.image_margin) * size)).all(-1)
        count += central & visible_points(target, points, camera=camera, slack=3 * ground.pixel)
    return (count / len(views)).reshape(ground.heights.shape)
