"""One run on the authors' data set: their pictures are measured, our methods run, and what is missing is explained."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from splatgraft.runtime.console import Console
from splatgraft_paper.benchmark.image_features import inception_features
from splatgraft_paper.benchmark.methods import Method
from splatgraft_paper.benchmark.scene import perform_if_stale
from splatgraft_paper.tables.measure_pictures import MeasurePictures
from splatgraft_paper.tables.our_pictures import OurRun, our_pictures
from splatgraft_paper.tables.paper_scene import DataLayout, Kind, PaperScene
from splatgraft_paper.tables.results import Measured, PaperResults, pooled_distances, read_measured

COMPOSITE = "Composite"
"""The row of the pictures before any harmonisation."""


@dataclass(frozen=True)
class PaperRun:
    """What is run and measured."""

    ours: OurRun
    """How our methods are run, and where all results go."""
    layout: DataLayout
    methods: tuple[Method, ...]
    measure_only: bool = False
    """Measure the pictures that are there, and run nothing."""
    all_views: bool = False
    """Measure all views, not only the held-out ones."""


@dataclass
class _Found:
    """What has been measured so far, and how."""

    lpips: bool
    console: Console
    measured: list[Measured] = field(default_factory=list)
    missing: dict[tuple[str, str], str] = field(default_factory=dict)
    pools: dict[tuple[Kind, str, str], list[MeasurePictures]] = field(default_factory=dict)


def perform_paper_run(run: PaperRun, not_measured: Mapping[str, str], console: Console) -> PaperResults:
    """Measure and run what is missing.

    Args:
        run: Scenes, methods, settings.
        not_measured: Metrics whose weights are missing, with the reason.
        console: Takes progress and messages.
    """
    found = _Found("lpips" not in not_measured, console)
    for scene in run.layout.scenes:
        for sentence in scene.taken:
            console.say(f"{scene.name}: {sentence}")
        composite = scene.folders.get("composite")
        theirs = {**({} if composite is None else {COMPOSITE: composite}), **scene.results}
        for method, folder in theirs.items():
            try:
                _measure(run, scene, method, folder, found)
            except ValueError as error:
                found.missing[scene.name, method] = str(error)
        for method in run.methods:
            if run.measure_only:
                found.missing[scene.name, method.name] = "--measure-only: nothing was run"
            else:
                _run_ours(run, scene, method, found)
    pooled = {}
    if "fid and kid" not in not_measured:
        pooled = pooled_distances(found.pools, inception_features(run.ours.methods.weights))
    names = tuple(method.name for method in run.methods)
    return PaperResults(run.layout, tuple(found.measured), found.missing, not_measured, names, pooled)


def _run_ours(run: PaperRun, scene: PaperScene, method: Method, found: _Found) -> None:
    """Run a method on a scene and measure it; a method that cannot run leaves its reason."""
    try:
        folder, seconds = our_pictures(scene, method, run.ours, found.console)
        _measure(run, scene, method.name, folder, found)
        last = found.measured[-1]
        found.measured[-1] = Measured(last.scene, last.method, last.values, last.protocol, seconds)
    except (ValueError, ModuleNotFoundError) as error:
        found.missing[scene.name, method.name] = " ".join(str(error).split())


def _measure(run: PaperRun, scene: PaperScene, method: str, folder: Path, found: _Found) -> None:
    out = run.ours.out / "measured" / scene.name / method.replace("/", "-")
    step = MeasurePictures(
        folder,
        out,
        **scene.folders,
        weights=run.ours.methods.weights,
        lpips=found.lpips,
        held_out_every=run.layout.held_out_every,
        all_views=run.all_views,
    )
    perform_if_stale(step, found.console)
    found.measured.append(read_measured(scene, method, out))
    if "truth" in scene.folders:
        for pose in {"", scene.pose}:
            found.pools.setdefault((scene.kind, pose, method), []).append(step)
