"""One run of the benchmark: measures all methods on all scenes and writes tables as JSON, Markdown and a page."""

import json
import os
import platform
import shlex
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from html import escape
from importlib.metadata import version
from pathlib import Path

import torch

from splatgraft.core.images import read_rgb, write_image
from splatgraft.evaluation.measure import find_regions
from splatgraft.evaluation.report_page import ViewFiles, html_page, viewer
from splatgraft.fitting.perceptual_losses import lpips_vgg
from splatgraft.formats import read_capture
from splatgraft.project.layout import METRICS_FILE
from splatgraft.project.step import Device
from splatgraft.runtime.console import Console
from splatgraft_paper.benchmark.image_features import (
    Features,
    frechet_distance,
    inception_features,
    kernel_distance,
)
from splatgraft_paper.benchmark.measure import REGIONS, MeasureMethod, only_region, true_view
from splatgraft_paper.benchmark.methods import Method, MethodSettings, run_method
from splatgraft_paper.benchmark.scene import (
    ComposedScene,
    CompositionOptions,
    GroundTruthScene,
    Pipeline,
    compose_scene,
    perform_if_stale,
)
from splatgraft_paper.benchmark.table import Benchmark, Row, as_json, markdown, table_section, tables


@dataclass(frozen=True)
class BenchmarkRun:
    """Scenes, methods and options of one run of the benchmark."""

    out: Path
    """Folder of all results."""
    scenes: tuple[GroundTruthScene, ...]
    methods: tuple[Method, ...]
    composition: CompositionOptions
    """Options of reconstruction and composition; their device serves all steps."""
    weights: Path | None = None
    """Folder with the weights of LPIPS and Inception."""
    harmonizer_weights: str | None = None
    """Weights of the harmonisers that the methods name."""

    @property
    def device(self) -> Device:
        """Device of all steps."""
        return self.composition.device

    def work(self, scene: GroundTruthScene) -> Path:
        """Folder of everything made from one scene."""
        return self.out / "scenes" / scene.name

    def measured(self, scene: GroundTruthScene, method: Method) -> Path:
        """Folder with the metrics and pictures of one method on one scene."""
        return self.work(scene) / "measured" / method.folder_name

    def outcome_file(self, scene: GroundTruthScene, method: Method) -> Path:
        """File with the seconds of a method's steps on a scene, or the reason why it could not run."""
        out = self.measured(scene, method)
        return out.with_name(f"{out.name}.json")


def measure_scene(run: BenchmarkRun, scene: GroundTruthScene, lpips: bool) -> None:
    """Run and measure all methods on one scene; write the reason for a method that cannot run."""
    console = Console()
    console.say(f"scene {scene.name}")

    @cache
    def composed_by(pipeline: Pipeline) -> ComposedScene:
        work = run.work(scene) / ("" if pipeline == "ours" else "as_paper")
        return compose_scene(scene, work, replace(run.composition, pipeline=pipeline), console)

    for method in run.methods:
        composed = composed_by(method.pipeline)
        out, outcome = run.measured(scene, method), {}
        try:
            result, seconds = None, {}
            if method.pictures is None:
                settings = MethodSettings(run.weights, run.harmonizer_weights, run.device)
                result, seconds = run_method(method, composed, settings, console)
            shown = None if method.pictures is None else method.pictures / scene.name
            if result is not None and result.is_dir():
                result, shown = None, result
            step = MeasureMethod(
                scene.truth, scene.target, composed.target, out, result, shown, run.weights, lpips, run.device
            )
            perform_if_stale(step, console)
            outcome["seconds"] = {**({} if method.pictures else composed.seconds), **seconds}
        except ValueError as error:
            outcome["reason"] = str(error)
        out.parent.mkdir(parents=True, exist_ok=True)
        run.outcome_file(scene, method).write_text(json.dumps(outcome), encoding="utf-8")


def unmeasurable_metrics(folder: Path | None) -> dict[str, str]:
    """List the metrics whose weights are missing, with the reason."""
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


def collect_results(run: BenchmarkRun, missing: dict[str, str], failures: list[str]) -> Benchmark:
    """Read the measured values of all methods on all scenes."""
    rows, not_run, floors = [], [f"not run: {line}" for line in failures], []
    counts: set[int] = set()
    for method in run.methods:
        for scene in run.scenes:
            out = run.measured(scene, method)
            file = run.outcome_file(scene, method)
            if not file.is_file():
                continue
            if "reason" in (outcome := json.loads(file.read_text(encoding="utf-8"))):
                not_run.append(f"{method.name} on {scene.name} not run: {outcome['reason']}")
            else:
                record = json.loads((out / METRICS_FILE).read_text(encoding="utf-8"))
                rows.append(Row(scene.name, method.name, record["values"], outcome["seconds"]))
                counts.add(len(record["views"]))
                if (disagreement := record["values"].get("disagreement_truth")) is not None:
                    floors.append(disagreement)
    notes = [
        f"Every 8th view is held out of reconstruction, harmonisation and consolidation; {_span(counts)} per scene.",
        f"{len(run.scenes)} scenes, quality {run.composition.reconstruction.quality} (full for the method paper), "
        f"{os.cpu_count()} cores of {platform.machine()}, "
        f"torch on {'CUDA' if torch.cuda.is_available() and run.device != 'cpu' else 'the CPU'}.",
        f"Made by splatgraft {version('splatgraft')}: {shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])}",
    ]
    if floors:
        floor = sum(floors) / len(floors)
        notes.append(f"The truth's own neighbouring views disagree by {floor:.4f} (gloss, render noise).")
    if "fid and kid" not in missing:
        notes.append("FID and KID are over the held-out views of all scenes; with so few pictures they are biased.")
    pooled = {} if "fid and kid" in missing else _distributions(run)
    return Benchmark(tuple(rows), tuple(not_run), missing, tuple(notes), pooled)


def write_benchmark_report(run: BenchmarkRun, found: Benchmark) -> None:
    """Write benchmark.json, benchmark.md and index.html."""
    (run.out / "benchmark.json").write_text(json.dumps(as_json(found), indent=1, allow_nan=False), encoding="utf-8")
    (run.out / "benchmark.md").write_text(markdown(found), encoding="utf-8")
    views = []
    by_name = {scene.name: scene for scene in run.scenes}
    for scene in found.scenes:
        truth = read_capture(by_name[scene].truth)
        folders = {m.name: run.measured(by_name[scene], m) / "pictures" for m in run.methods}
        stems = sorted({path.stem for folder in folders.values() for path in folder.glob("*.png")})
        for stem in stems:
            index = [Path(name).stem for name in truth.cameras.names].index(stem)
            shown = run.out / "truth" / scene / f"{stem}.png"
            shown.parent.mkdir(parents=True, exist_ok=True)
            write_image(shown, truth.image(index))
            files = {name: folder / f"{stem}.png" for name, folder in folders.items()}
            files = {name: path for name, path in files.items() if path.is_file()} | {"Ground truth": shown}
            relative = {name: str(path.relative_to(run.out)) for name, path in files.items()}
            height, width = truth.image(index).shape[:2]
            views.append(ViewFiles(f"{scene} {stem}", held_out=True, files=relative, width=width, height=height))
    (run.out / "index.html").write_text(_benchmark_html(found, views), encoding="utf-8")


def _distributions(run: BenchmarkRun) -> dict[str, dict[str, float | None]]:
    features: Features = inception_features(run.weights)
    out: dict[str, dict[str, float | None]] = {}
    for method in run.methods:
        out[method.name] = {}
        for region in REGIONS:
            pairs = list(_pictures(run, method, region))
            if len(pairs) < 2:
                continue
            found, wanted = features([p for p, _ in pairs]), features([t for _, t in pairs])
            out[method.name] |= {
                f"fid_{region}": frechet_distance(found, wanted),
                f"kid_{region}": kernel_distance(found, wanted),
            }
    return out


def _pictures(run: BenchmarkRun, method: Method, region: str) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """Yield a method's pictures of all held-out views with the truth; outside the region both are the truth."""
    for scene in run.scenes:
        truth, photographs = read_capture(scene.truth), read_capture(scene.target)
        for index, name in enumerate(truth.cameras.names):
            path = run.measured(scene, method) / "pictures" / f"{Path(name).stem}.png"
            if path.is_file():
                view = true_view(truth, photographs, index)
                mixed = only_region(read_rgb(path), view, find_regions(view), region)
                if mixed is not None:
                    yield mixed, view.image


def _span(counts: set[int]) -> str:
    if not counts:
        return "no views"
    low, high = min(counts), max(counts)
    return f"{low} views" if low == high else f"{low} to {high} views"


def _benchmark_html(benchmark: Benchmark, views: Sequence[ViewFiles]) -> str:
    """Format the page; paths in `views` are relative to it."""
    notes = [*benchmark.notes, *benchmark.not_run]
    notes += [f"Not measured: {name}: {reason}" for name, reason in benchmark.not_measured.items()]
    items = "".join(f"<li>{escape(note)}</li>" for note in notes)
    sections = [
        viewer(views) if views else "",
        *(table_section(table) for table in tables(benchmark)),
        f"<section><h2>Limitations</h2><ul>{items}</ul></section>\n",
    ]
    scenes = len(benchmark.scenes)
    count = f"{len(benchmark.methods)} methods on {scenes} scene{'s' if scenes != 1 else ''}"
    subtitle = f"{count}; means over held-out views, then over scenes, with 95% bootstrap intervals over scenes."
    return html_page("Benchmark of object transfer", subtitle, "".join(sections), views=views)
