"""Report of structure from motion: its figures, the implausible ones among them, and their file.

A wrong model often poses all photos with a small reprojection error, because COLMAP drops matches that do not fit.
The explained share of verified matches also counts the dropped ones, so it is low for such a model.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from splatgraft.capture.colmap_process.job import MIN_INLIERS
from splatgraft.formats.json_file import load, save

POSE_REPORT_FILE = "pose_report.json"

_FEW_FEATURES = 500  # most photos have thousands, one in ten of them matches in the next photo

_NAMED = 3  # most photos named per reason; the file has all

# plausible ranges of the figures
_MIN_REGISTERED = 0.7  # share of photos with a pose; a result with fewer is usable, but a third is missing
_MIN_EXPLAINED = 0.5  # explained share of verified matches; the shipped room, vase and bananas have 0.59 to 0.87
_MAX_REPROJECTION_PX = 1.0  # three times SIFT's accuracy of a third of a pixel (Lowe 2004)
_MIN_OBSERVATIONS = 100  # points seen by the median photo (COLMAP demands this of the first pair: init_min_num_inliers)
_FOCAL_IN_SIDES = (0.4, 4.0)  # focal length over the longest side: 14 mm and 140 mm on a sensor of 36 mm
_MAX_CORNER_SHIFT = 0.25  # shift of a corner by distortion, over its distance from the centre; a fisheye has more
_MAX_CORNER_SPREAD = 0.1  # 90th minus 10th percentile of the corner shift: one lens at a few zoom settings


@dataclass(frozen=True)
class Lens:
    """An estimated camera and the photos that share it."""

    photos: tuple[str, ...]
    """Names of the photos, without suffix."""
    size: tuple[int, int]
    """Width and height of the reduced photos, pixels."""
    focal_px: float
    """Focal length, pixels of the reduced photos."""
    distortion: float
    """First radial coefficient (k of COLMAP's SIMPLE_RADIAL), for image coordinates over the focal length."""

    @property
    def corner_shift(self) -> float:
        """Signed shift of a corner by distortion, over its distance from the centre of the photo."""
        width, height = self.size
        return self.distortion * (width**2 + height**2) / (2 * self.focal_px) ** 2


@dataclass(frozen=True)
class Unposed:
    """A photo without a pose, with the figures that hint at the reason."""

    name: str
    """Name, without suffix."""
    features: int
    """Number of features."""
    matches: int
    """Verified matches with the photo that matches best."""
    moved: bool = False
    """Whether its pose contradicts the matches on the object."""
    astray: bool = False
    """Whether its pose contradicts its matches and turns it past the focus point of the others."""

    @property
    def reason(self) -> str:
        """The usual reason for such figures."""
        if self.moved:
            return "the object was moved or turned against its surroundings"
        if self.astray:
            return "its pose contradicts its matches, and it does not show what the others look at"
        if self.features < _FEW_FEATURES:
            return "blurred, dark or without texture"
        if self.matches < MIN_INLIERS:
            return "another place, or too far from the next photo"
        return "something moved, is mirrored or repeats itself, or a photo between two views is missing"


@dataclass(frozen=True)
class Doubt:
    """A figure outside its plausible range."""

    what: str
    """Name of the figure."""
    found: str
    """Measured value, with unit."""
    expected: str
    """Plausible range, with unit."""

    def __str__(self) -> str:
        """Return the doubt as a clause."""
        return f"{self.what}: expected {self.expected}, found {self.found}"


@dataclass(frozen=True)
class PoseReport:
    """Figures of a structure from motion."""

    photos: int
    """Number of photos given."""
    registered: int
    """Number of photos with a pose."""
    missing: tuple[Unposed, ...]
    """Photos without a pose."""
    mean_reprojection_px: float
    """Mean reprojection error, pixels of the reduced photos."""
    points: int
    """Number of sparse points kept: seen by three photos or more, with a mean error of at most 1.5 px."""
    models: int
    """Number of separate models found; the best was kept."""
    method: str
    """Mapper, choice of pairs and masks of the model that was kept."""
    explained: float
    """Share of all verified matches whose two features see one point, in [0, 1]."""
    lenses: tuple[Lens, ...]
    """Estimated cameras, those with most photos first."""
    doubts: tuple[Doubt, ...]
    """Figures that are not plausible; empty if all are."""

    def __str__(self) -> str:
        """Return the figures in one line."""
        line = (
            f"{self.registered} of {self.photos} photos have a pose, with a mean reprojection error of "
            f"{self.mean_reprojection_px:.2f} px over {self.points:,} points"
        )
        if self.lenses:
            low, high = (limit(lens.focal_px for lens in self.lenses) for limit in (min, max))
            line += f", focal length {low:.0f} px" if low == high else f", focal lengths {low:.0f} to {high:.0f} px"
        alone = [lens.photos[0] for lens in self.lenses if len(lens.photos) == 1]
        if alone and len(alone) < len(self.lenses):
            line += f"; photos with their own camera: {', '.join(alone)}"
        return line + (f"; without a pose: {self.reasons}" if self.missing else "")

    @property
    def reasons(self) -> str:
        """The reasons against the photos without a pose, each with its number of photos and the first names."""
        names: dict[str, list[str]] = {}
        for photo in self.missing:
            names.setdefault(photo.reason, []).append(photo.name)
        return "; ".join(
            f"{len(those)} ({', '.join(those[:_NAMED])}{' ...' if len(those) > _NAMED else ''}: {reason})"
            for reason, those in sorted(names.items(), key=lambda one: -len(one[1]))
        )


def find_doubts(
    photos: int, observations: Sequence[int], *, explained: float, mean_reprojection_px: float, lenses: Sequence[Lens]
) -> tuple[Doubt, ...]:
    """Find the figures outside their plausible ranges.

    Args:
        photos: Number of photos given.
        observations: Number of points seen, for each photo with a pose.
        explained: Share of verified matches that the model explains, in [0, 1].
        mean_reprojection_px: Mean reprojection error, pixels of the reduced photos.
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
    """Read the doubts about the poses in a folder; none if they do not come from structure from motion."""
    path = folder / POSE_REPORT_FILE
    if not path.is_file():
        return ()
    try:
        return tuple(Doubt(**doubt) for doubt in load(path)["doubts"])
    except (KeyError, TypeError) as error:
        raise ValueError(f"{path}: expected figures of poses, found {type(error).__name__}: {error}") from error
