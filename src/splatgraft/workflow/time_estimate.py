"""Time estimates of the steps of a run, from their earlier runs or else from inputs and typical times."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from splatgraft.capture import VIDEO_FRAMES, predict_pose_seconds
from splatgraft.core.cameras import Cameras, pinhole
from splatgraft.core.images import stored_size
from splatgraft.folders.capture_files import has_poses
from splatgraft.formats import is_scene, read_capture
from splatgraft.formats.captures.masks import find_photos
from splatgraft.formats.captures.photo_archive import count_archived_photos, is_archive
from splatgraft.project.record import Record, read_record
from splatgraft.project.step import Step, plain_options
from splatgraft.project.step_table import STEPS, PlannedStep
from splatgraft.reconstruction import predict_cpu_seconds
from splatgraft.steps.capture import Capture
from splatgraft.steps.reconstruct import Reconstruct
from splatgraft.steps.render import Render
from splatgraft.steps.segment import SOLID_SIDE_PX, Segment
from splatgraft.workflow.flow import Flow

_TYPICAL_SECONDS = {row.command: row.seconds for row in STEPS}
"""Seconds by step; other projects differ by a factor, which is taken from their finished steps."""
_SECONDS_PER_CUT = 1.2  # per photo without a mask
_SECONDS_PER_OBJECT_PIXEL = 7e-8
"""Seconds per step of the object's fit and pixel of a photo; half for a small object, twice for one that fills it."""
_SECONDS_PER_VIEW, _SECONDS_PER_MEGAPIXEL = 0.12, 0.2  # per rendered picture of the place
_FACTOR = 2.0  # maximum correction of the typical times by finished steps; its inverse is the minimum
_COMPILATION_SECONDS = 25.0  # kernels in a first reconstruction; part of its typical time


def estimate_step_times(flow: Flow, stale: Iterable[str]) -> tuple[PlannedStep, ...]:
    """Estimate the seconds of each stale step; `is_measured` is false for guesses.

    A guess is a typical time, multiplied by the mean factor of the project's finished steps.
    """
    records = {name: (step, found) for name, step in flow if (found := read_record(step.out)) is not None}
    measured = {name: found.seconds for name, (step, found) in records.items() if _is_as_before(step, found)}
    typical = {name: _typical_seconds(step, flow) for name, step in flow}
    known = [name for name in measured if measured[name] > 0]
    factor = sum(measured[name] for name in known) / sum(typical[name] for name in known) if known else 1.0
    factor = min(max(factor, 1 / _FACTOR), _FACTOR)
    return tuple(
        PlannedStep(name, measured[name], True)
        if name in measured
        else PlannedStep(name, factor * typical[name], False)
        for name in stale
    )


def describe_estimate(planned: Sequence[PlannedStep]) -> str:
    """Describe in one line how many steps will run and for how long."""
    seconds = sum(step.seconds for step in planned)
    duration = f"{max(1, round(seconds / 5)) * 5:.0f} s" if seconds < 90 else f"{seconds / 60:.1f} minutes"
    measured = all(step.is_measured for step in planned)
    basis = "as before" if measured else "a guess for two idle cores: half or twice that"
    return f"{len(planned)} step{'s' if len(planned) > 1 else ''} to run: about {duration} ({basis})"


def _is_as_before(step: Step, record: Record) -> bool:
    """Return whether a step will take as long as before; the time of a reconstruction depends on its options."""
    if not isinstance(step, Reconstruct):
        return True
    now = plain_options(vars(step.options))
    return all(record.options.get(name, value) == value for name, value in now.items())


def _typical_seconds(step: Step, flow: Flow) -> float:
    """Estimate the seconds of a first run on two idle cores; unreadable inputs are left to the step's own error."""
    typical = _TYPICAL_SECONDS[type(step).__name__.lower()]
    try:
        if isinstance(step, Capture):
            return typical + predict_pose_seconds(_photos_to_pose(step, flow))
        if isinstance(step, Reconstruct) and not torch.cuda.is_available():
            seconds = predict_cpu_seconds(_views_of(step.capture, flow).cameras, step.options) / 2
            return _COMPILATION_SECONDS + seconds
        if isinstance(step, Segment) and step.mask_source != "box":
            views = _views_of(step.capture, flow)
            is_cut = step.mask_source in ("auto", "grabcut") and step.masks is None
            cut = _SECONDS_PER_CUT * views.without_masks if is_cut else 0.0
            fitted = views.cameras.resized(min(1.0, SOLID_SIDE_PX / int(views.cameras.sizes.max())))
            return typical + cut + step.solidify * _SECONDS_PER_OBJECT_PIXEL * fitted.width * fitted.height
        if isinstance(step, Render):
            cameras = _views_of(step.cameras, flow).cameras
            megapixels = cameras.width * cameras.height / 1e6
            return typical + len(cameras) * (_SECONDS_PER_VIEW + _SECONDS_PER_MEGAPIXEL * megapixels)
    except (ValueError, OSError):
        pass
    return typical


def _photos_to_pose(step: Capture, flow: Flow) -> int:
    if step.poses is not None or is_scene(step.capture) or has_poses(step.capture):
        return 0
    return len(_views_of(step.capture, flow).cameras)


@dataclass(frozen=True)
class _Views:
    """The views of a capture, or those that it will have."""

    cameras: Cameras
    """Cameras with the right sizes; their poses are meaningless before the capture is made."""
    without_masks: int


def _views_of(capture: Path, flow: Flow) -> _Views:
    """Read the views of a capture, or of its input before the capture is made."""
    capture = capture.parent if capture.suffix == ".json" else capture
    made_by = next((made_by for _, made_by in flow if made_by.out == capture), None)
    given = made_by.capture if isinstance(made_by, Capture) and not has_poses(capture) else capture
    if has_poses(given):
        posed = read_capture(given)
        return _Views(posed.cameras, len(posed) - len(posed.with_masks()))
    (width, height), photos = (1600, 1200), count_archived_photos(given) if is_archive(given) else VIDEO_FRAMES
    without_masks = photos
    if given.is_dir():
        found = find_photos(given)
        (width, height), photos = stored_size(found.paths[0]), len(found.paths)
        without_masks = photos - sum(mask is not None for mask in found.masks)
    poses = torch.eye(4).repeat(photos, 1, 1)
    return _Views(pinhole(poses, float(width), width=width, height=height), without_masks)
