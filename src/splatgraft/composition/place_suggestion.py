"""Suggests a level, visible place in a scene for an object and its size, from a height map around the focus point."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.composition.height_map import HeightMap, height_map
from splatgraft.composition.object_base import ObjectBase
from splatgraft.composition.point_visibility import project, small_cameras, visible_points
from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import estimate_up, focus_point
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
    margin: float = 1.25
    """Radius of the ground that is wanted level over the object's, which leaves out its outermost parts: corners must
    not reach over the edge of a table."""
    flat_enough: float = 0.8
    """Share of level ground at which the object is not made smaller."""
    shrink: float = 0.8
    """Factor on the scale where no place is level enough."""
    rounds: int = 8
    """Scales tried."""
    least_score: float = 0.01
    """Below it no place is level and in view."""
    places: int = 6
    """Most places that are given."""
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
    reasons: tuple[str, ...] = ()
    """Why it is not as good as wanted, one sentence each; none where it is."""


def suggest_places(
    target: Gaussians,
    base: ObjectBase,
    *,
    cameras: Cameras,
    up: Float[Tensor, "3"],
    scale: float | None = None,
    options: SuggestionOptions = SuggestionOptions(),
) -> list[Suggestion]:
    """Places near the point that the cameras look at, each with a scale: level ones in view of the cameras first.

    Captures have no common unit of length, so a scale that is not given is a guess from the size in the images; it is
    reduced where no level place is large enough. Where no place is level and in view, the nearest to it is given with
    the reason.

    Args:
        target: The receiving scene.
        base: The object's base and size.
        cameras: Of the target.
        up: Of any length but zero.
        scale: Size in the target over size in the source; None guesses it.
        options: Search range and score.

    Returns:
        At least one, the best first, apart from each other by the object's radius.

    Raises:
        ValueError: Where the scene has no surface near that point.
    """
    focus, reach, reasons = _search_area(target, cameras, options)
    up = torch.nn.functional.normalize(up.to(focus), dim=0)
    # surfaces lie below most cameras; ceilings and lamps do not
    top = max(float(((cameras.centers - focus) @ up).median()), options.least_top * reach)
    ground = height_map(target, focus, up=up, radius=reach, top=top, size=options.map_size)
    if not bool((ground.alpha > 0.5).any()):
        raise ValueError(
            "placement: expected a surface where the cameras look, found none; name a point (--at or --on)"
        )
    visible = _visible_share(target, ground, cameras=cameras, options=options)
    central = torch.exp(-0.5 * ((ground.points - focus).norm(dim=-1) / (options.center_spread * reach)) ** 2)
    wanted = size = scale if scale is not None else scale_in_view(base, focus, cameras=cameras, options=options)
    for _ in range(options.rounds):
        wide = max(options.margin * size * base.radius, 2 * ground.pixel)
        flat = _flatness(ground, radius=wide, slope=options.flat_slope)
        score = flat**2 * visible * central
        if float(flat.flatten()[int(score.argmax())]) > options.flat_enough or scale is not None:
            break
        size *= options.shrink
    if size < wanted:
        reasons.append(f"The object was made smaller by {size / wanted:.2f}, as no larger level place is in view.")
    if not float(score.max()) > options.least_score:
        # nothing is level and in view: flatness and view each count a little by themselves
        score = (0.05 + flat**2) * (0.05 + visible) * central * (ground.alpha > 0.5)
        reasons.append("No level place is in view of the cameras: this one is the nearest to it.")
    apart = max(size * base.radius, 2 * ground.pixel)
    found: list[Suggestion] = []
    score, points = score.flatten().clone(), ground.points.reshape(-1, 3)
    while len(found) < options.places and float(score.max()) > 0:
        best = int(score.argmax())
        shares = float(flat.flatten()[best]), float(visible.flatten()[best])
        found.append(Suggestion(points[best], size, *shares, tuple(reasons)))
        score[(points - points[best]).norm(dim=-1) < apart] = 0
    return found


def _search_area(
    target: Gaussians, cameras: Cameras, options: SuggestionOptions
) -> tuple[Float[Tensor, "3"], float, list[str]]:
    """Middle and half width of the searched square, and a reason where the cameras do not look at one place."""
    up = estimate_up(cameras)
    try:
        focus = focus_point(cameras)
    except ValueError:
        focus = cameras.centers.median(0).values
        away = (target.means[target.opacities > 0.5] - focus).norm(dim=1)
        reach = options.reach * float(away.median()) if len(away) else 1.0
        return focus, reach, ["The cameras do not look at one place: the object stands between them."]
    away = cameras.centers - focus
    across = (away - (away @ up)[:, None] * up).norm(dim=-1)
    return focus, max(options.reach * float(across.median()), 1e-6), []


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
