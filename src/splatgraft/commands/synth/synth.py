"""The commands `synth pairs`, `synth benchmark`, `synth check` and `synth sheet`: scenes with a known truth."""

import sys
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro

from splatgraft.core.images import read_rgb, resize, write_image
from splatgraft.project.folder_lock import locked
from splatgraft.project.step import Positional
from splatgraft.runtime.console import Console
from splatgraft.runtime.workers import Task, run_tasks
from splatgraft.synthesis import benchmark, pairs
from splatgraft.synthesis.jobs import Job, RenderSize, check_blender, copy_shared_takes, render_job
from splatgraft.synthesis.outdoors import SUPPLIED_MAPS
from splatgraft.workflow.benchmark.true_light_file import write_true_light

FAILURES_FILE = "failures.txt"
_MAPS = (".hdr", ".exr")
_MODELS = (".glb", ".gltf", ".obj", ".blend")


@dataclass(frozen=True)
class Workers:
    """Where pictures are rendered."""

    blender_python: Path | None = None
    """A Python 3.11 that has bpy; this one where not given."""
    processes: int = 2
    """Blender processes at a time on this machine."""
    ray: str | None = None
    """Address of a Ray cluster whose machines all see the folder; `local` for one of this machine's cores."""

    def python(self, console: Console) -> Path:
        """The interpreter, tried out.

        Raises: ValueError where it has no bpy.
        """
        found = self.blender_python or Path(sys.executable)
        console.say(f"blender: {check_blender(found)} in {found}")
        return found

    def run(self, tasks: list[Task], out: Path, console: Console) -> list[str]:
        """Do the tasks; what failed is written beside the results and said."""
        with console.bar("render") as progress:
            return run_tasks(tasks, at_once=self.processes, ray_address=self.ray, progress=progress)


@dataclass(frozen=True)
class Pairs:
    """Render training pairs for a harmoniser; goes on where it was killed."""

    out: Positional
    """Folder for one folder a scene, manifest.jsonl and, where something failed, failures.txt."""
    scenes: int = 60
    """How many scenes; each gives 5 cameras x objects x lights pairs."""
    first: int = 0
    """Number of the first scene, so that several machines can share the work without Ray."""
    size: str = "704x496"
    """Pixels of a picture, WIDTHxHEIGHT."""
    samples: int = 128
    """Light paths per pixel; 16 are enough for small sizes, the denoiser does the rest."""
    objects: int = 2
    """Per scene; the background is rendered once for all."""
    lights: int = 3
    """Environment maps per object."""
    seed: int = 0
    """Everything follows from it."""
    maps: Path | None = None
    """Folder with .hdr and .exr environment maps; those that come with Blender where not given."""
    models: Path | None = None
    """Folder with .glb, .gltf, .obj and .blend models that take turns with generated objects."""
    workers: Workers = field(default_factory=Workers)

    def execute(self, console: Console) -> int:
        """Render what is missing, check everything; 1 where a scene failed or a pair is faulty."""
        plan = pairs.PairPlan(
            scenes=self.scenes,
            objects=self.objects,
            lights=self.lights,
            seed=self.seed,
            size=_render_size(self.size, self.samples),
            maps=_files(self.maps, _MAPS, "--maps") or SUPPLIED_MAPS,
            models=_files(self.models, _MODELS, "--models"),
        )
        python = self.workers.python(console)
        with locked(self.out):
            tasks, folders, failures = [], [], []
            for number in range(self.first, self.first + self.scenes):
                try:
                    job = pairs.plan(plan, number)
                except ValueError as error:
                    failures.append(f"scene {number}: {error}")
                    continue
                folders.append(self.out / pairs.job_folder_name(job))
                tasks.append(Task(folders[-1].name, partial(render_job, job, folders[-1], python)))
            failures += self.workers.run(tasks, self.out, console)
            return _check_pairs(self.out, failures, console)


@dataclass(frozen=True)
class Benchmark:
    """Render the benchmark scenes with ground truth; goes on where it was killed."""

    out: Positional
    """Folder for one folder a scene."""
    size: Literal["small", "paper"] = "small"
    """small: 352x248, 40 views, 16 samples. paper: 704x496, 200 views, 128 samples."""
    scenes: tuple[str, ...] = ()
    """Names of scenes; all nine where none is given."""
    rotations: bool = False
    """Also the three scenes with the object at three rotations (name_p0, name_p1, name_p2)."""
    views: int | None = None
    """Another number of views per capture."""
    pixels: str | None = None
    """Another size of pictures, WIDTHxHEIGHT."""
    samples: int | None = None
    """Another number of light paths per pixel."""
    workers: Workers = field(default_factory=Workers)

    def execute(self, console: Console) -> int:
        """Render what is missing, lay scenes out as captures and check them; 1 where one failed."""
        chosen, size = self._chosen(), self._size()
        python = self.workers.python(console)
        with locked(self.out):
            failures = []
            # what several turns of one object share is rendered once: with the first of them
            first = [
                which
                for i, which in enumerate(chosen)
                if not set(chosen[:i]) & set(benchmark.scenes_with_shared_renders(which))
            ]
            for wave in (first, [which for which in chosen if which not in first]):
                tasks = []
                for which in wave:
                    self._take_over(which, size)
                    for job, folder in zip(benchmark.plan(which, size), self._folders(which), strict=True):
                        tasks.append(Task(folder.name, partial(render_job, job, folder, python)))
                failures += self.workers.run(tasks, self.out, console) if tasks else []
            for which in chosen:
                target, source = benchmark.plan(which, size)
                if _done(target, self._folders(which)[0]) and _done(source, self._folders(which)[1]):
                    failures += self._gather(which, console)
            _write_failures(self.out, failures, console)
        return 1 if failures else 0

    def _take_over(self, which: benchmark.BenchmarkScene, size: benchmark.BenchmarkSize) -> None:
        for twin in benchmark.scenes_with_shared_renders(which):
            ours, theirs = benchmark.plan(which, size), benchmark.plan(twin, size)
            for job, folder, elder, there in zip(ours, self._folders(which), theirs, self._folders(twin), strict=True):
                if not job.is_done(folder):
                    copy_shared_takes(job, folder, elder, there)

    def _gather(self, which: benchmark.BenchmarkScene, console: Console) -> list[str]:
        out = self.out / which.name
        if not (out / "true_light.json").is_file():
            benchmark.gather(which, *self._folders(which), out)
            write_true_light(out)
        wrong = benchmark.find_defect(out)
        if wrong is None:
            console.result(out)
        return [wrong] if wrong else []

    def _folders(self, which: benchmark.BenchmarkScene) -> tuple[Path, Path]:
        return tuple(self.out / "renders" / f"{which.name}_{side}" for side in ("target", "source"))  # pyright: ignore

    def _chosen(self) -> list[benchmark.BenchmarkScene]:
        known = {scene.name: scene for scene in (*benchmark.SCENES, *benchmark.ROTATIONS)}
        if unknown := [name for name in self.scenes if name not in known]:
            raise ValueError(f"--scenes: expected names among {', '.join(known)}; found {unknown[0]}")
        names = self.scenes or [scene.name for scene in benchmark.SCENES]
        return [known[name] for name in names] + (list(benchmark.ROTATIONS) if self.rotations else [])

    def _size(self) -> benchmark.BenchmarkSize:
        named = benchmark.BenchmarkSize.named(self.size)
        pixels = self.pixels or f"{named.render.width}x{named.render.height}"
        render = _render_size(pixels, self.samples or named.render.samples)
        return benchmark.BenchmarkSize(render, self.views or named.views)


@dataclass(frozen=True)
class Check:
    """Look at every picture of a folder of pairs or of benchmark scenes, and say which are broken or empty."""

    out: Positional
    """What `synth pairs` or `synth benchmark` made."""

    def execute(self, console: Console) -> int:
        """Rewrite the manifest of pairs; 1 where something is faulty."""
        scenes = sorted(path.parent for path in self.out.glob("*/scene.json"))
        if not scenes:
            return _check_pairs(self.out, [], console)
        faults = [wrong for wrong in map(benchmark.find_defect, scenes) if wrong]
        console.say(f"{len(scenes) - len(faults)} of {len(scenes)} scenes are sound")
        _write_failures(self.out, faults, console)
        return 1 if faults else 0


@dataclass(frozen=True)
class Sheet:
    """One picture with all scenes of a folder, to look at."""

    out: Positional
    """What `synth pairs` or `synth benchmark` made."""
    picture: Path | None = None
    """Where to write it; sheet.png in the folder where not given."""
    columns: int = 6
    """Pictures side by side."""
    width: int = 240
    """Pixels of one picture."""

    def execute(self, console: Console) -> int:
        """Write the sheet."""
        paths = sorted(self.out.glob("*/object*/0002.png")) or sorted(self.out.glob("*/ground_truth/images/0002.png"))
        paths = [path for path in paths if "_light" not in path.parent.name]
        if not paths:
            raise ValueError(f"{self.out}: expected rendered pairs or benchmark scenes, found none")
        pictures = [read_rgb(path) for path in paths]
        height = round(self.width * pictures[0].shape[0] / pictures[0].shape[1])
        small = [resize(picture, self.width, height) for picture in pictures]
        small += [torch.ones(height, self.width, 3)] * (-len(small) % self.columns)
        rows = [torch.cat(small[i : i + self.columns], 1) for i in range(0, len(small), self.columns)]
        target = self.picture or self.out / "sheet.png"
        write_image(target, torch.cat(rows, 0))
        console.result(target)
        return 0


def _check_pairs(out: Path, failures: list[str], console: Console) -> int:
    """Write the manifest over all scenes that are there, and the list of what failed."""
    folders = sorted(path.parent for path in out.glob("*/job.json"))
    if not folders and not failures:
        raise ValueError(f"{out}: expected rendered pairs or benchmark scenes, found none")
    count, faults = pairs.write_manifest(out, folders)
    console.say(f"{count} sound pairs in {len(folders)} scenes; {len(failures)} scenes failed, {len(faults)} faults")
    _write_failures(out, [*failures, *faults], console)
    if folders:
        console.result(out / "manifest.jsonl")
    return 1 if failures or faults else 0


def _write_failures(out: Path, failures: list[str], console: Console) -> None:
    path = out / FAILURES_FILE
    path.unlink(missing_ok=True)
    if failures:
        path.write_text("\n".join(failures) + "\n")
        for failure in failures[:10]:
            console.say(failure)
        console.say(f"{len(failures)} failures, all in {path}")


def _done(job: Job, folder: Path) -> bool:
    return job.is_done(folder)


def _render_size(text: str, samples: int) -> RenderSize:
    parts = text.split("x")
    if len(parts) != 2 or not all(part.isdigit() and int(part) >= 16 for part in parts) or samples < 1:
        raise ValueError(
            f"--size, --samples: expected such as 704x496 and at least one sample, found {text}, {samples}"
        )
    return RenderSize(int(parts[0]), int(parts[1]), samples)


def _files(folder: Path | None, suffixes: tuple[str, ...], option: str) -> tuple[str, ...]:
    if folder is None:
        return ()
    found = sorted(str(path.resolve()) for path in folder.rglob("*") if path.suffix.lower() in suffixes)
    if not found:
        raise ValueError(f"{option} {folder}: expected files that end in {', '.join(suffixes)}, found none")
    return tuple(found)


COMMAND = Annotated[
    Annotated[Pairs, tyro.conf.subcommand("pairs")]
    | Annotated[Benchmark, tyro.conf.subcommand("benchmark")]
    | Annotated[Check, tyro.conf.subcommand("check")]
    | Annotated[Sheet, tyro.conf.subcommand("sheet")],
    tyro.conf.OmitSubcommandPrefixes,
]
