"""The command `paper reproduce`: from rendered pairs to the paper's tables, in stages that a killed run continues.

A stage is one command of this software, with its results in OUT/NAME; each of these commands continues after a kill.
OUT/stages/NAME/step.json records a finished stage, as for the steps of a project. If a command or an earlier stage
changes, a stage is stale, and its command runs again on the results that are there.
"""

import gc
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

from splatgraft.cli import main
from splatgraft.project.record import STEP_FILE, Job, why_stale
from splatgraft.project.step import Positional, locked, replacing
from splatgraft.runtime.console import Console
from splatgraft.runtime.settings import read_toml
from splatgraft_paper.tables.layout import find_scenes
from splatgraft_paper.training.generate import RelightingOptions, read_orida
from splatgraft_paper.training.recipes import option_words


@dataclass(frozen=True)
class Stage:
    """One command and its requirements."""

    name: str
    after: str
    """Names of the stages whose results it reads."""
    hours: str
    """Time and its source."""
    disk: int
    """Results and downloads, GB."""
    command: str
    """Arguments of `splatgraft paper`, with names of files in braces."""
    gpu: int = 0
    """GPU memory, GB; that of a training is in its own plan."""


# Disk: a picture of 704x496 has 0.38 MB (1.1 bytes a pixel in data/benchmark), one of the object alone 0.05 MB, its
# latents 0.17 MB; a training's disk is that of `TrainingMemory` and its latents.
_HARMONIZER = "48 on 4 H100 (the paper)"
_OUT, _PAIRS = "{out}", "--pairs {pairs}"
_GENERATED, _ORIDA = f"--generated {_OUT}/generated", f"--orida {_OUT}/orida"
_TRAIN = f"train flux {_OUT}/NAME --recipe NAME"
_RELIT = "--lights {lights} --each {each} --relighter {relighter} {renderer}"
_NO_FIGURE = "no figure exists"
STAGES = (
    Stage("pairs", "", "1,200 of one core (Blender), half or twice that", 4, "synth pairs {pairs} --paper {blender}"),
    Stage("embed-flux", "", "minutes", 10, "train embed"),
    Stage("embed-removal", "", "minutes", 2, "train embed --kind stable-diffusion"),
    Stage("removal", "pairs embed-removal", _NO_FIGURE, 40, f"train removal {_OUT}/removal --recipe removal {_PAIRS}"),
    Stage(
        "generated", "removal", _NO_FIGURE, 39,
        f"synth generated {_OUT}/generated --removal {_OUT}/removal/model {_RELIT}",
        gpu=36,  # FLUX and its text encoders in 16 bits
    ),
    Stage("orida", "", _NO_FIGURE, 5, f"synth orida {_OUT}/orida --orida {{orida}} {_RELIT}"),
    Stage("paper", "pairs generated orida embed-flux", _HARMONIZER, 490, f"{_TRAIN} {_PAIRS} {_GENERATED} {_ORIDA}"),
    Stage("without-blender", "generated orida embed-flux", _HARMONIZER, 480, f"{_TRAIN} {_GENERATED} {_ORIDA}"),
    Stage("without-flux", "pairs orida embed-flux", _HARMONIZER, 490, f"{_TRAIN} {_PAIRS} {_ORIDA}"),
    Stage("without-orida", "pairs generated embed-flux", _HARMONIZER, 490, f"{_TRAIN} {_PAIRS} {_GENERATED}"),
    # 25 scenes of 133 minutes, most of it the updates; Table 3 has 13,000 pictures of 3.8 s; 18 pictures a view
    Stage(
        "tables", "paper without-blender without-flux without-orida", "70 on one H100 (the paper's times)", 40,
        f"tables --data {{data}} --out {_OUT}/tables --harmonizer-weights {_OUT}/paper/model --models "
        f"paper={_OUT}/paper/model without-blender={_OUT}/without-blender/model "
        f"without-flux={_OUT}/without-flux/model without-orida={_OUT}/without-orida/model "
        f"{_PAIRS} {_GENERATED} {_ORIDA} {{metrics}}",
        gpu=25,  # measured for a harmoniser of FLUX's size, docs/results.md
    ),
)  # fmt: skip
TRAININGS = "training"
"""Name of the table in --settings for all trainings of the harmoniser."""
_PACKAGES = ("diffusers", "accelerate", "peft", "transformers", "onnxruntime")


@dataclass(frozen=True)
class Reproduce:
    """Make the data, the models and the tables of the paper; a killed run continues in the stage where it was."""

    out: Positional
    """Folder of all stages' results."""
    data: Path
    """Folder of the authors' published data set, for the tables."""
    orida: Path
    """Folder of ORIDa with index.csv (see `paper synth orida`)."""
    relighting: RelightingOptions = field(default_factory=RelightingOptions)
    pairs: Path | None = None
    """Folder of pairs that `paper synth pairs` rendered before; by default they are rendered."""
    blender_python: Path | None = None
    """Python 3.11 with bpy; default: the running interpreter."""
    metric_weights: Path | None = None
    """Folder with the weights of LPIPS and Inception; default: torch hub's cache."""
    settings: Path | None = None
    """A .toml of further options of the stages' commands, in a table per stage, and [training] for all harmonisers."""
    plan: bool = False
    """Check all inputs and print the stages with their hours, disk and memory, but run none."""

    def execute(self, console: Console) -> int:
        """Run the stages that are stale."""
        # all inputs are looked at first, because the first stage that needs one may be days away
        find_scenes(self.data)
        read_orida(self.orida)
        self.relighting.open(0)
        if missing := [name for name in _PACKAGES if find_spec(name) is None]:
            raise ValueError(f"{missing[0]}: expected a package, found none; pip install 'splatgraft[paper]'")
        self.out.mkdir(parents=True, exist_ok=True)
        with locked(self.out):
            jobs = self.jobs()
            self._say_plan(jobs, console)
            for name, job in jobs.items() if not self.plan else ():
                if not _is_stale(job):
                    continue
                words = self.words(name)
                console.say(f"stage {name}: splatgraft {shlex.join(words)}")
                with replacing(job):
                    self._run(name, words)
                gc.collect()
                torch.cuda.empty_cache()
        if not self.plan:
            console.result(self.out / "tables" / "index.html")
        return 0

    def jobs(self) -> dict[str, Job]:
        """Describe the stages by name, for their records; the folder of results may move, so it is named OUT."""
        names = [stage.name for stage in STAGES if stage.name != "pairs" or self.pairs is None]
        if unknown := sorted(set(self._given) - {TRAININGS, *names}):
            raise ValueError(
                f"{self.settings}: expected tables among {TRAININGS}, {', '.join(names)}; found {unknown[0]}"
            )
        jobs: dict[str, Job] = {}
        for stage in STAGES:
            if stage.name in names:
                before = tuple(jobs[name].folder / STEP_FILE for name in stage.after.split() if name in jobs)
                words = replace(self, out=Path("OUT")).words(stage.name)
                jobs[stage.name] = Job("stage", self.out / "stages" / stage.name, {"stages": before}, {"words": words})
        return jobs

    def words(self, name: str) -> list[str]:
        """List the arguments of a stage's command; those of --settings come last and replace others."""
        stage = next(stage for stage in STAGES if stage.name == name)
        relit = self.relighting
        renderer = {"renderer": relit.renderer or False, "renderer-python": relit.renderer_python or False}
        lists = {
            "{renderer}": option_words(renderer),
            "{blender}": option_words({"blender-python": self.blender_python or False}),
            "{metrics}": option_words({"weights": self.metric_weights or False}),
        }
        paths = {"out": self.out, "data": self.data, "orida": self.orida, "pairs": self.pairs or self.out / "pairs"}
        texts = {"lights": relit.lights, "each": relit.each, "relighter": relit.relighter, **paths}
        words = ["paper"]
        for word in stage.command.split():
            words += lists[word] if word in lists else [word.replace("NAME", name).format(**texts)]
        shared = self._given.get(TRAININGS, {}) if stage.command.startswith(_TRAIN) else {}
        return [*words, *option_words({**shared, **self._given.get(name, {})})]

    @property
    def _given(self) -> Mapping[str, Mapping[str, Any]]:
        return {} if self.settings is None else read_toml(self.settings)

    def _say_plan(self, jobs: Mapping[str, Job], console: Console) -> None:
        """Print the stages, and the plans of the trainings to come, which are refused if they cannot fit."""
        needed = 0
        for stage in STAGES:
            if stage.name not in jobs:
                continue
            stale = _is_stale(jobs[stage.name])
            needed += stage.disk * stale
            state = "to do" if stale else "done"
            gpu = f", {stage.gpu} GB of GPU memory" if stage.gpu else ""
            console.say(f"{stage.name:<16} {state:<6} {stage.disk:>4} GB of disk{gpu}; hours: {stage.hours}")
            if self.plan:
                console.say(f"    splatgraft {shlex.join(self.words(stage.name))}")
            if stale and stage.command.startswith("train") and "--recipe" in stage.command:
                self._run(stage.name, [*self.words(stage.name), "--plan"])
        free = shutil.disk_usage(self.out).free / 1e9
        console.say(f"disk: about {needed:,} GB to come at the paper's sizes, {free:,.0f} GB free at {self.out}")

    def _run(self, name: str, words: list[str]) -> None:
        """Run a command, on several GPUs by torchrun."""
        gpus = torch.cuda.device_count()
        if words[1:3] == ["train", "flux"] and gpus > 1 and "--plan" not in words:
            launcher = f"-m torch.distributed.run --standalone --nproc-per-node {gpus} -m splatgraft".split()
            status = subprocess.run([sys.executable, *launcher, *words], check=False).returncode
        else:
            status = main(words)
        if status == 130:
            raise KeyboardInterrupt
        if status:
            raise ValueError(f"stage {name}: expected its command to succeed, found exit status {status}; see above")


def _is_stale(job: Job) -> bool:
    """Tell whether a stage is to run; it is also while an earlier stage has no record yet."""
    return not all(path.is_file() for files in job.inputs.values() for path in files) or why_stale(job) is not None
