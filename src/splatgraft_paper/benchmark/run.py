"""One run of the benchmark: folders of its results, and the measurement of all methods on one scene."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from splatgraft.fitting.perceptual_losses import lpips_vgg
from splatgraft.project.step import Device
from splatgraft.reconstruction import ReconstructOptions
from splatgraft.runtime.console import Console
from splatgraft_paper.benchmark.image_features import inception_features
from splatgraft_paper.benchmark.measure_method import MeasureMethod
from splatgraft_paper.benchmark.methods import Method, MethodSettings, run_method
from splatgraft_paper.benchmark.scene import GroundTruthScene, compose_scene, perform_if_stale

NOT_RUN_FILE = "not_run.txt"
SECONDS_FILE = "seconds.json"


@dataclass(frozen=True)
class BenchmarkRun:
    """Scenes, methods and options of one run of the benchmark."""

    out: Path
    """Folder of all results."""
    scenes: tuple[GroundTruthScene, ...]
    methods: tuple[Method, ...]
    options: ReconstructOptions
    """Of the reconstruction of every capture; its device serves all steps."""
    weights: Path | None = None
    """Folder with the weights of LPIPS and Inception."""
    harmonizer_weights: str | None = None
    """Weights of the harmonisers that the methods name."""

    @property
    def device(self) -> Device:
        """Where to compute."""
        return cast(Device, self.options.device)

    def work(self, scene: GroundTruthScene) -> Path:
        """Folder of everything made from one scene."""
        return self.out / "scenes" / scene.name

    def measured(self, scene: GroundTruthScene, method: Method) -> Path:
        """Folder with the metrics and pictures of one method on one scene."""
        return self.work(scene) / "measured" / method.folder_name

    def not_run_file(self, scene: GroundTruthScene, method: Method) -> Path:
        """The file with the reason why a method could not run on a scene; absent where it ran."""
        out = self.measured(scene, method)
        return out.with_name(f"{out.name}.{NOT_RUN_FILE}")

    def seconds_file(self, scene: GroundTruthScene, method: Method) -> Path:
        """The file with the seconds of each step of a method on a scene."""
        out = self.measured(scene, method)
        return out.with_name(f"{out.name}.{SECONDS_FILE}")


def measure_scene(run: BenchmarkRun, scene: GroundTruthScene, lpips: bool) -> None:
    """Run and measure all methods on one scene; a method that cannot run leaves a file with the reason."""
    console = Console()
    console.say(f"scene {scene.name}")
    apply_output = compose_scene(scene, run.work(scene), run.options, device=run.device, console=console)
    for method in run.methods:
        out, reason = run.measured(scene, method), run.not_run_file(scene, method)
        reason.unlink(missing_ok=True)
        try:
            result, seconds = None, {}
            if method.pictures is None:
                settings = MethodSettings(run.weights, run.harmonizer_weights, run.device)
                result, seconds = run_method(method, apply_output, settings, console)
            shown = None if method.pictures is None else method.pictures / scene.name
            step = MeasureMethod(
                scene.truth, scene.target, apply_output.target, out, result, shown, run.weights, lpips, run.device
            )
            perform_if_stale(step, console)
            times = {**({} if method.pictures else apply_output.seconds), **seconds}
            run.seconds_file(scene, method).write_text(json.dumps(times))
        except ValueError as error:
            reason.parent.mkdir(parents=True, exist_ok=True)
            reason.write_text(str(error))


def unmeasurable_metrics(folder: Path | None) -> dict[str, str]:
    """The metrics whose weights are missing, with the reason."""
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
