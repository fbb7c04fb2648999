"""The command `evaluate benchmark`: methods times scenes become tables, a page, JSON and Markdown."""

import json
import os
import platform
import shlex
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Literal, cast

import torch

from splatgraft.core.images import read_rgb, write_image
from splatgraft.evaluation.benchmark.image_features import (
    Features,
    frechet_distance,
    inception_features,
    kernel_distance,
)
from splatgraft.evaluation.benchmark.page import benchmark_html
from splatgraft.evaluation.benchmark.published_datasets import PUBLISHED, download, find_scenes
from splatgraft.evaluation.benchmark.table import Benchmark, Row, as_json, markdown
from splatgraft.evaluation.benchmark.view_metrics import REGIONS, only_region
from splatgraft.evaluation.regions import find_regions
from splatgraft.evaluation.report_page import ViewFiles
from splatgraft.fitting.perceptual_losses import lpips_vgg
from splatgraft.formats import read_capture
from splatgraft.project.folder_lock import locked
from splatgraft.project.layout import METRICS_FILE
from splatgraft.project.step import Device, Positional
from splatgraft.reconstruction import ReconstructOptions
from splatgraft.runtime.console import Console
from splatgraft.runtime.workers import Task, run_tasks
from splatgraft.workflow.benchmark.measure_method import MeasureMethod, truth_of
from splatgraft.workflow.benchmark.methods import Method, result_of
from splatgraft.workflow.benchmark.scene import GivenScene, fresh, ready_scene

_NOT_RUN_FILE = "not_run.txt"
_SECONDS_FILE = "seconds.json"


@dataclass(frozen=True)
class EvaluateBenchmark:
    """Measure any methods on any scenes with ground truth; what is done already is kept."""

    scenes: Positional
    """Folder of scenes that `synth benchmark` made, or of a published data set."""
    out: Path = Path("benchmark")
    """Folder for index.html, benchmark.json, benchmark.md and all results."""
    methods: tuple[str, ...] = ("copy-paste", "reinhard", "gain", "transfer", "true-light")
    """PRIOR[+HARMONIZER][/LOSS][@SCHEDULE], such as off+flux, transfer+compact/l1-dssim, transfer+compact@geometric;
    or NAME=FOLDER for pictures of another program, FOLDER/SCENE/VIEW.png."""
    only: tuple[str, ...] = ()
    """Names of scenes; all where none is given."""
    published: Literal["none", "dot3d", "syncom"] = "none"
    """Read the scenes as this published data set lays them out."""
    download: bool = False
    """Fetch the published data set into the folder first."""
    weights: Path | None = None
    """Folder with the weights of LPIPS and Inception; torch hub's cache where not given."""
    harmonizer_weights: str | None = None
    """Weights of the image model that the methods name: folder, file or hub id, as `harmonize --weights` takes them."""
    at_once: int = 1
    """Scenes at a time on this machine."""
    ray: str | None = None
    """Address of a Ray cluster whose machines all see both folders; `local` for one of this machine's cores."""
    options: ReconstructOptions = field(default_factory=lambda: ReconstructOptions(quality="draft", device="auto"))

    def execute(self, console: Console) -> int:
        """Run what is missing and write the report; 1 where a scene or a method failed."""
        methods = [Method.named(text) for text in self.methods]
        given = self._given()
        missing = _missing_weights(self.weights)
        for name, reason in missing.items():
            console.say(f"{name}: not measured: {reason}")
        with locked(self.out):
            tasks = [Task(scene.name, partial(_measure_scene, self, scene, methods, "lpips" not in missing))
                     for scene in given]  # fmt: skip
            failures = run_tasks(tasks, at_once=self.at_once, ray_address=self.ray)
            found = _collected(self, given, methods, missing, failures)
            _write_report(self, found, given)
        for line in found.not_run:
            console.say(line)
        console.result(self.out / "index.html")
        return 1 if found.not_run else 0

    @property
    def device(self) -> Device:
        """Where to compute."""
        return cast(Device, self.options.device)

    def work(self, scene: GivenScene) -> Path:
        """Everything made of one scene."""
        return self.out / "scenes" / scene.name

    def measured(self, scene: GivenScene, method: Method) -> Path:
        """Numbers and pictures of one method on one scene."""
        return self.work(scene) / "measured" / method.folder_name

    def _given(self) -> list[GivenScene]:
        if self.published != "none":
            layout = PUBLISHED[self.published]
            if self.download:
                download(layout, self.scenes)
            found = [GivenScene.of_published(scene) for scene in find_scenes(layout, self.scenes)]
        else:
            found = [GivenScene.of(path.parent) for path in sorted(self.scenes.glob("*/ground_truth"))]
        if not found:
            raise ValueError(f"{self.scenes}: expected scenes with ground_truth/, found none")
        names = [scene.name for scene in found]
        if unknown := [name for name in self.only if name not in names]:
            raise ValueError(f"--only: expected names among {', '.join(names)}; found {unknown[0]}")
        return [scene for scene in found if not self.only or scene.name in self.only]


def _measure_scene(command: EvaluateBenchmark, scene: GivenScene, methods: list[Method], lpips: bool) -> None:
    """Run and measure all methods on one scene; a method that cannot run leaves a file that says why."""
    console = Console()
    console.say(f"scene {scene.name}")
    ready = ready_scene(scene, command.work(scene), command.options, device=command.device, console=console)
    for method in methods:
        out = command.measured(scene, method)
        reason = out.with_name(f"{out.name}.{_NOT_RUN_FILE}")
        reason.unlink(missing_ok=True)
        try:
            result, seconds = None, {}
            if method.pictures is None:
                result, seconds = result_of(
                    method,
                    ready,
                    weights=command.weights,
                    model=command.harmonizer_weights,
                    device=command.device,
                    console=console,
                )
            shown = None if method.pictures is None else method.pictures / scene.name
            step = MeasureMethod(
                scene.truth, scene.target, ready.target, out, result, shown, command.weights, lpips, command.device
            )
            fresh(step, console)
            times = {**({} if method.pictures else ready.seconds), **seconds}
            out.with_name(f"{out.name}.{_SECONDS_FILE}").write_text(json.dumps(times))
        except ValueError as error:
            reason.parent.mkdir(parents=True, exist_ok=True)
            reason.write_text(str(error))


def _missing_weights(folder: Path | None) -> dict[str, str]:
    """Metrics that cannot be taken, and why."""
    missing = {}
    try:
        lpips_vgg(folder)
    except ValueError as error:
        missing["lpips"] = str(error)
    try:
        inception_features(folder)
    except ValueError as error:
        missing["fid and kid"] = str(error)
    return missing


def _collected(
    command: EvaluateBenchmark,
    given: list[GivenScene],
    methods: list[Method],
    missing: dict[str, str],
    failures: list[str],
) -> Benchmark:
    rows, not_run, floors = [], [f"not run: {line}" for line in failures], []
    counts: set[int] = set()
    for method in methods:
        for scene in given:
            out = command.measured(scene, method)
            reason = out.with_name(f"{out.name}.{_NOT_RUN_FILE}")
            if reason.is_file():
                not_run.append(f"{method.name} on {scene.name} not run: {reason.read_text()}")
            elif (out / METRICS_FILE).is_file():
                record = json.loads((out / METRICS_FILE).read_text())
                times = json.loads(out.with_name(f"{out.name}.{_SECONDS_FILE}").read_text())
                rows.append(Row(scene.name, method.name, record["values"], times))
                counts.add(len(record["views"]))
                if (floor := record["values"].get("disagreement_truth")) is not None:
                    floors.append(floor)
    notes = [
        f"Every 8th view is held out of reconstruction, harmonisation and consolidation; {_span(counts)} per scene.",
        f"{len(given)} scenes, quality {command.options.quality}, {os.cpu_count()} cores of {platform.machine()}, "
        f"torch on {'CUDA' if torch.cuda.is_available() and command.device != 'cpu' else 'the CPU'}.",
        f"Made by splatgraft {version('splatgraft')}: {shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])}",
    ]
    if floors:
        own = sum(floors) / len(floors)
        notes.append(f"The truth's own neighbouring views disagree by {own:.4f} (gloss, render noise).")
    if "fid and kid" not in missing:
        notes.append("FID and KID are over the held-out views of all scenes; with so few pictures they are biased.")
    pooled = {} if "fid and kid" in missing else _distributions(command, given, methods)
    return Benchmark(tuple(rows), tuple(not_run), missing, tuple(notes), pooled)


def _distributions(
    command: EvaluateBenchmark, given: list[GivenScene], methods: list[Method]
) -> dict[str, dict[str, float | None]]:
    features: Features = inception_features(command.weights)
    out: dict[str, dict[str, float | None]] = {}
    for method in methods:
        out[method.name] = {}
        for region in REGIONS:
            pairs = list(_pictures(command, given, method, region))
            if len(pairs) < 2:
                continue
            found, wanted = features([p for p, _ in pairs]), features([t for _, t in pairs])
            out[method.name] |= {
                f"fid_{region}": frechet_distance(found, wanted),
                f"kid_{region}": kernel_distance(found, wanted),
            }
    return out


def _pictures(
    command: EvaluateBenchmark, given: list[GivenScene], method: Method, region: str
) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """A method's pictures of all held-out views, outside a region replaced by the truth, each with the truth."""
    for scene in given:
        truth, photographs = read_capture(scene.truth), read_capture(scene.target)
        for index, name in enumerate(truth.cameras.names):
            path = command.measured(scene, method) / "pictures" / f"{Path(name).stem}.png"
            if path.is_file():
                view = truth_of(truth, photographs, index)
                mixed = only_region(read_rgb(path), view, find_regions(view), region)
                if mixed is not None:
                    yield mixed, view.image


def _write_report(command: EvaluateBenchmark, found: Benchmark, given: list[GivenScene]) -> None:
    (command.out / "benchmark.json").write_text(json.dumps(as_json(found), indent=1, allow_nan=False))
    (command.out / "benchmark.md").write_text(markdown(found))
    views = []
    by_name = {scene.name: scene for scene in given}
    for scene in found.scenes:
        truth = read_capture(by_name[scene].truth)
        methods = [Method.named(text) for text in command.methods]
        folders = {m.name: command.measured(by_name[scene], m) / "pictures" for m in methods}
        stems = sorted({path.stem for folder in folders.values() for path in folder.glob("*.png")})
        for stem in stems:
            index = [Path(name).stem for name in truth.cameras.names].index(stem)
            shown = command.out / "truth" / scene / f"{stem}.png"
            shown.parent.mkdir(parents=True, exist_ok=True)
            write_image(shown, truth.image(index))
            files = {name: folder / f"{stem}.png" for name, folder in folders.items()}
            files = {name: path for name, path in files.items() if path.is_file()} | {"Ground truth": shown}
            relative = {name: str(path.relative_to(command.out)) for name, path in files.items()}
            height, width = truth.image(index).shape[:2]
            views.append(ViewFiles(f"{scene} {stem}", held_out=True, files=relative, width=width, height=height))
    (command.out / "index.html").write_text(benchmark_html(found, views))


def _span(counts: set[int]) -> str:
    if not counts:
        return "no views"
    low, high = min(counts), max(counts)
    return f"{low} views" if low == high else f"{low} to {high} views"


COMMAND = EvaluateBenchmark
