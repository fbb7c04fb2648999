"""The command `paper tables`: the paper's tables on the authors' data set, with published and measured numbers."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import cast

import torch

from splatgraft.fitting.perceptual_losses import VGG_FILE, is_published
from splatgraft.project.step import Device, locked
from splatgraft.reconstruction import ReconstructOptions
from splatgraft.runtime.console import Console
from splatgraft_paper.benchmark.image_features import INCEPTION_FILE
from splatgraft_paper.benchmark.methods import Method, MethodSettings
from splatgraft_paper.benchmark.run import unmeasurable_metrics
from splatgraft_paper.tables.data_ablation import DataAblation, measure_models
from splatgraft_paper.tables.layout import NAMES, PaperScene, find_scenes
from splatgraft_paper.tables.our_pictures import OurRun
from splatgraft_paper.tables.paper_numbers import published_name
from splatgraft_paper.tables.report import write_paper_report
from splatgraft_paper.tables.run import PaperRun, perform_paper_run
from splatgraft_paper.training.pairs import DataOptions

PAPERS_OWN = "off+flux/paper"
"""Name of our implementation of the paper's method: copy-paste, FLUX, 10,000 steps of Adam on LPIPS."""


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
        "copy-paste", "transfer", PAPERS_OWN,
        f"{PAPERS_OWN}-l1-dssim", f"{PAPERS_OWN}@linear", f"{PAPERS_OWN}@geometric",
    )  # fmt: skip
    """Our methods to run, by the names of `paper benchmark`; off+flux/paper is the paper's own."""
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
    iterations_of_consolidation: int = 10_000
    """Steps of the paper's consolidation."""
    options: ReconstructOptions = field(default_factory=lambda: ReconstructOptions(quality="draft", device="auto"))

    def execute(self, console: Console) -> int:
        """Measure and run what is missing and write the tables; return 1 if a method failed or nothing was measured."""
        scenes = self._chosen(find_scenes(self.data, _named(self.names)))
        missing_metrics = unmeasurable_metrics(self.weights)
        for name, reason in missing_metrics.items():
            console.say(f"{name}: not measured: {reason}")
        methods = tuple(Method.parse(text) for text in self.methods)
        settings = MethodSettings(
            self.weights, self.harmonizer_weights, cast(Device, self.options.device), self.iterations_of_consolidation
        )
        run = PaperRun(
            OurRun(self.out, self.options, settings),
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
            )
            page = write_paper_report(self.out, found)
        console.result(page)
        nothing = not found.measured and not found.by_model and any(scene.kind != "real" for scene in scenes)
        failed = not self.measure_only and any(method in found.ours for _, method in found.missing)
        for (scene, method), reason in found.missing.items() if nothing or failed else ():
            console.say(f"{scene}, {method}: {reason}")
        return 1 if failed or nothing else 0

    def _by_model(self, missing: Mapping[str, str], console: Console) -> dict[str, dict[str, float]]:
        """Measure the models of Table 3; empty without --models."""
        if not self.models:
            return {}
        named = {name: Path(folder) for name, found, folder in (text.partition("=") for text in self.models) if found}
        if len(named) < len(self.models) or not all(folder.is_dir() for folder in named.values()):
            raise ValueError(f"--models: expected NAME=FOLDER with existing folders, found {' '.join(self.models)}")
        metrics = {
            "psnr",
            "ssim",
            *(name for name, of in (("lpips", "lpips"), ("fid", "fid and kid")) if of not in missing),
        }
        ablation = DataAblation(
            {published_name(name): folder for name, folder in named.items()},
            DataOptions(self.pairs, self.generated, self.orida, size=self.pairs_size),
            weights=self.weights,
            metrics=frozenset(metrics),
            device=cast(Device, self.options.device),
        )
        return measure_models(ablation, console)

    def _chosen(self, scenes: tuple[PaperScene, ...]) -> tuple[PaperScene, ...]:
        names = [scene.name for scene in scenes]
        if unknown := [name for name in self.only if name not in names]:
            raise ValueError(f"--only: expected names among {', '.join(names)}; found {unknown[0]}")
        return tuple(scene for scene in scenes if not self.only or scene.name in self.only)


def _named(names: tuple[str, ...]) -> dict[str, str]:
    """Parse --names."""
    named = dict((text.partition("=")[0], text.partition("=")[2]) for text in names)
    if not named.keys() <= NAMES.keys() or not all(named.values()):
        raise ValueError(f"--names: expected ROLE=NAME with ROLE of {', '.join(NAMES)}, found {' '.join(names)}")
    return named


def _stand_ins(weights: Path | None, missing: Mapping[str, str]) -> frozenset[str]:
    """List the metrics whose weights differ from the published ones."""
    folder = weights or Path(torch.hub.get_dir()) / "checkpoints"
    files = {
        "lpips": ("lpips", VGG_FILE),
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
