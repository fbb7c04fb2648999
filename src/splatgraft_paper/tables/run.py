"""One run on the authors' data set: measures their pictures, runs our methods, and gives reasons for gaps."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field

from splatgraft.core.flip import VERSION as FLIP_VERSION
from splatgraft.fitting.perceptual_losses import HEADS_FILE, VGG_FILE
from splatgraft.project.layout import METRICS_FILE
from splatgraft.runtime.console import Console
from splatgraft_paper.benchmark.image_features import INCEPTION_FILE
from splatgraft_paper.benchmark.methods import Method
from splatgraft_paper.benchmark.scene import perform_if_stale
from splatgraft_paper.tables.data_ablation import MeasuredModels
from splatgraft_paper.tables.layout import Kind, PaperScene
from splatgraft_paper.tables.measure_pictures import MeasurePictures, MetricOptions, pooled_distances
from splatgraft_paper.tables.our_pictures import OurPictures, OurRun, our_pictures

METRIC_VERSIONS = {
    "psnr": "whole images, peak 1, mean over views, then over scenes",
    "ssim": "Wang 2004, 11x11 Gaussian window, zeros beyond the border, as 3DGS's metrics.py",
    "flip": FLIP_VERSION,
    "lpips": f"Zhang 2018, version 0.1, VGG-16 ({VGG_FILE}, {HEADS_FILE}), pictures scaled to [-1, 1] as published",
    "lpips01": "likewise, pictures in [0, 1] as in 3DGS's metrics.py; the paper does not say which of the two it used",
    "fid": f"Heusel 2017, pooled over the measured views of all scenes, {INCEPTION_FILE}",
    "kid": f"Binkowski 2018, likewise, subsets of 50, {INCEPTION_FILE}",
}
"""Definition of each metric; the paper does not give its own definitions."""


@dataclass(frozen=True)
class Measured:
    """One method on one scene."""

    scene: PaperScene
    method: str
    values: Mapping[str, float]
    """Mean over the measured views by metric."""
    protocol: Mapping[str, object]
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Seconds by step, for methods run here."""


@dataclass(frozen=True)
class PaperResults:
    """All results of a run."""

    scenes: tuple[PaperScene, ...]
    measured: tuple[Measured, ...]
    missing: Mapping[tuple[str, str], str]
    """Reasons for missing measurements by (scene, method)."""
    not_measured: Mapping[str, str]
    """Reasons for missing weights by metric ("lpips", "fid and kid")."""
    ours: Mapping[str, str] = field(default_factory=dict)
    """Names of our methods, in order, and of their folders."""
    pooled: Mapping[tuple[Kind, str, str], Mapping[str, float]] = field(default_factory=dict)
    """FID and KID by (kind, pose or "", method)."""
    by_model: MeasuredModels = field(default_factory=lambda: MeasuredModels({}))
    """Metrics of the trained models on each source's test split."""
    stand_ins: frozenset[str] = frozenset()
    """Metrics whose weights are not the published ones."""
    device: str = ""
    """Name of the device on which our methods ran."""
    conditions: str = ""
    """Quality, segmentation, weights, device and commit of the rows that were run here."""

    def methods(self, kind: Kind) -> list[str]:
        """List the methods with pictures of scenes of a kind, the authors' first."""
        found = [m for scene in self.scenes if scene.kind == kind for m in scene.results]
        return list(dict.fromkeys([*found, *self.ours]))

    def of(self, kind: Kind, method: str, pose: str = "") -> list[Measured]:
        """Select the measurements of a method on the scenes of a kind, optionally at one pose."""
        chosen = [item for item in self.measured if item.scene.kind == kind and item.method == method]
        return [item for item in chosen if pose in ("", item.scene.pose)]


COMPOSITE = "Composite"
"""Row of the pictures before any harmonisation."""


@dataclass(frozen=True)
class PaperRun:
    """Scenes and methods of one run."""

    ours: OurRun
    """Settings of our methods, with the folder of all results."""
    scenes: tuple[PaperScene, ...]
    methods: tuple[Method, ...]
    measure_only: bool = False
    """Whether to measure existing pictures and run no method."""
    all_views: bool = False
    """Whether to measure all views instead of the held-out ones."""


@dataclass
class _Found:
    """Results so far of a running run."""

    metrics: MetricOptions
    console: Console
    measured: list[Measured] = field(default_factory=list)
    missing: dict[tuple[str, str], str] = field(default_factory=dict)
    pools: dict[tuple[Kind, str, str], list[MeasurePictures]] = field(default_factory=dict)


def perform_paper_run(run: PaperRun, not_measured: Mapping[str, str], console: Console) -> PaperResults:
    """Run and measure missing results, except for the models of the data ablation."""
    weights = run.ours.methods.weights
    metrics = MetricOptions(weights, "lpips" not in not_measured, "fid and kid" not in not_measured, run.ours.device)
    found = _Found(metrics, console)
    for scene in run.scenes:
        if scene.lacks:
            found.missing[scene.name, "ground truth"] = scene.lacks
        composite = scene.folders.get("composite")
        theirs = {**({} if composite is None else {COMPOSITE: composite}), **scene.results}
        for method, folder in theirs.items():
            try:
                _measure(run, scene, method, OurPictures(folder, {}), found)
            except ValueError as error:
                found.missing[scene.name, method] = str(error)
        for method in run.methods:
            if run.measure_only:
                found.missing[scene.name, method.name] = "--measure-only: nothing was run"
            else:
                _run_ours(run, scene, method, found)
    names = {method.name: method.folder_name for method in run.methods}
    pooled = pooled_distances(found.pools)
    return PaperResults(run.scenes, tuple(found.measured), found.missing, not_measured, names, pooled)


def _run_ours(run: PaperRun, scene: PaperScene, method: Method, found: _Found) -> None:
    """Run a method on a scene and measure it; record the reason if it cannot run."""
    try:
        made = our_pictures(scene, method, run.ours, found.console)
        _measure(run, scene, method.name, made, found)
    except (ValueError, ModuleNotFoundError) as error:
        found.missing[scene.name, method.name] = " ".join(str(error).split())


def _measure(run: PaperRun, scene: PaperScene, method: str, made: OurPictures, found: _Found) -> None:
    """Measure pictures of a scene whose truth is known."""
    if "truth" not in scene.folders:
        return
    named = {one.name: one.folder_name for one in run.methods}
    out = run.ours.out / "measured" / scene.name / named.get(method, method.replace("/", "-"))
    step = MeasurePictures(made.folder, scene.folders["truth"], out, found.metrics, run.all_views)
    perform_if_stale(step, found.console)
    record = json.loads((out / METRICS_FILE).read_text(encoding="utf-8"))
    found.measured.append(
        Measured(scene, method, {**record["values"], **made.values}, record["protocol"], made.seconds)
    )
    for pose in {"", scene.pose}:
        found.pools.setdefault((scene.kind, pose, method), []).append(step)
