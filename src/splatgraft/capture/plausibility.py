"""Whether the cameras that structure from motion found are plausible: each figure against the range of ordinary photos.

A wrong model often has all photos and a small reprojection error, since COLMAP drops what does not fit. The share of
verified matches that the model explains does not have this weakness: it counts what was dropped.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Lens:
    """A camera as structure from motion found it, and the photos that share it."""

    photos: tuple[str, ...]
    """Names, without suffix."""
    size: tuple[int, int]
    """Width and height of these photos (shrunk), pixels."""
    focal_px: float
    """Focal length, pixels of the (shrunk) photos."""
    distortion: float
    """First radial coefficient (k of COLMAP's SIMPLE_RADIAL), for image coordinates over the focal length."""

    @property
    def focal_in_sides(self) -> float:
        """Focal length over the longest side of the photo."""
        return self.focal_px / max(self.size)

    @property
    def corner_shift(self) -> float:
        """How far distortion moves a corner of the photo, as a signed share of its distance from the middle."""
        width, height = self.size
        return self.distortion * (width**2 + height**2) / (2 * self.focal_px) ** 2


@dataclass(frozen=True)
class Found:
    """What is judged."""

    photos: int
    """Photos given."""
    explained: float
    """Share of all verified matches whose two features see one point of the model, in [0, 1]."""
    mean_reprojection_px: float
    """Pixels of the (shrunk) photos."""
    observations: tuple[int, ...]
    """Points seen, per photo with a pose."""
    lenses: tuple[Lens, ...]
    """Cameras of the photos with a pose."""


@dataclass(frozen=True)
class Plausible:
    """Ranges of the figures of ordinary photos."""

    min_registered: float = 0.9
    """Share of photos with a pose: one in ten may be blurred or apart from the rest."""
    min_explained: float = 0.5
    """Share of verified matches: more than half. Models of the shipped room, vase and bananas: 0.59 to 0.87."""
    max_reprojection_px: float = 1.0
    """Pixels: three times the third of a pixel to which SIFT places a feature (Lowe 2004)."""
    min_observations: float = 100
    """Points seen by the median photo: what COLMAP demands of the first pair (init_min_num_inliers)."""
    focal_in_sides: tuple[float, float] = (0.4, 4.0)
    """Focal length over the longest side: 14 mm and 140 mm on a sensor of 36 mm."""
    max_corner_shift: float = 0.25
    """Share of its distance from the middle by which a corner is moved; more is a fisheye, which is not modelled."""
    max_corner_spread: float = 0.1
    """Difference of corner shift between the 10th and 90th percentile of photos: one lens at a few zoom settings."""


@dataclass(frozen=True)
class Doubt:
    """One figure that is out of its range."""

    what: str
    """What was measured."""
    found: str
    """With unit."""
    expected: str
    """With unit."""

    def __str__(self) -> str:
        """A clause for people."""
        return f"{self.what}: expected {self.expected}, found {self.found}"


def find_doubts(found: Found, plausible: Plausible = Plausible()) -> tuple[Doubt, ...]:
    """All figures of `found` that are out of range; none where the cameras are plausible."""
    doubts: list[Doubt] = []

    def check(is_good: bool, what: str, value: str, expected: str) -> None:
        if not is_good:
            doubts.append(Doubt(what, value, expected))

    p, registered = plausible, len(found.observations)
    check(
        registered >= p.min_registered * found.photos,
        "photos with a pose",
        f"{registered} of {found.photos}",
        f"at least {p.min_registered:.0%}",
    )
    check(
        found.explained >= p.min_explained,
        "matches that the cameras explain",
        f"{found.explained:.0%}",
        f"at least {p.min_explained:.0%}",
    )
    check(
        found.mean_reprojection_px <= p.max_reprojection_px,
        "mean reprojection error",
        f"{found.mean_reprojection_px:.2f} px",
        f"at most {p.max_reprojection_px:.2f} px",
    )
    seen = float(np.median(found.observations)) if found.observations else 0.0
    check(seen >= p.min_observations, "points seen by the median photo", f"{seen:.0f}", f"{p.min_observations:.0f}")
    return (*doubts, *_lens_doubts(found.lenses, p))


def _lens_doubts(lenses: Sequence[Lens], plausible: Plausible) -> list[Doubt]:
    doubts: list[Doubt] = []
    low, high = plausible.focal_in_sides
    for lens in lenses:
        of = f"of {lens.photos[0]}" + (f" and {len(lens.photos) - 1} more" if len(lens.photos) > 1 else "")
        if not low <= lens.focal_in_sides <= high:
            side = max(lens.size)
            expected = f"{low * side:.0f} to {high * side:.0f} px at {side} px"
            doubts.append(Doubt(f"focal length {of}", f"{lens.focal_px:.0f} px", expected))
        if abs(lens.corner_shift) > plausible.max_corner_shift:
            expected = f"at most {plausible.max_corner_shift:.0%} at the corners"
            doubts.append(Doubt(f"distortion {of}", f"{abs(lens.corner_shift):.0%}", expected))
    shifts = [lens.corner_shift for lens in lenses for _ in lens.photos]
    if shifts:
        spread = float(np.percentile(shifts, 90) - np.percentile(shifts, 10))
        if spread > plausible.max_corner_spread:
            expected = f"at most {plausible.max_corner_spread:.0%} at the corners"
            doubts.append(Doubt("spread of the distortion between photos", f"{spread:.0%}", expected))
    return doubts
