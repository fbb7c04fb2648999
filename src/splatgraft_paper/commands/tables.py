"""The command `paper tables`: the paper's tables on the authors' data set, with published and measured numbers."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import cast

import torch

from splatgraft.fitting.perceptual_losses import VGG_FILE, is_published
from splatgraft.project.step import Device, locked
from splatgraft.reconstruction import ReconstructOptions
from splatgraft.runtime.console import Console
from splatgraft.runtime.process import source_commit
from splatgraft_paper.benchmark.image_features import INCEPTION_FILE
from splatgraft_paper.benchmark.methods import Method, MethodSettings
from splatgraft_paper.benchmark.run import unmeasurable_metrics
from splatgraft_paper.benchmark.scene import CompositionOptions
from splatgraft_paper.tables.data_ablation import DataAblation, MeasuredModels, measure_models
from splatgraft_paper.tables.layout import PaperScene, find_scenes, named_folders
from splatgraft_paper.tables.measure_pictures import MetricOptions
from splatgraft_paper.tables.our_pictures import OurRun
from splatgraft_paper.tables.paper_numbers import published_name
from splatgraft_paper.tables.report import write_paper_report
from splatgraft_paper.tables.run import PaperRun, perform_paper_run
from splatgraft_paper.training.pairs import DataOptions


@dataclass(frozen=True)
class EvaluatePaper:
    """Measure the authors' published pictures, run ours on their scenes, and write the paper's tables."""

    data: Path
    """Folder of the published data set, which contains data_3d/ or dot3d_data/."""
    out: Path = Path("paper")
    """Folder for index.html, paper.md, paper.json, figures/ and all results."""
    measure_only: bool = False
    """Measure existing pictures and run no method; needs no GPU and no weights."""
    methods: tuple[str, ...] = (
        "copy-paste", "transfer", "paper", "paper/paper-l1-dssim", "paper@linear", "paper@geometric",
    )  # fmt: skip
    """Methods to run, by the names of `paper benchmark`: `paper` is the paper's pipeline whole, `transfer` is ours."""
    only: tuple[str, ...] = ()
    """Names of scenes; default: all."""
    names: tuple[str, ...] = ()
    """ROLE=NAME of what has another name below a scene, such as truth=GT or cameras=sparse/0; ROLE is truth,
    background, composite, masks, object_scene, target_scene, cameras, placement or results (below METHOD/SCENE)."""
    all_views: bool = False
    """Measure all views, not only the held-out ones."""
    weights: Path | None = None
    """Folder with the weights of LPIPS and Inception; default: torch hub's cache."""
    harmonizer_weights: str | None = None
    """Weights of the image model that the methods name: folder, file or hub id, as `harmonize --weights` takes them."""
    models: tuple[str, ...] = ()
    """NAME=FOLDER of harmonisers for Table 3; NAME is the recipe (paper, without-blender, ..) or another name."""
    pairs: tuple[str, ...] = ()
    """Folders of rendered pairs for Table 3, those of `paper train flux`, which holds the test split out."""
    generated: tuple[str, ...] = ()
    """Folders of generated pairs for Table 3."""
    orida: tuple[str, ...] = ()
    """Folders of ORIDa's pairs for Table 3."""
    pairs_size: str = "704x496"
    """Pixels of a pair, WIDTHxHEIGHT, the size at which the models were trained."""
    birefnet: Path | None = None
    """BiRefNet's .onnx file for the method paper; fetched once from the hub if not given."""
    iterations_of_consolidation: int = 10_000
    """Steps of the paper's consolidation."""
    options: ReconstructOptions = field(default_factory=lambda: ReconstructOptions(quality="draft", device="auto"))

    def execute(self, console: Console) -> int:
        """Run and measure missing results and write the tables; return 1 if a method failed or nothing was measured."""
        scenes = self._chosen(find_scenes(self.data, named_folders(self.names)))
        missing_metrics = unmeasurable_metrics(self.weights)
        for name, reason in missing_metrics.items():
            console.say(f"{name}: not measured: {reason}")
        methods = tuple(Method.parse(text) for text in self.methods)
        settings = MethodSettings(
            self.weights, self.harmonizer_weights, cast(Device, self.options.device), self.iterations_of_consolidation
        )
        run = PaperRun(
            OurRun(self.out, CompositionOptions(self.options, settings.device, self.birefnet), settings),
            scenes,
            methods,
            measure_only=self.measure_only,
            all_views=self.all_views,
        )
        with locked(self.out):
            found = perform_paper_run(run, missing_metrics, console)
            found = replace(
                found,
                by_model=self._by_model(missing_metrics, console),
                stand_ins=_stand_ins(self.weights, missing_metrics),
                device=_device_name(self.options.device),
                conditions=self._conditions(methods),
            )
            page = write_paper_report(self.out, found)
        console.result(page)
        nothing = not found.measured and not found.by_model.values and any(scene.kind != "real" for scene in scenes)
        failed = not self.measure_only and any(method in found.ours for _, method in found.missing)
        for (scene, method), reason in found.missing.items() if nothing or failed else ():
            console.say(f"{scene}, {method}: {reason}")
        return 1 if failed or nothing else 0

    def _conditions(self, methods: Sequence[Method]) -> str:
        """Describe the rows that are run here."""
        if self.measure_only:
            return f"Only pictures that were there are measured; commit {source_commit()}."
        parts = []
        if any(method.pipeline == "paper" for method in methods):
            steps = replace(self.options, quality="full").all_iterations
            parts.append(f"paper: quality full ({steps:,} steps), masks by BiRefNet, lifted by cross-entropy, pasted")
        if any(method.pipeline == "ours" for method in methods):
            steps = f"{self.options.quality} ({self.options.all_iterations:,} steps)"
            parts.append(f"ours: quality {steps}, the captures' masks, lifted in closed form, refitted and closed")
        place = f"on {_device_name(self.options.device)}, commit {source_commit()}"
        return f"Run here: {'; '.join([*parts, f'weights {self.harmonizer_weights or None}', place])}."

    def _by_model(self, missing: Mapping[str, str], console: Console) -> MeasuredModels:
        """Measure the models of Table 3; empty without --models."""
        if not self.models:
            return MeasuredModels({})
        named = {name: Path(folder) for name, found, folder in (text.partition("=") for text in self.models) if found}
        if len(named) < len(self.models) or not all(folder.is_dir() for folder in named.values()):
            raise ValueError(f"--models: expected NAME=FOLDER with existing folders, found {' '.join(self.models)}")
        device = cast(Device, self.options.device)
        ablation = DataAblation(
            {published_name(name): folder for name, folder in named.items()},
            DataOptions(self.pairs, self.generated, self.orida, size=self.pairs_size),
            self.out / "models",
            MetricOptions(self.weights, "lpips" not in missing, "fid and kid" not in missing, device),
            device,
        )
        return measure_models(ablation, console)

    def _chosen(self, scenes: tuple[PaperScene, ...]) -> tuple[PaperScene, ...]:
        names = [scene.name for scene in scenes]
        if unknown := [name for name in self.only if name not in names]:
            raise ValueError(f"--only: expected names among {', '.join(names)}; found {unknown[0]}")
        return tuple(scene for scene in scenes if not self.only or scene.name in self.only)


def _stand_ins(weights: Path | None, missing: Mapping[str, str]) -> frozenset[str]:
    """List the metrics whose weights differ from the published ones."""
    folder = weights or Path(torch.hub.get_dir()) / "checkpoints"
    files = {
        "lpips": ("lpips", VGG_FILE),
        "lpips01": ("lpips", VGG_FILE),
        "fid": ("fid and kid", INCEPTION_FILE),
        "kid": ("fid and kid", INCEPTION_FILE),
    }
    return frozenset(
        name for name, (key, file) in files.items() if key not in missing and not is_published(folder / file)
    )


def _device_name(device: str) -> str:
    if device != "cpu" and torch.cuda.is_available():
        return torch.cuda.get_device_name()
    return f"{os.cpu_count()} cores"
