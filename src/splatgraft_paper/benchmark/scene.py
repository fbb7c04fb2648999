"""One benchmark scene, reconstructed, segmented and composed: the steps that all methods share."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from splatgraft.core.posed_images import held_out
from splatgraft.formats import read_capture, write_capture
from splatgraft.project.layout import (
    CAMERAS_FILE,
    IS_OBJECT_FILE,
    OBJECT_FILE,
    PLACEMENT_FILE,
    SCENE_FILE,
    SURROUNDINGS_FILE,
)
from splatgraft.project.record import read_record, why_stale
from splatgraft.project.step import Device, Step, job_of, perform
from splatgraft.reconstruction import ReconstructOptions
from splatgraft.runtime.console import Console
from splatgraft.steps.compose import Compose
from splatgraft.steps.reconstruct import Reconstruct
from splatgraft.steps.segment import Segment
from splatgraft_paper.benchmark.true_light import TRUE_LIGHT_FILE

HELD_OUT_EVERY = 8
"""Stride of the views, from the first, that are held out of reconstruction, harmonisation and consolidation."""


@dataclass(frozen=True)
class GroundTruthScene:
    """The files of one scene with ground truth."""

    name: str
    source: Path
    """Capture of the object with masks."""
    target: Path
    """Capture of the target without the object."""
    truth: Path
    """Capture with the object and masks, from the target's cameras; depth/NAME.npy if depth is known."""
    placement: Path
    """File placement.json with the object's true pose."""
    light: Path | None = None
    """File with the true light; None if it is not known."""

    @staticmethod
    def from_folder(folder: Path) -> "GroundTruthScene":
        """Find the files of a scene that `paper synth benchmark` rendered."""
        parts = {name: folder / name for name in ("source", "target", "ground_truth", PLACEMENT_FILE)}
        if missing := [str(path) for path in parts.values() if not path.exists()]:
            raise ValueError(f"{folder}: expected {', '.join(parts)}; found no {Path(missing[0]).name}")
        light = folder / TRUE_LIGHT_FILE
        known = light if light.is_file() else None
        source, target, truth, placement = parts.values()
        return GroundTruthScene(folder.name, source, target, truth, placement, known)


@dataclass(frozen=True)
class ComposedScene:
    """The composite of a benchmark scene, on which methods are run."""

    name: str
    work: Path
    """Folder of all results."""
    light: Path | None = None
    """File with the true light; None if it is not known."""
    from_capture: bool = True
    """Whether the object's own capture is known; without it, its old light is unknown, too."""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Seconds of the steps that all methods share."""

    @property
    def cameras(self) -> Path:
        """Cameras of the target without the held-out ones."""
        return self.work / "target" / "capture" / CAMERAS_FILE

    @property
    def source_cameras(self) -> Path | None:
        """Cameras of the object's capture."""
        return self.work / "source" / "capture" / CAMERAS_FILE if self.from_capture else None

    @property
    def target(self) -> Path:
        """Reconstruction of the target."""
        return self.work / "target" / "scene" / SCENE_FILE

    @property
    def surroundings(self) -> Path | None:
        """Source scene without the object."""
        return self.work / "object" / SURROUNDINGS_FILE if self.from_capture else None

    @property
    def composite(self) -> Path:
        """Folder of the copy-paste composite."""
        return self.work / "composite"

    @property
    def is_object(self) -> Path:
        """File is_object.npy: whether each Gaussian of the composite belongs to the object."""
        return self.composite / IS_OBJECT_FILE


def perform_if_stale(step: Step, console: Console) -> float:
    """Perform a step if its result is stale, and return the seconds that the result took."""
    if why_stale(job_of(step)):
        perform(step, console)
    record = read_record(step.out)
    assert record is not None
    return record.seconds


def compose_scene(
    ground_truth: GroundTruthScene, work: Path, options: ReconstructOptions, *, device: Device, console: Console
) -> ComposedScene:
    """Reconstruct both captures without the held-out views, segment the object and place it at its true pose."""
    seconds: dict[str, float] = {}
    for side, path in (("source", ground_truth.source), ("target", ground_truth.target)):
        capture = read_capture(path)
        if side == "target":
            capture = capture.select(~held_out(len(capture), HELD_OUT_EVERY))
        folder = work / side / "capture"
        folder.mkdir(parents=True, exist_ok=True)
        write_capture(folder, capture)
        step = Reconstruct(folder, work / side / "scene", options=options)
        seconds[f"reconstruct {side}"] = perform_if_stale(step, console)
    source = work / "source" / "scene" / SCENE_FILE
    segment = Segment(source, work / "source" / "capture", work / "object", device=device)
    seconds["segment"] = perform_if_stale(segment, console)
    scene = ComposedScene(ground_truth.name, work, light=ground_truth.light, seconds=seconds)
    compose = Compose(scene.target, work / "object" / OBJECT_FILE, scene.composite, placement=ground_truth.placement)
    seconds["compose"] = perform_if_stale(compose, console)
    return scene
