"""One benchmark scene made ready for all methods: reconstructed, segmented, composed. Holds no method and no metric."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from splatgraft.commands.steps.compose import Compose
from splatgraft.commands.steps.reconstruct import Reconstruct
from splatgraft.commands.steps.segment import Segment
from splatgraft.core.posed_images import held_out
from splatgraft.evaluation.benchmark.published_datasets import PublishedScene
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
from splatgraft.workflow.benchmark.true_light_file import TRUE_LIGHT_FILE

HELD_OUT_EVERY = 8
"""Views kept from reconstruction, harmonisation and consolidation alike, from the first."""


@dataclass(frozen=True)
class GivenScene:
    """Where the parts of one scene with ground truth lie."""

    name: str
    source: Path
    """Capture of the object with masks."""
    target: Path
    """Capture of the place without it."""
    truth: Path
    """Capture with it, with masks, from the target's cameras; depth/NAME.npy where depth is known."""
    placement: Path
    """placement.json: where the object stands."""
    light: Path | None = None
    """light.json with the true light, where it is known."""

    @staticmethod
    def of(folder: Path) -> "GivenScene":
        """A scene that `synth benchmark` made.

        Raises: ValueError where a part is missing.
        """
        parts = {name: folder / name for name in ("source", "target", "ground_truth", PLACEMENT_FILE)}
        if missing := [str(path) for path in parts.values() if not path.exists()]:
            raise ValueError(f"{folder}: expected {', '.join(parts)}; found no {Path(missing[0]).name}")
        light = folder / TRUE_LIGHT_FILE
        known = light if light.is_file() else None
        source, target, truth, placement = parts.values()
        return GivenScene(folder.name, source, target, truth, placement, known)

    @staticmethod
    def of_published(scene: PublishedScene) -> "GivenScene":
        """A scene of a published data set.

        Raises: ValueError where it has no ground truth or no placement.
        """
        folder = scene.target.parent
        if scene.truth is None or not (folder / PLACEMENT_FILE).is_file():
            raise ValueError(f"{folder}: expected images with the object and {PLACEMENT_FILE}, found none")
        return GivenScene(scene.name, scene.source, scene.target, scene.truth, folder / PLACEMENT_FILE)


@dataclass(frozen=True)
class ReadyScene:
    """A scene that methods can be run on."""

    given: GivenScene
    work: Path
    """Folder of everything that is made of it."""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Of the steps that all methods share."""

    @property
    def cameras(self) -> Path:
        """The target's cameras that methods may see."""
        return self.work / "target" / "capture" / CAMERAS_FILE

    @property
    def source_cameras(self) -> Path:
        """Those that saw the object."""
        return self.work / "source" / "capture" / CAMERAS_FILE

    @property
    def target(self) -> Path:
        """The reconstruction of the place."""
        return self.work / "target" / "scene" / SCENE_FILE

    @property
    def surroundings(self) -> Path:
        """The source without the object."""
        return self.work / "object" / SURROUNDINGS_FILE

    @property
    def composite(self) -> Path:
        """Folder of the copy-paste result."""
        return self.work / "composite"

    @property
    def is_object(self) -> Path:
        """Which of the composite's Gaussians are the object's."""
        return self.composite / IS_OBJECT_FILE


def fresh(step: Step, console: Console) -> float:
    """Do a step where its result is stale; how long it took, now or then."""
    if why_stale(job_of(step)):
        perform(step, console)
    record = read_record(step.out)
    assert record is not None
    return record.seconds


def ready_scene(
    given: GivenScene, work: Path, options: ReconstructOptions, *, device: Device, console: Console
) -> ReadyScene:
    """Reconstruct both captures without the held-out views, cut the object out and put it where it belongs.

    Raises: ValueError where a part of the scene is missing or broken.
    """
    seconds: dict[str, float] = {}
    for side, path in (("source", given.source), ("target", given.target)):
        capture = read_capture(path)
        if side == "target":
            capture = capture.select(~held_out(len(capture), HELD_OUT_EVERY))
        folder = work / side / "capture"
        folder.mkdir(parents=True, exist_ok=True)
        write_capture(folder, capture)
        step = Reconstruct(folder, work / side / "scene", options=options)
        seconds[f"reconstruct {side}"] = fresh(step, console)
    source = work / "source" / "scene" / SCENE_FILE
    cut = Segment(source, work / "source" / "capture", work / "object", device=device)
    seconds["segment"] = fresh(cut, console)
    made = ReadyScene(given, work, seconds)
    place = Compose(made.target, work / "object" / OBJECT_FILE, made.composite, placement=given.placement)
    seconds["compose"] = fresh(place, console)
    return made
