"""The command `paper benchmark`, which measures methods on scenes with ground truth."""

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import cast

from splatgraft.project.step import Device, Positional, locked
from splatgraft.reconstruction import ReconstructOptions
from splatgraft.runtime.console import Console
from splatgraft.runtime.workers import Task, run_tasks
from splatgraft_paper.benchmark.methods import Method
from splatgraft_paper.benchmark.run import (
    BenchmarkRun,
    collect_results,
    measure_scene,
    unmeasurable_metrics,
    write_benchmark_report,
)
from splatgraft_paper.benchmark.scene import CompositionOptions, GroundTruthScene


@dataclass(frozen=True)
class EvaluateBenchmark:
    """Measure methods on scenes with ground truth; finished results are kept."""

    scenes: Positional
    """Folder of scenes that `paper synth benchmark` made; `paper tables` reads the authors' data set."""
    out: Path = Path("benchmark")
    """Folder for index.html, benchmark.json, benchmark.md and all results."""
    methods: tuple[str, ...] = ("copy-paste", "reinhard", "gain", "transfer", "true-light")
    """PRIOR[+HARMONIZER][/LOSS][@SCHEDULE][:KEY=VALUE,..], such as off+flux, transfer+flux/l1-dssim@geometric,
    off+lbm:weights=FOLDER, off+mv-colight:checkout=FOLDER,weights=FOLDER, off+image-editing:max_cost=20;
    paper, the paper's pipeline whole; or NAME=FOLDER for pictures of another program, FOLDER/SCENE/VIEW.png."""
    only: tuple[str, ...] = ()
    """Names of scenes; default: all."""
    weights: Path | None = None
    """Folder with the weights of LPIPS and Inception; default: torch hub's cache."""
    harmonizer_weights: str | None = None
    """Weights of the image model that the methods name: folder, file or hub id, as `harmonize --weights` takes them."""
    birefnet: Path | None = None
    """BiRefNet's .onnx file for the method paper; fetched once from the hub if not given."""
    at_once: int = 1
    """Number of scenes at a time on this machine."""
    ray: str | None = None
    """Address of a Ray cluster whose machines all see both folders; `local`: one of this machine's cores."""
    options: ReconstructOptions = field(default_factory=lambda: ReconstructOptions(quality="draft", device="auto"))

    def execute(self, console: Console) -> int:
        """Run the missing steps and write the report; return 1 if a scene or a method failed."""
        methods = tuple(Method.parse(text) for text in self.methods)
        composition = CompositionOptions(self.options, cast(Device, self.options.device), self.birefnet)
        run = BenchmarkRun(self.out, self._scenes(), methods, composition, self.weights, self.harmonizer_weights)
        missing = unmeasurable_metrics(self.weights)
        for name, reason in missing.items():
            console.say(f"{name}: not measured: {reason}")
        with locked(self.out):
            tasks = [Task(scene.name, partial(measure_scene, run, scene, "lpips" not in missing))
                     for scene in run.scenes]  # fmt: skip
            failures = run_tasks(tasks, at_once=self.at_once, ray_address=self.ray)
            found = collect_results(run, missing, failures)
            write_benchmark_report(run, found)
        for line in found.not_run:
            console.say(line)
        console.result(self.out / "index.html")
        return 1 if found.not_run else 0

    def _scenes(self) -> tuple[GroundTruthScene, ...]:
        found = [GroundTruthScene.from_folder(path.parent) for path in sorted(self.scenes.glob("*/ground_truth"))]
        if not found:
            raise ValueError(f"{self.scenes}: expected scenes with ground_truth/, found none")
        names = [scene.name for scene in found]
        if unknown := [name for name in self.only if name not in names]:
            raise ValueError(f"--only: expected names among {', '.join(names)}; found {unknown[0]}")
        return tuple(scene for scene in found if not self.only or scene.name in self.only)
