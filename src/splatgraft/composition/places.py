"""Suggests places for an object beside the captured thing, on the same support, each with a scale.

1. `ground` measures the heights around the point that the cameras look at, and the plane of the support.
2. Each pixel is scored for an object of one scale: level ground under it, no edge near it, visible, near that point.
3. The scale is reduced until a place is free; then the best places are suggested, the best first.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache, partial

from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.composition.ground import FLAT_ENOUGH, FLAT_SLOPE, Ground, draw_ground, level_share, measure_ground
from splatgraft.composition.object_base import ObjectBase
from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import estimate_up, focus_point
from splatgraft.core.gaussians import Gaussians
from splatgraft.runtime.note import Note

# set by hand
_IMAGE_SHARE = 0.3  # object height over image height in the median view, for the guess of the scale
_REACH = 0.7  # half width of the searched square over the cameras' median horizontal distance from the focus point
_MARGIN = 1.25  # radius of the ground that should be level, over the object's: corners must not reach over an edge
_ROOM = 3.0  # radius of the ground that should not fall away, over the object's: then an edge is a diameter away
_NEAR_THE_EDGE = 0.7  # share of that ground below which the object stands near an edge; on a straight edge it is a half
_SHRINK, _ROUNDS = 0.8, 8  # factor on the scale if no place is free, and number of scales tried
_MIN_SIZE = 0.5
"""Smallest allowed size, relative to the guess: a smaller object is out of proportion to the captured thing."""
_MIN_SCORE = 0.01  # below it no place is level and in view
_MAX_PLACES = 6


@dataclass(frozen=True)
class Suggestion:
    """A place and a size for an object."""

    point: Float[Tensor, "3"]
    """Point on the surface, world units."""
    scale: float
    """Size in the target over size in the object's capture."""
    flat_fraction: float
    """Share of the ground under the object that is level, in [0, 1]."""
    visible_fraction: float
    """Share of the views that show the object's base point, in [0, 1]."""
    notes: tuple[Note, ...] = ()
    """Shortcomings of the place."""


class NoFreePlaceError(ValueError):
    """No place on the support has room for the object at half of the guessed size."""

    def __init__(self, text: str, picture: Float[Tensor, "h w 3"], scale: float) -> None:
        """Make the error.

        Args:
            text: One sentence.
            picture: A view of the target: free places green, things that stand beside them red.
            scale: Half of the guess, at which a caller may place the object by hand.
        """
        super().__init__(text)
        self.picture, self.scale = picture, scale


@dataclass(frozen=True)
class _Fit:
    """Scores of an object of one scale at each pixel of the ground."""

    scale: float
    """Size in the target over size in the object's capture."""
    flat: Float[Tensor, "s s"]
    """Share of the ground under the object that is level, in [0, 1]."""
    carried: Float[Tensor, "s s"]
    """Share of the ground around the object that does not fall away, in [0, 1]."""
    score: Float[Tensor, "s s"]
    """Score in [0, 1]; 0 where the object cannot stand or no view shows it."""
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
    """Suggest places beside the thing that the cameras look at, on the same support, each with a scale.

    A given scale is kept: if it fits nowhere, the best places are suggested with the reason. Otherwise the scale is
    guessed from the size in the images, because captures have no common unit of length. It is reduced, to no less than
    half, if no free place is large enough. Levels below the support count only if the support has no free place.

    Returns:
        At least one place, the best first, apart from each other by the object's radius.

    Raises:
        ValueError: There is no surface, or (`NoFreePlaceError`) no room for half of the guessed size.
    """
    focus, reach, notes = _search_area(target, cameras)
    ground = measure_ground(target, focus, reach, cameras=cameras, up=up)
    guess = scale_in_view(base, focus, cameras=cameras)
    scales = [guess * _SHRINK**i for i in range(_ROUNDS)] if scale is None else [scale]
    fit_at = cache(partial(_fit, ground, base))
    level, fit = ground.support, _largest(map(fit_at, scales), ground.support)
    if fit is None:
        level, fit = ground.lower, _largest(map(fit_at, scales), ground.lower)
        if fit is not None:
            text = "No place on the support of the captured thing is free: the object stands on a lower level."
            notes.append(Note(text, "warning"))
    if scale is None and (fit is None or fit.scale < _MIN_SIZE * guess):
        room = "none" if fit is None else f"one for {fit.scale / guess:.0%} of it"
        raise NoFreePlaceError(
            "placement: expected a free place beside the captured thing, for the object at half of its guessed "
            f"size or more, found {room}; name a place (--at or --on) or a size (--scale)",
            draw_ground(target, ground, cameras=cameras),
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
            notes.append(Note("No level place is in view of the cameras: this is the nearest to one.", "warning"))
    return _suggestions(ground, fit, score, apart=fit.scale * base.radius, notes=notes)


def _largest(fits: Iterable[_Fit], level: Bool[Tensor, "s s"]) -> _Fit | None:
    """Find the first of `fits`, of falling scale, that has room on `level`."""
    return next((fit for fit in fits if bool((fit.free & level).any())), None)


def _suggestions(
    ground: Ground, fit: _Fit, score: Float[Tensor, "s s"], *, apart: float, notes: list[Note]
) -> list[Suggestion]:
    """Choose the places with the best scores, `apart` from each other, world units."""
    found: list[Suggestion] = []
    score, points = score.flatten().clone(), ground.surface.points.reshape(-1, 3)
    apart = max(apart, 2 * ground.surface.pixel)
    while len(found) < _MAX_PLACES and float(score.max()) > 0:
        best = int(score.argmax())
        shares = float(fit.flat.flatten()[best]), float(ground.visible.flatten()[best])
        own_notes = notes
        if float(fit.carried.flatten()[best]) < _NEAR_THE_EDGE:
            edge = "The object stands near the edge of its support: no free place in view has more room."
            own_notes = [*notes, Note(edge, "warning")]
        found.append(Suggestion(points[best], fit.scale, *shares, tuple(own_notes)))
        score[(points - points[best]).norm(dim=-1) < apart] = 0
    return found


def _fit(ground: Ground, base: ObjectBase, scale: float) -> _Fit:
    """Score the object at this scale at each pixel."""
    surface, radius = ground.surface, scale * base.radius
    wide = max(_MARGIN * radius, 2 * surface.pixel)
    flat = level_share(surface, radius=wide, tolerance=FLAT_SLOPE * wide)
    carried = level_share(surface, radius=_ROOM / _MARGIN * wide, tolerance=FLAT_SLOPE * wide, or_higher=True)
    score = flat**2 * carried**2 * ground.visible * ground.central
    free = (flat > FLAT_ENOUGH) & (carried > _NEAR_THE_EDGE) & (ground.clearance > radius) & (score > _MIN_SCORE)
    return _Fit(scale, flat, carried, score, free)


def _search_area(target: Gaussians, cameras: Cameras) -> tuple[Float[Tensor, "3"], float, list[Note]]:
    """Compute the middle and the half width of the searched square, with a note if the cameras have no focus point."""
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
    """Compute the scale at which the object at `focus` fills 0.3 of the image's height in the median view."""
    distance = (cameras.centers - focus).norm(dim=-1)
    image_height = cameras.sizes[:, 1] / cameras.intrinsics[:, 1, 1] * distance
    return _IMAGE_SHARE * float(image_height.median()) / max(base.height, 2 * base.radius)
