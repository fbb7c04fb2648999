"""Suggests level, visible places in a scene for an object and its size, and measures how much of it is hidden."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.composition.object_base import ObjectBase
from splatgraft.composition.support_surface import HeightMap, height_map
from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import estimate_up, focus_point
from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering import render
from splatgraft.runtime.note import Note

# set by hand
_VIEWS, _VIEW_WIDTH_PX = 12, 240
"""Cameras that are tested for what hides a point, evenly spaced, and the width of their depth images."""
_IMAGE_SHARE = 0.3
"""Object height over image height in the median view, where the scale is not given."""
_REACH = 0.7
"""Half width of the searched square over the cameras' median horizontal distance from the focus point."""
_MIN_TOP = 0.05
"""Least height of the searched space above the focus point, over the half width."""
_MAP_SIZE_PX = 128
"""Width and height of the height map."""
_CENTER_SPREAD = 0.5
"""Standard deviation of the distance from the focus point in the score, over the half width."""
_MARGIN = 1.25
"""Radius of the ground that is wanted level over the object's, which leaves out its outermost parts: corners must not
reach over the edge of a table."""
_ROOM = 3.0
"""Radius of the ground that should not fall away, over the object's: its rim is as far from an edge as it is wide."""
_NEAR_THE_EDGE = 0.7
"""Share of that ground below which the object stands near an edge; on a straight edge it is a half."""
_FLAT_ENOUGH = 0.8
"""Share of level ground at which the object is not made smaller."""
_SHRINK, _ROUNDS = 0.8, 8
"""Factor on the scale where no place is level enough, and scales tried."""
_MIN_SCORE = 0.01
"""Below it no place is level and in view."""
_MAX_PLACES = 6
_FLAT_SLOPE = 0.08
"""Height difference that counts as level over the object's radius: noise and a slope of a few degrees."""
_IMAGE_MARGIN = 0.05
"""Border of the image in which a place does not count as visible, over the image size."""
_SLACK = 0.03
"""Depth by which a point may lie behind the surface, over the object's extent: the width of both surfaces."""
_EXTENT_TRIM = 0.05
"""Share of points beyond either end of the extent."""


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
    notes: tuple[Note, ...] = ()
    """What is not as good as wanted; none where all is."""


def suggest_places(
    target: Gaussians,
    base: ObjectBase,
    *,
    cameras: Cameras,
    up: Float[Tensor, "3"],
    scale: float | None = None,
) -> list[Suggestion]:
    """Places near the point that the cameras look at, each with a scale: level ones in view of the cameras first.

    Captures have no common unit of length, so a scale that is not given is a guess from the size in the images; it is
    reduced where no level place is large enough, or where it would fill what carries it. Where no place is level and in
    view, the nearest to it is given with the reason. At least one, apart from each other by the object's radius; a
    ValueError where there is no surface.
    """
    focus, reach, notes = _search_area(target, cameras)
    up = torch.nn.functional.normalize(up.to(focus), dim=0)
    # surfaces lie below most cameras; ceilings and lamps do not
    top = max(float(((cameras.centers - focus) @ up).median()), _MIN_TOP * reach)
    ground = height_map(target, focus, up=up, radius=reach, top=top, size=_MAP_SIZE_PX)
    if not bool((ground.alpha > 0.5).any()):
        raise ValueError(
            "placement: expected a surface where the cameras look, found none; name a point (--at or --on)"
        )
    visible = _visible_share(target, ground, cameras=cameras)
    central = torch.exp(-0.5 * ((ground.points - focus).norm(dim=-1) / (_CENTER_SPREAD * reach)) ** 2)
    wanted = size = scale if scale is not None else scale_in_view(base, focus, cameras=cameras)
    for _ in range(_ROUNDS):
        wide = max(_MARGIN * size * base.radius, 2 * ground.pixel)
        flat = _level_share(ground, radius=wide, tolerance=_FLAT_SLOPE * wide)
        carried = _level_share(ground, radius=_ROOM / _MARGIN * wide, tolerance=_FLAT_SLOPE * wide, or_higher=True)
        score = flat**2 * carried**2 * visible * central
        best = int(score.argmax())
        has_room = float(flat.flatten()[best]) > _FLAT_ENOUGH and float(carried.flatten()[best]) > _NEAR_THE_EDGE
        if has_room or scale is not None:
            break
        size *= _SHRINK
    if size < wanted:
        smaller = f"The object was made smaller, {size / wanted:.0%} of the guess: no larger level place is in view."
        notes.append(Note(smaller, "minor"))
    if not float(score.max()) > _MIN_SCORE:
        # nothing is level and in view: flatness and view each count a little by themselves
        score = (0.05 + flat**2) * (0.05 + visible) * central * (ground.alpha > 0.5)
        notes.append(Note("No level place is in view of the cameras: this one is the nearest to it.", "warning"))
    apart = max(size * base.radius, 2 * ground.pixel)
    found: list[Suggestion] = []
    score, points = score.flatten().clone(), ground.points.reshape(-1, 3)
    while len(found) < _MAX_PLACES and float(score.max()) > 0:
        best = int(score.argmax())
        shares = float(flat.flatten()[best]), float(visible.flatten()[best])
        said = notes
        if float(carried.flatten()[best]) < _NEAR_THE_EDGE:
            edge = "It stands near the edge of what carries it: no free place in view has more room."
            said = [*notes, Note(edge, "warning")]
        found.append(Suggestion(points[best], size, *shares, tuple(said)))
        score[(points - points[best]).norm(dim=-1) < apart] = 0
    return found


def _search_area(target: Gaussians, cameras: Cameras) -> tuple[Float[Tensor, "3"], float, list[Note]]:
    """Middle and half width of the searched square, and what is amiss where the cameras do not look at one place."""
    up = estimate_up(cameras)
    try:
        focus = focus_point(cameras)
    except ValueError:
        focus = cameras.centers.median(0).values
        away = (target.means[target.opacities > 0.5] - focus).norm(dim=1)
        reach = _REACH * float(away.median()) if len(away) else 1.0
        return focus, reach, [Note("The cameras do not look at one place: the object stands between them.", "warning")]
    away = cameras.centers - focus
    across = (away - (away @ up)[:, None] * up).norm(dim=-1)
    return focus, max(_REACH * float(across.median()), 1e-6), []


def scale_in_view(
    base: ObjectBase,
    focus: Float[Tensor, "3"],
    *,
    cameras: Cameras,
) -> float:
    """Scale at which the object at `focus` fills 0.3 of the image's height in the median view."""
    distance = (cameras.centers - focus).norm(dim=-1)
    image_height = cameras.sizes[:, 1] / cameras.intrinsics[:, 1, 1] * distance
    return _IMAGE_SHARE * float(image_height.median()) / max(base.height, 2 * base.radius)


def _level_share(
    ground: HeightMap, *, radius: float, tolerance: float, or_higher: bool = False
) -> Float[Tensor, "s s"]:
    """Share of the disc of `radius` around each pixel that lies at that pixel's level; 0 where nothing is solid.

    With `or_higher` what stands there counts, too: the share that does not fall away.
    """
    solid = ground.alpha > 0.5
    pixels = max(1, round(radius / ground.pixel))
    steps = torch.arange(-pixels, pixels + 1)
    stride = max(1, pixels // 6)
    v, u = torch.meshgrid(steps[::stride], steps[::stride], indexing="ij")
    inside = u**2 + v**2 <= pixels**2
    # beyond the map it goes on as at its border
    both = torch.stack([ground.heights, solid.float()])
    padded_height, padded_solid = torch.nn.functional.pad(both, (pixels,) * 4, mode="replicate")
    size = len(ground.heights)
    level, bound = torch.zeros_like(ground.heights), tolerance + 0.5 * ground.pixel
    for dv, du in zip(v[inside].tolist(), u[inside].tolist(), strict=True):
        rows, columns = slice(pixels + dv, pixels + dv + size), slice(pixels + du, pixels + du + size)
        rise = padded_height[rows, columns] - ground.heights
        same = (rise > -bound) & ((rise < bound) | or_higher)
        level += same * padded_solid[rows, columns]
    return level / float(inside.sum()) * solid


def _visible_share(target: Gaussians, ground: HeightMap, *, cameras: Cameras) -> Float[Tensor, "s s"]:
    """Share of the views in which each surface point is off the image's border and not hidden."""
    points = ground.points.reshape(-1, 3)
    views = _small_cameras(cameras)
    count = torch.zeros(len(points))
    for camera in views:
        _, pixels, _ = _project(points, camera)
        size = camera.sizes[0].to(points)
        central = ((pixels > _IMAGE_MARGIN * size) & (pixels < (1 - _IMAGE_MARGIN) * size)).all(-1)
        count += central & _visible_points(target, points, camera=camera, slack=3 * ground.pixel)
    return (count / len(views)).reshape(ground.heights.shape)


def hidden_fraction(target: Gaussians, placed: Gaussians, *, cameras: Cameras) -> float:
    """Share of an object, by opacity, that the target's surfaces hide from all cameras, as inside a wall; in [0, 1].

    A part outside the images of all chosen cameras counts as hidden.
    """
    points = placed.means
    if placed.count == 0:
        return 0.0
    low, high = _EXTENT_TRIM, 1 - _EXTENT_TRIM
    extent = float((points.quantile(high, 0) - points.quantile(low, 0)).norm()) if placed.count > 1 else 0.0
    seen = torch.zeros(placed.count, dtype=torch.bool)
    for camera in _small_cameras(cameras):
        seen |= _visible_points(target, points, camera=camera, slack=_SLACK * extent)
    weight = placed.opacities
    return float((weight * ~seen).sum() / weight.sum())


def _small_cameras(cameras: Cameras) -> list[Cameras]:
    """Evenly spaced cameras as batches of one, reduced where they are wider."""
    return [camera.resized(min(1.0, _VIEW_WIDTH_PX / camera.width)) for camera in cameras.spread(_VIEWS)]


def _visible_points(scene: Gaussians, points: Float[Tensor, "m 3"], *, camera: Cameras, slack: float) -> Tensor:
    """Bool[m]: points inside the camera's image and at most `slack`, world units, behind the scene's surface."""
    depth, pixels, inside = _project(points, camera)
    rendered = render(scene, camera, outputs=frozenset({"depth"}))
    column, row = pixels.long().unbind(-1)
    column, row = column.clamp(0, camera.width - 1), row.clamp(0, camera.height - 1)
    surface, alpha = rendered.depth[0].detach()[row, column], rendered.alpha[0].detach()[row, column]
    return inside & ((alpha < 0.5) | (depth <= surface + slack))


def _project(points: Float[Tensor, "m 3"], camera: Cameras) -> tuple[Tensor, Tensor, Tensor]:
    """Depth Float[m], pixel Float[m 2], and Bool[m] whether the point lies inside the camera's image."""
    pose = camera.camera_from_world[0].to(points)
    in_camera = points @ pose[:3, :3].T + pose[:3, 3]
    depth = in_camera[:, 2]
    intrinsics = camera.intrinsics[0].to(points)
    pixels = (in_camera @ intrinsics.T)[:, :2] / depth.clamp_min(1e-9)[:, None]
    size = camera.sizes[0].to(points)
    inside = (depth > 0) & (pixels >= 0).all(-1) & (pixels < size).all(-1)
    return depth, pixels.nan_to_num(0).clamp(-1e6, 1e6), inside
