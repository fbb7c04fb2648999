"""The command `evaluate`: pictures before and after, metrics if there is ground truth, and a page with both."""

import os
import platform
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import read_rgb, resize, write_image
from splatgraft.evaluation import (
    ComparedView,
    Report,
    ReportView,
    ReportWarning,
    StepTime,
    TurntableOptions,
    change_map,
    depth_colors,
    describe_change,
    measure,
    normal_colors,
    normals_from_depth,
    side_by_side,
    turntable_cameras,
    write_animation,
    write_report,
)
from splatgraft.fitting.perceptual_losses import lpips_vgg
from splatgraft.folders.capture_files import camera_files
from splatgraft.folders.evaluated_scenes import EvaluatedScenes, Pictures, TrueViews, truth_files
from splatgraft.project.layout import SCENE_FILE
from splatgraft.project.record import Record, read_record
from splatgraft.project.step import Context, Device, Inputs, choose_device, plain_options
from splatgraft.project.step_table import RESULTS_IN_ORDER
from splatgraft.rendering import render
from splatgraft.runtime.note import Note


@dataclass(frozen=True)
class Evaluate:
    """Compare the result with copy-paste and, if it exists, with ground truth; write pictures and index.html."""

    result: Path
    """The consolidated scene, a .ply."""
    composite: Path
    """The folder of the composite, which holds the object as captured."""
    cameras: Path
    """The target's cameras: a capture folder or its transforms.json."""
    out: Path = Path("report")
    """Folder for index.html, pictures and metrics.json."""
    ground_truth: Path | None = None
    """A capture of the target with the real object in it, with masks; its views are compared."""
    target_capture: Path | None = None
    """The target's images without the object; needed with a ground truth."""
    views: Path | None = None
    """The folder of harmonised views; other views of the ground truth count as held out."""
    light: Path | None = None
    """The report of the light transfer, a text file."""
    project: Path | None = None
    """The folder of all results; the page then shows the warnings and the time of each step."""
    lpips_weights: Path | None = None
    """Folder with vgg16-397923af.pth and vgg.pth; torch hub's cache if not given."""
    pictured: int = 8
    """Number of views on the page."""
    width: int | None = None
    """Width of the pictures, pixels; that of the cameras if not given. With a ground truth, pictures have its size."""
    frames: int = 48
    """Frames of the turntable; 0 for no turntable."""
    device: Device = "auto"
    """Device to render on."""

    def inputs(self) -> Inputs:
        """Return the scenes, the cameras, the light and the truth."""
        composite = (self.composite / SCENE_FILE, self.composite / "is_object.npy")
        light = () if self.light is None else (self.light,)
        truth = truth_files(self.ground_truth, self.target_capture)
        return {
            "scenes": (self.result, *composite),
            "cameras": camera_files(self.cameras),
            "light": light,
            "truth": truth,
        }

    def recorded_options(self) -> dict[str, Any]:
        """Return the options for step.json, with the warnings that the page shows."""
        warned = [f"{label}: {warning.text}" for label, _, warning in _warnings(self.project)]
        return plain_options(vars(self)) | ({"warnings": warned} if warned else {})

    def write(self, folder: Path, context: Context) -> None:
        """Write the report."""
        device = choose_device(self.device, context.console)
        scenes = EvaluatedScenes.read(self.result, self.composite, self.cameras, device=device)
        metrics, missing = None, {}
        truth = None
        if self.ground_truth is not None:
            truth = TrueViews.read(self.ground_truth, self.target_capture, self.views)
            metrics, missing = self._measure(truth.compared(scenes), context)
        if truth is not None:
            cameras = truth.truth.cameras
            pictures = [truth.pictures(scenes, index) for index in _spread(len(truth.truth), self.pictured)]
        else:
            sized = scenes.with_width(self.width)
            cameras = sized.cameras
            chosen = dict.fromkeys([sized.best_view, *_spread(len(cameras), self.pictured)])
            pictures = [sized.pictures_from(cameras[i]) for i in list(chosen)[: self.pictured]]
        changes = [describe_change(p.result, p.copy_paste, p.mask) for p in pictures]
        best = max(pictures, key=lambda p: p.prominence)
        pictures = [best, *(p for p in pictures if p is not best)]  # the best view comes first on the page
        self._write_pictures(folder, best)
        turntable = _turntable(scenes, self.frames, context) if self.frames else []
        if turntable:
            write_animation(folder / "turntable.gif", turntable)
        report = Report(
            title="Object transfer: before and after",
            subtitle=f"{int(scenes.is_object.sum()):,} Gaussians of the object among {scenes.result.count:,} in all.",
            warnings=_report_warnings(self.project, best),
            metrics=metrics,
            changes={key: sum(c[key] for c in changes) / len(changes) for key in changes[0]} if changes else {},
            not_measured=missing,
            light=self.light.read_text(encoding="utf-8") if self.light is not None else "",
            steps=_step_times(self.project) if self.project is not None else (),
            machine=f"{os.cpu_count()} cores of {platform.machine()}, {device}",
            limits=_LIMITS if truth is None else (),
        )
        most_prominent = sorted(pictures, key=lambda p: -p.prominence)[:_GEOMETRY_VIEWS]
        write_report(
            folder,
            report,
            views=(_report_view(p) for p in pictures),
            geometry=(_geometry_view(scenes.result, cameras[cameras.names.index(p.name)], p) for p in most_prominent),
            turntable=turntable,
        )

    def _measure(self, views: Sequence[ComparedView], context: Context) -> tuple[dict, dict[str, str]]:
        try:
            perceptual, missing = lpips_vgg(self.lpips_weights), {}
        except ValueError as error:
            if self.lpips_weights is not None:
                raise
            perceptual, missing = None, {"lpips": str(error)}
        return measure(views, perceptual), missing

    def _write_pictures(self, folder: Path, best: Pictures) -> None:
        write_image(folder / "before.png", best.before)
        write_image(folder / "copy_paste.png", best.copy_paste)
        write_image(folder / "after.png", best.result)
        three = side_by_side((best.before, best.copy_paste, best.result), ("Before", "Copy-paste", "After"))
        write_image(folder / "before_after.png", three)


_WARNING_PX = 640  # width of the pictures beside warnings: twice their width on the page
_GEOMETRY_VIEWS = 2  # views with depth and normals
_GEOMETRY_PX = 640  # longest side of these: twice their size on the page
_LIMITS = (
    "There is no ground truth for these captures: the pictures show the change, not whether it is right.",
    "Views far from the captured viewpoints are less reliable than the pictures here.",
)


def _spread(count: int, wanted: int) -> list[int]:
    """Return at most `wanted` of `count` indices, evenly spaced."""
    return sorted({round(i) for i in torch.linspace(0, count - 1, min(count, wanted)).tolist()})


def _report_view(pictures: Pictures) -> ReportView:
    shown = {"Copy-paste": pictures.copy_paste, "Result": pictures.result}
    if pictures.truth is not None:
        shown["Ground truth"] = pictures.truth
    shown |= {"Before": pictures.before, "Change of light": change_map(pictures.result, pictures.copy_paste)}
    return ReportView(name=pictures.name, held_out=pictures.held_out, pictures=shown)


def _geometry_view(scene: Gaussians, camera: Cameras, pictures: Pictures) -> ReportView:
    """Draw the surface of the final scene from the camera of one view."""
    small = camera.limited(_GEOMETRY_PX)
    drawn = render(scene, small.to(scene.device), outputs=frozenset({"color", "depth"}))
    depth = drawn.depth[0].cpu()
    shown = {
        "Result": drawn.color[0].cpu(),
        "Depth": depth_colors(depth),
        "Normals": normal_colors(normals_from_depth(depth, small)),
    }
    return ReportView(name=pictures.name, held_out=pictures.held_out, pictures=shown)


def _turntable(scenes: EvaluatedScenes, frames: int, context: Context) -> list[torch.Tensor]:
    cameras = turntable_cameras(
        scenes.cameras,
        scenes.object_center,
        up=estimate_up(scenes.cameras),
        options=TurntableOptions(frames=frames, start=scenes.photographed_side),
    )
    pictures: list[torch.Tensor] = []
    for index, camera in enumerate(cameras):
        pictures.append(scenes.picture(scenes.result, camera))
        context.progress(index + 1, frames, "turntable")
    return pictures


def _records(project: Path) -> Iterator[tuple[str, Path, Record]]:
    """Yield the steps before this one: label on the page, folder and record."""
    for name in RESULTS_IN_ORDER[:-1]:
        if (record := read_record(project / name)) is not None:
            yield f"{name.split('/')[0]}: {record.step}" if "/" in name else record.step, project / name, record


def _step_times(project: Path) -> tuple[StepTime, ...]:
    return tuple(
        StepTime(label, record.seconds, f"at most {record.memory} of memory" if record.memory else "")
        for label, _, record in _records(project)
    )


def _warnings(project: Path | None) -> Iterator[tuple[str, Path, Note]]:
    """Yield all warnings of a project with the labels and the folders of their steps."""
    if project is not None:
        for label, folder, record in _records(project):
            yield from ((label, folder, warning) for warning in record.warnings)


def _report_warnings(project: Path | None, best: Pictures) -> tuple[ReportWarning, ...]:
    """Return the warnings with their pictures; those on place and light without one get the best view of the object."""
    shown = {"compose": best.copy_paste, "relight": best.result}
    found: list[ReportWarning] = []
    for label, folder, warning in _warnings(project):
        step = label.split(": ")[-1]
        picture = shown.get(step)
        if warning.picture is not None and (path := folder / warning.picture).is_file():
            picture = read_rgb(path)
        small = None if picture is None else _at_most(picture, _WARNING_PX)
        note = replace(warning, remedy=warning.remedy.replace("PROJECT", str(project)))
        found.append(ReportWarning(label, note, small))
    return tuple(found)


def _at_most(picture: torch.Tensor, width: int) -> torch.Tensor:
    height = max(1, round(picture.shape[0] * width / picture.shape[1]))
    return resize(picture.cpu(), width, height) if picture.shape[1] > width else picture


COMMAND = Evaluate
