"""One benchmark scene, reconstructed, segmented and composed: the steps that all methods share.

There are two pipelines: ours, and the paper's (Sec. 4), which pastes the object as it was cut out.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import torch

from splatgraft.core.gaussians import concatenate
from splatgraft.core.posed_images import held_out
from splatgraft.folders.composite_folder import placement_files
from splatgraft.folders.object_masks import write_masks
from splatgraft.formats import read_capture, read_gaussians, write_capture, write_gaussians
from splatgraft.project.gaussian_flags import write_flags
from splatgraft.project.layout import (
    CAMERAS_FILE,
    IS_OBJECT_FILE,
    OBJECT_FILE,
    PLACEMENT_FILE,
    SCENE_FILE,
    SURROUNDINGS_FILE,
)
from splatgraft.project.placement import Placement, read_placement, write_placement
from splatgraft.project.record import read_record, why_stale
from splatgraft.project.step import Context, Device, Inputs, Step, job_of, perform
from splatgraft.reconstruction import ReconstructOptions
from splatgraft.runtime.console import Console
from splatgraft.segmentation import LiftOptions, network_masks
from splatgraft.steps.compose import Compose
from splatgraft.steps.reconstruct import Reconstruct
from splatgraft.steps.segment import Segment
from splatgraft_paper.benchmark.true_light import TRUE_LIGHT_FILE

Pipeline = Literal["ours", "paper"]
MASKS = "masks"
"""Folder of BiRefNet's masks in that of their step."""
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
    """Whether the object's own capture is known; if not, its old light is unknown, too."""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Seconds of the steps that all methods share."""
    views: Path | None = None
    """Capture with all views of the target, the held-out ones too."""

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


@dataclass(frozen=True)
class BirefnetMasks:
    """Masks of a capture's foreground by BiRefNet (paper, Sec. 4); a step of its own, as the paper times it apart."""

    capture: Path
    out: Path
    """Folder for masks/."""
    birefnet: Path | None = None
    """An .onnx file; fetched once from the hub if not given."""

    def inputs(self) -> Inputs:
        """List the images and the network."""
        weights = () if self.birefnet is None else (self.birefnet,)
        return {"images": read_capture(self.capture).image_paths, "weights": weights}

    def write(self, folder: Path, context: Context) -> None:
        """Write the masks."""
        capture = read_capture(self.capture)
        write_masks(folder / MASKS, capture, network_masks(capture, weights=self.birefnet, progress=context.progress))


@dataclass(frozen=True)
class Paste:
    """Plain pasting of the object's Gaussians at their place (paper, Sec. 4): none is flattened or split."""

    target: Path
    """The target scene, a .ply."""
    object: Path
    """The object, a .ply."""
    out: Path
    """Folder for scene.ply, is_object.npy and placement.json."""
    placement: Path
    """File placement.json with the object's pose."""

    def inputs(self) -> Inputs:
        """List the scenes and the placement."""
        return {"scenes": (self.target, self.object), "placement": placement_files(self.placement)}

    def write(self, folder: Path, context: Context) -> None:
        """Write the pasted scene."""
        target, taken = read_gaussians(self.target), read_gaussians(self.object)
        (placed,) = read_placement(self.placement).objects
        pasted = concatenate([target, placed.target_from_object.gaussians(taken)])
        write_gaussians(folder / SCENE_FILE, pasted)
        write_flags(folder / IS_OBJECT_FILE, torch.arange(pasted.count) >= target.count)
        named = replace(placed, object_path=self.object)
        write_placement(folder / PLACEMENT_FILE, Placement((named,)))


@dataclass(frozen=True)
class CompositionOptions:
    """Reconstruction and composition of a scene."""

    reconstruction: ReconstructOptions
    """Options of our reconstructions; the paper's have the quality `full`."""
    device: Device = "auto"
    birefnet: Path | None = None
    """BiRefNet's .onnx file, for the paper's pipeline; fetched once from the hub if not given."""
    pipeline: Pipeline = "ours"
    lift: LiftOptions = field(default_factory=lambda: LiftOptions(method="bce"))
    """Lifting of the masks in the paper's pipeline."""
    masks: Literal["found", "given"] = "found"
    """Whether the paper's pipeline finds masks by BiRefNet; the capture's own are for objects pasted into a scene."""

    def segment(self, scene: Path, capture: Path, work: Path) -> Sequence[Step]:
        """List the steps that cut the object out into `work`/object."""
        plain = Segment(scene, capture, work / "object", device=self.device)
        if self.pipeline == "ours":
            return (plain,)
        plain = replace(plain, options=self.lift, solidify=0, keep="all", keep_open=True, mask_source="files")
        if self.masks == "given":
            return (plain,)
        masks = BirefnetMasks(capture, work / "masks", self.birefnet)
        return masks, replace(plain, masks=masks.out / MASKS)


def place_step(pipeline: Pipeline, scene: ComposedScene, object_file: Path, placement: Path) -> Step:
    """Return the step that places the object in the target."""
    if pipeline == "paper":
        return Paste(scene.target, object_file, scene.composite, placement)
    return Compose(scene.target, object_file, scene.composite, placement=placement)


def compose_scene(
    ground_truth: GroundTruthScene, work: Path, options: CompositionOptions, console: Console
) -> ComposedScene:
    """Reconstruct both captures without the held-out views, segment the object and place it at its true pose."""
    seconds: dict[str, float] = {}
    reconstruction = options.reconstruction
    if options.pipeline == "paper":
        reconstruction = replace(reconstruction, quality="full")
    for side, path in (("source", ground_truth.source), ("target", ground_truth.target)):
        capture = read_capture(path)
        if side == "target":
            capture = capture.select(~held_out(len(capture), HELD_OUT_EVERY))
        folder = work / side / "capture"
        folder.mkdir(parents=True, exist_ok=True)
        write_capture(folder, capture)
        step = Reconstruct(folder, work / side / "scene", options=reconstruction)
        seconds[f"reconstruct {side}"] = perform_if_stale(step, console)
    source = work / "source" / "scene" / SCENE_FILE
    for step in options.segment(source, work / "source" / "capture", work):
        seconds["mask" if isinstance(step, BirefnetMasks) else "segment"] = perform_if_stale(step, console)
    scene = ComposedScene(ground_truth.name, work, light=ground_truth.light, seconds=seconds, views=ground_truth.target)
    compose = place_step(options.pipeline, scene, work / "object" / OBJECT_FILE, ground_truth.placement)
    seconds["compose"] = perform_if_stale(compose, console)
    return scene
