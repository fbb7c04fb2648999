"""What structure from motion found, in figures, which of them are not plausible, and the file with them.

A wrong model often has all photos and a small reprojection error, since COLMAP drops what does not fit. The share of
verified matches that the model explains does not have this weakness: it counts what was dropped.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from splatgraft.formats.json_file import load, save

POSE_REPORT_FILE = "pose_report.json"

_FEW_FEATURES = 500
"""Features; a photo of a usual scene has some thousands, of which one in ten is found again in the next photo."""
_FEW_MATCHES = 30  # matches that a pose takes (COLMAP: abs_pose_min_num_inliers)

# the ranges of the figures of ordinary photos
_MIN_REGISTERED = 0.7
"""Share of photos with a pose: without a third of them it is still a result, whose missing photos are named."""
_MIN_EXPLAINED = 0.5
"""Share of verified matches: more than half. Models of the shipped room, vase and bananas: 0.59 to 0.87."""
_MAX_REPROJECTION_PX = 1.0  # pixels: three times the third of a pixel to which SIFT places a feature (Lowe 2004)
_MIN_OBSERVATIONS = 100  # points seen by the median photo: what COLMAP demands of the first pair (init_min_num_inliers)
_FOCAL_IN_SIDES = (0.4, 4.0)  # focal length over the longest side: 14 mm and 140 mm on a sensor of 36 mm
_MAX_CORNER_SHIFT = 0.25
"""Share of its distance from the middle by which a corner is moved; more is a fisheye, which is not modelled."""
_MAX_CORNER_SPREAD = 0.1
"""Difference of corner shift between the 10th and 90th percentile of photos: one lens at a few zoom settings."""


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
    def corner_shift(self) -> float:
        """How far distortion moves a corner of the photo, as a signed share of its distance from the middle."""
        width, height = self.size
        return self.distortion * (width**2 + height**2) / (2 * self.focal_px) ** 2


@dataclass(frozen=True)
class Unposed:
    """A photo without a pose, and what speaks for a reason."""

    name: str
    """Without suffix."""
    features: int
    """Found in it."""
    matches: int
    """Verified matches with the photo that it has most in common with."""

    def __str__(self) -> str:
        """The name, and the usual reason for such figures."""
        if self.features < _FEW_FEATURES:
            reason = "blurred, dark or without texture"
        elif self.matches < _FEW_MATCHES:
            reason = "of another place, or too far from the next photo"
        else:
            reason = "something moved, is mirrored or repeats itself, or a step is missing"
        return f"{self.name} ({self.features} features, at most {self.matches} matches: {reason})"


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


@dataclass(frozen=True)
class PoseReport:
    """How well structure from motion went."""

    photos: int
    """Photos given."""
    registered: int
    """Photos that have a pose now."""
    missing: tuple[Unposed, ...]
    """The others."""
    mean_reprojection_px: float
    """Mean distance between where points are seen and where they project, pixels of the (shrunk) photos."""
    points: int
    """Sparse points kept: seen by three photos or more, at most 1.5 px off."""
    models: int
    """Separate models found; the best was taken."""
    method: str
    """Which of the mappings was taken."""
    explained: float
    """Share of all verified matches whose two features see one point, in [0, 1]."""
    lenses: tuple[Lens, ...]
    """Cameras found, those of most photos first."""
    doubts: tuple[Doubt, ...]
    """Figures that are not plausible; none where all is well."""

    def __str__(self) -> str:
        """One line for people."""
        line = (
            f"{self.registered} of {self.photos} photos have a pose, with a mean reprojection error of "
            f"{self.mean_reprojection_px:.2f} px over {self.points:,} points"
        )
        if self.lenses:
            low, high = (limit(lens.focal_px for lens in self.lenses) for limit in (min, max))
            line += f", focal length {low:.0f} px" if low == high else f", focal lengths {low:.0f} to {high:.0f} px"
        alone = [lens.photos[0] for lens in self.lenses if len(lens.photos) == 1]
        if alone and len(alone) < len(self.lenses):
            line += f"; with a camera of their own: {', '.join(alone)}"
        return line + (f"; without a pose: {', '.join(map(str, self.missing))}" if self.missing else "")


def find_doubts(
    photos: int, observations: Sequence[int], *, explained: float, mean_reprojection_px: float, lenses: Sequence[Lens]
) -> tuple[Doubt, ...]:
    """All figures that are out of the range of ordinary photos; none where the cameras are plausible.

    Args:
        photos: Number of photos given.
        observations: Points seen, per photo with a pose.
        explained: Share of verified matches that the model explains, in [0, 1].
        mean_reprojection_px: Pixels of the (shrunk) photos.
        lenses: Cameras of the photos with a pose.
    """
    doubts: list[Doubt] = []

    def demand(is_good: bool, what: str, found: str, expected: str) -> None:
        if not is_good:
            doubts.append(Doubt(what, found, expected))

    posed, seen = len(observations), float(np.median(observations)) if observations else 0.0
    is_good, least = posed >= _MIN_REGISTERED * photos, f"at least {_MIN_REGISTERED:.0%}"
    demand(is_good, "photos with a pose", f"{posed} of {photos}", least)
    is_good, least = explained >= _MIN_EXPLAINED, f"at least {_MIN_EXPLAINED:.0%}"
    demand(is_good, "matches that the cameras explain", f"{explained:.0%}", least)
    is_good, most = mean_reprojection_px <= _MAX_REPROJECTION_PX, f"at most {_MAX_REPROJECTION_PX:.2f} px"
    demand(is_good, "mean reprojection error", f"{mean_reprojection_px:.2f} px", most)
    demand(seen >= _MIN_OBSERVATIONS, "points seen by the median photo", f"{seen:.0f}", f"{_MIN_OBSERVATIONS}")
    low, high = _FOCAL_IN_SIDES
    for lens in lenses:
        of = f"of {lens.photos[0]}" + (f" and {len(lens.photos) - 1} more" if len(lens.photos) > 1 else "")
        side, shift = max(lens.size), abs(lens.corner_shift)
        usual = f"{low * side:.0f} to {high * side:.0f} px at {side} px"
        demand(low <= lens.focal_px / side <= high, f"focal length {of}", f"{lens.focal_px:.0f} px", usual)
        most = f"at most {_MAX_CORNER_SHIFT:.0%} at the corners"
        demand(shift <= _MAX_CORNER_SHIFT, f"distortion {of}", f"{shift:.0%}", most)
    shifts = [lens.corner_shift for lens in lenses for _ in lens.photos]
    spread = float(np.percentile(shifts, 90) - np.percentile(shifts, 10)) if shifts else 0.0
    most = f"at most {_MAX_CORNER_SPREAD:.0%} at the corners"
    demand(spread <= _MAX_CORNER_SPREAD, "spread of the distortion between photos", f"{spread:.0%}", most)
    return tuple(doubts)


def write_pose_report(folder: Path, report: PoseReport) -> None:
    """Write pose_report.json into `folder`."""
    save(folder / POSE_REPORT_FILE, asdict(report))


def read_doubts(folder: Path) -> tuple[Doubt, ...]:
    """The doubts about the poses of a folder; none where structure from motion did not find them."""
    path = folder / POSE_REPORT_FILE
    if not path.is_file():
        return ()
    try:
        return tuple(Doubt(**doubt) for doubt in load(path)["doubts"])
    except (KeyError, TypeError) as error:
        raise ValueError(f"{path}: expected figures of poses, found {type(error).__name__}: {error}") from error
