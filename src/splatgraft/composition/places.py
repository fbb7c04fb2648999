"""Suggests places for an object beside what was captured, on the same support, and measures how much of it is hidden.

The support is a level plane of a height map of the scene around the point that the cameras look at.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache, partial

import torch
from jaxtyping import Bool, Float
from scipy import ndimage
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
_IMAGE_SHARE = 0.3  # object height over image height in the median view, where the scale is not given
_REACH = 0.7  # half width of the searched square over the cameras' median horizontal distance from the focus point
_MIN_TOP = 0.05  # least height of the searched space above the focus point, over the half width
_MAP_SIZE_PX = 128  # width and height of the height map
_CENTER_SPREAD = 0.5  # standard deviation of the distance from the focus point in the score, over the half width
_MARGIN = 1.25
"""Radius of the ground that is wanted level over the object's, which leaves out its outermost parts: corners must not
reach over the edge of a table."""
_ROOM = 3.0
"""Radius of the ground that should not fall away, over the object's: its rim is as far from an edge as it is wide."""
_NEAR_THE_EDGE = 0.7  # share of that ground below which the object stands near an edge; on a straight edge it is a half
_FLAT_ENOUGH = 0.8  # share of level ground at which the object is not made smaller
_SHRINK, _ROUNDS = 0.8, 8
"""Factor on the scale where no place is free, and scales tried."""
_MIN_SIZE = 0.5
"""Smallest allowed size, relative to the guess: a smaller object is out of proportion to the captured thing."""
_LARGE = 0.2
"""Least area of the support over that of the largest level, and of the region that it carries over all ground, weighted
by nearness to the focus point. A disc around that point is so large from .31 of the half width on, .2 of the cameras'
distance: tables are larger, the flat shoulders of figures are smaller."""
_SUPPORT_TOLERANCE = 0.05
"""Largest distance of the support's surface from its plane, over the half width: noise of a reconstruction."""
_ABOVE_FOCUS = 0.15
"""Largest height of the support above the focus point, over the half width. Cameras that look at a bare table may meet
below it, by a tenth of their distance."""
_MIN_SCORE = 0.01  # below it no place is level and in view
_MAX_PLACES = 6
_FLAT_SLOPE = 0.08
"""Height difference that counts as level over the object's radius: noise and a slope of a few degrees."""
_IMAGE_MARGIN = 0.05  # border of the image in which a place does not count as visible, over the image size
_SLACK = 0.03  # depth by which a point may lie behind the surface, over the object's extent: the width of both surfaces
_EXTENT_TRIM = 0.05  # share of points beyond either end of the extent
_PICTURE_PX = 640  # longest side of the picture of the free places
_FREE, _TAKEN = (0.20, 0.75, 0.30), (0.85, 0.20, 0.15)
"""sRGB of free places and of what stands on the support."""


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


class NoFreePlaceError(ValueError):
    """No place on the support has room for the object at half of the guessed size."""

    def __init__(self, text: str, picture: Float[Tensor, "h w 3"], scale: float) -> None:
        """Make the error.

        Args:
            text: One sentence.
            picture: A view of the target: free places green, what stands beside them red.
            scale: Half of the guess, at which a caller may place the object by hand.
        """
        super().__init__(text)
        self.picture, self.scale = picture, scale


@dataclass(frozen=True)
class _Ground:
    """The surface around the point that the cameras look at, and the plane of the support in it."""

    surface: HeightMap
    """Its heights."""
    rise: Float[Tensor, "s s"]
    """Height above the plane, world units; nan where nothing is solid."""
    tolerance: float
    """Largest distance from the plane of what belongs to the support, world units."""
    clearance: Float[Tensor, "s s"]
    """Horizontal distance to what rises above the plane, world units; infinite where nothing does."""
    visible: Float[Tensor, "s s"]
    """Share of the views that show the pixel's point, in [0, 1]."""
    central: Float[Tensor, "s s"]
    """Weight of the horizontal distance from the point that the cameras look at, in [0, 1]."""

    @property
    def support(self) -> Bool[Tensor, "s s"]:
        """Pixels on the plane."""
        return self.rise.abs() <= self.tolerance

    @property
    def lower(self) -> Bool[Tensor, "s s"]:
        """Pixels below the plane."""
        return self.rise < -self.tolerance

    @property
    def taken(self) -> Bool[Tensor, "s s"]:
        """Pixels above the plane: the captured thing and what else stands there."""
        return self.clearance == 0


@dataclass(frozen=True)
class _Fit:
    """How well an object of one scale stands at each pixel of the ground."""

    scale: float
    """Size in the target over size in the object's capture."""
    flat: Float[Tensor, "s s"]
    """Share of the ground under the object that is level, in [0, 1]."""
    carried: Float[Tensor, "s s"]
    """Share of the ground around the object that does not fall away, in [0, 1]."""
    score: Float[Tensor, "s s"]
    """0 where the object cannot stand or no view shows it, 1 at best."""
    free: Bool[Tensor, "s s"]
    """Whether there is room, on any level that is not taken."""


def suggest_places(
    target: Gaussians,
    base: ObjectBase,
    *,
    cameras: Cameras,
    up: Float[Tensor, "3"],
    scale: float | None = None,
) -> list[Suggestion]:
    """Suggest places beside what the cameras look at, on the same support, the best first, each with a scale.

    Captures have no common unit of length, so a scale that is not given is a guess from the size in the images; it is
    reduced, to no less than half, where no free place is large enough. Levels below the support count only where the
    support has no free place. A scale that is given is kept: where it fits nowhere, the best places are given with the
    reason. At least one place, apart from each other by the object's radius.

    Raises:
        ValueError: There is no surface, or (`NoFreePlaceError`) no room for half of the guessed size.
    """
    focus, reach, notes = _search_area(target, cameras)
    ground = _ground(target, focus, reach, cameras=cameras, up=up)
    guess = scale_in_view(base, focus, cameras=cameras)
    scales = [guess * _SHRINK**i for i in range(_ROUNDS)] if scale is None else [scale]
    fit_at = cache(partial(_fit, ground, base))
    level, fit = ground.support, _largest(map(fit_at, scales), ground.support)
    if fit is None:
        level, fit = ground.lower, _largest(map(fit_at, scales), ground.lower)
        if fit is not None:
            text = "No place on the support of what the cameras look at is free: the object stands on a lower level."
            notes.append(Note(text, "warning"))
    if scale is None and (fit is None or fit.scale < _MIN_SIZE * guess):
        room = "none" if fit is None else f"one for {fit.scale / guess:.0%} of it"
        raise NoFreePlaceError(
            "placement: expected a free place beside what the cameras look at, for the object at half of its guessed "
            f"size or more, found {room}; name a place (--at or --on) or a size (--scale)",
            _picture(target, ground, cameras=cameras),
            _MIN_SIZE * guess,
        )
    if fit is not None:
        score = fit.score * (fit.free & level)
        if fit.scale < scales[0]:
            smaller = (
                f"The object was made smaller, {fit.scale / guess:.0%} of the guess: no larger free place is in view."
            )
            notes.append(Note(smaller, "minor"))
    else:
        fit = fit_at(scales[0])
        score = fit.score * ~ground.taken
        if not float(score.max()) > _MIN_SCORE:
            # nothing is level and in view: flatness and view each count a little by themselves
            score = (0.05 + fit.flat**2) * (0.05 + ground.visible) * ground.central * (ground.support | ground.lower)
            notes.append(Note("No level place is in view of the cameras: this one is the nearest to it.", "warning"))
    return _suggestions(ground, fit, score, apart=fit.scale * base.radius, notes=notes)


def _largest(fits: Iterable[_Fit], level: Bool[Tensor, "s s"]) -> _Fit | None:
    """The first of `fits`, of falling scale, that has room on `level`; None where none has."""
    return next((fit for fit in fits if bool((fit.free & level).any())), None)


def _suggestions(
    ground: _Ground, fit: _Fit, score: Float[Tensor, "s s"], *, apart: float, notes: list[Note]
) -> list[Suggestion]:
    """The places with the best scores, `apart` from each other, world units."""
    found: list[Suggestion] = []
    score, points = score.flatten().clone(), ground.surface.points.reshape(-1, 3)
    apart = max(apart, 2 * ground.surface.pixel)
    while len(found) < _MAX_PLACES and float(score.max()) > 0:
        best = int(score.argmax())
        shares = float(fit.flat.flatten()[best]), float(ground.visible.flatten()[best])
        said = notes
        if float(fit.carried.flatten()[best]) < _NEAR_THE_EDGE:
            edge = "It stands near the edge of what carries it: no free place in view has more room."
            said = [*notes, Note(edge, "warning")]
        found.append(Suggestion(points[best], fit.scale, *shares, tuple(said)))
        score[(points - points[best]).norm(dim=-1) < apart] = 0
    return found


def _ground(
    target: Gaussians, focus: Float[Tensor, "3"], reach: float, *, cameras: Cameras, up: Float[Tensor, "3"]
) -> _Ground:
    """Measure the ground in the square of half width `reach` around `focus`. ValueError if there is none."""
    up = torch.nn.functional.normalize(up.to(focus), dim=0)
    # surfaces lie below most cameras; ceilings and lamps do not
    top = max(float(((cameras.centers - focus) @ up).median()), _MIN_TOP * reach)
    surface = height_map(target, focus, up=up, radius=reach, top=top, size=_MAP_SIZE_PX)
    solid = surface.alpha > 0.5
    if not bool(solid.any()):
        raise ValueError(
            "placement: expected a surface where the cameras look, found none; name a point (--at or --on)"
        )
    central = torch.exp(-0.5 * (surface.offsets.norm(dim=-1) / (_CENTER_SPREAD * reach)) ** 2)
    tolerance = _SUPPORT_TOLERANCE * reach
    # where all of it is higher, all of it counts
    below = solid & (surface.heights < _ABOVE_FOCUS * reach)
    counted = below if bool(below.any()) else solid
    rise = _rise_above_support(surface, solid, counted, central, tolerance=tolerance).where(solid, torch.nan)
    taken = rise > tolerance
    clearance = torch.full_like(rise, torch.inf)
    if bool(taken.any()):
        clearance = surface.pixel * torch.from_numpy(ndimage.distance_transform_edt(~taken.numpy())).to(rise)
    return _Ground(
        surface=surface,
        rise=rise,
        tolerance=tolerance,
        clearance=clearance,
        visible=_visible_share(target, surface, cameras=cameras),
        central=central,
    )


def _rise_above_support(
    surface: HeightMap,
    solid: Bool[Tensor, "s s"],
    counted: Bool[Tensor, "s s"],
    central: Float[Tensor, "s s"],
    *,
    tolerance: float,
) -> Float[Tensor, "s s"]:
    """Height above the plane of the support, the highest large level of the `counted` pixels, world units.

    A level is a peak of the histogram of heights. It carries the largest connected region that is not lower, so that
    things on a table count as parts of the table. A plane is fitted to the level by least squares.
    """
    heights = surface.heights
    lowest, step = heights[counted].min(), 0.5 * tolerance
    area = torch.bincount(((heights[counted] - lowest) / step).long(), weights=central[counted])[None]
    # bins are narrower than a surface is thick: each is taken with its neighbours
    area = torch.nn.functional.avg_pool1d(area, 3, 1, 1)
    is_peak = area == torch.nn.functional.max_pool1d(area, 5, 1, 2)
    levels = lowest + ((is_peak & (area >= _LARGE * area.max()))[0].nonzero()[:, 0] + 0.5) * step
    weight = (central * solid).flatten()
    for level in levels.flip(0).split(1):
        regions, _ = ndimage.label((solid & (heights > level - tolerance)).numpy())  # pyright: ignore[reportGeneralTypeIssues]
        carried = torch.bincount(torch.from_numpy(regions).long().flatten(), weights=weight)[1:]
        if float(carried.max()) >= _LARGE * float(weight.sum()):
            break
    plane = level.expand_as(heights)
    across = torch.cat([surface.offsets, torch.ones_like(heights)[..., None]], -1).double()
    for width in (2 * tolerance, tolerance):
        near = counted & ((heights - plane).abs() < width)
        slopes = torch.linalg.lstsq(across[near], heights[near, None].double()).solution
        plane = (across @ slopes)[..., 0].to(heights)
    return heights - plane


def _fit(ground: _Ground, base: ObjectBase, scale: float) -> _Fit:
    """How well the object stands at each pixel at this scale."""
    surface, radius = ground.surface, scale * base.radius
    wide = max(_MARGIN * radius, 2 * surface.pixel)
    flat = _level_share(surface, radius=wide, tolerance=_FLAT_SLOPE * wide)
    carried = _level_share(surface, radius=_ROOM / _MARGIN * wide, tolerance=_FLAT_SLOPE * wide, or_higher=True)
    score = flat**2 * carried**2 * ground.visible * ground.central
    free = (flat > _FLAT_ENOUGH) & (carried > _NEAR_THE_EDGE) & (ground.clearance > radius) & (score > _MIN_SCORE)
    return _Fit(scale, flat, carried, score, free)


def _picture(target: Gaussians, ground: _Ground, *, cameras: Cameras) -> Float[Tensor, "h w 3"]:
    """View of the camera that shows most of the support: level places on it green, what stands on it red."""
    surface, views = ground.surface, cameras.spread(_VIEWS)
    points, slack = surface.points[ground.support], 3 * surface.pixel
    shown = [int(_visible_points(target, points, camera=c, slack=slack).sum()) for c in _small_cameras(views)]
    camera = views[shown.index(max(shown))].limited(_PICTURE_PX)
    drawn = render(target, camera, outputs=frozenset({"color", "depth"}))
    color, depth = drawn.color[0].detach(), drawn.depth[0].detach()
    points = camera.unproject(depth)
    below_map, pixels, inside = _project(points.reshape(-1, 3), surface.camera)
    at = (pixels[:, 1].long().clamp(0, _MAP_SIZE_PX - 1), pixels[:, 0].long().clamp(0, _MAP_SIZE_PX - 1))
    plane_below_map = _project(surface.points.reshape(-1, 3), surface.camera)[0].view_as(ground.rise) + ground.rise
    rise = plane_below_map[at] - below_map
    small = 2 * surface.pixel
    level = _level_share(surface, radius=small, tolerance=_FLAT_SLOPE * small) > _FLAT_ENOUGH
    free = (ground.support & level & (ground.visible > 0))[at] & (rise.abs() <= ground.tolerance)
    taken = ground.taken[at] & (rise > -ground.tolerance)
    for marked, tint in ((free, _FREE), (taken, _TAKEN)):
        part = (marked & inside).view(depth.shape) & (depth > 0)
        color = torch.where(part[..., None], 0.5 * color + 0.5 * torch.tensor(tint), color)
    return color


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
    pixels, depth = camera.project(points)
    size = camera.sizes[0].to(points)
    inside = (depth > 0) & (pixels >= 0).all(-1) & (pixels < size).all(-1)
    return depth, pixels.nan_to_num(0).clamp(-1e6, 1e6), inside
