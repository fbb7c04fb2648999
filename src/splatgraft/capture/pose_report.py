"""What structure from motion found, in figures, and its file beside the posed images."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from splatgraft.capture.plausibility import Doubt, Lens
from splatgraft.runtime.files import atomic_write

POSE_REPORT_FILE = "pose_report.json"


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


_FEW_FEATURES = 500
"""Features; a photo of a usual scene has some thousands, of which one in ten is found again in the next photo."""
_FEW_MATCHES = 30
"""Matches that a pose takes (COLMAP: abs_pose_min_num_inliers)."""


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
            f"{self.registered} of {self.photos} photos registered, mean reprojection error "
            f"{self.mean_reprojection_px:.2f} px, {self.points} points, {self.explained:.0%} of matches explained"
        )
        if self.lenses:
            low, high = (limit(lens.focal_px for lens in self.lenses) for limit in (min, max))
            line += f", focal length {low:.0f} px" if low == high else f", focal lengths {low:.0f} to {high:.0f} px"
        alone = [lens.photos[0] for lens in self.lenses if len(lens.photos) == 1]
        if alone and len(alone) < len(self.lenses):
            line += f"; with a camera of their own: {', '.join(alone)}"
        return line + (f"; without a pose: {', '.join(map(str, self.missing))}" if self.missing else "")


def write_pose_report(folder: Path, report: PoseReport) -> None:
    """Write pose_report.json into `folder`."""
    with atomic_write(folder / POSE_REPORT_FILE) as stream:
        stream.write((json.dumps(asdict(report), indent=1) + "\n").encode())


def read_pose_report(folder: Path) -> PoseReport | None:
    """The report of a folder whose photos were posed by structure from motion, else None.

    Raises: ValueError where the file is damaged.
    """
    path = folder / POSE_REPORT_FILE
    if not path.is_file():
        return None
    try:
        found: dict[str, Any] = json.loads(path.read_text())
        lenses = tuple(
            Lens(**(lens | {"photos": tuple(lens["photos"]), "size": tuple(lens["size"])}))
            for lens in found.pop("lenses")
        )
        doubts = tuple(Doubt(**doubt) for doubt in found.pop("doubts"))
        missing = tuple(Unposed(**photo) for photo in found.pop("missing"))
        return PoseReport(missing=missing, lenses=lenses, doubts=doubts, **found)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: expected figures of poses, found {type(error).__name__}: {error}") from error
