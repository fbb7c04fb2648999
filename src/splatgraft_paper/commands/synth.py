"""The commands `paper synth ...` that render data: pairs, benchmark scenes and spheres."""

import os
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal

from splatgraft.project.step import Positional, locked
from splatgraft.runtime.console import Console
from splatgraft.runtime.workers import Task
from splatgraft_paper.benchmark.true_light import TRUE_LIGHT_FILE, write_true_light
from splatgraft_paper.synthesis import benchmark, pairs
from splatgraft_paper.synthesis.jobs import (
    RenderWorkers,
    parse_image_size,
    read_render_size,
    render_job,
    write_failures,
)
from splatgraft_paper.synthesis.places import SUPPLIED_MAPS
from splatgraft_paper.training.pairs import RECORD_FILE, write_relit_manifest, write_sample
from splatgraft_paper.training.spheres import render_spheres


@dataclass(frozen=True)
class SynthPairs:
    """Render training pairs for a harmoniser; a killed run is continued."""

    out: Positional
    """Folder for one folder per scene, manifest.jsonl and, after failures, failures.txt."""
    scenes: int = 60
    """Number of scenes; each gives 5 cameras x objects x lights pairs."""
    first: int = 0
    """Number of the first scene, so that several machines can share the work without Ray."""
    size: str = "704x496"
    """Pixels of a picture, WIDTHxHEIGHT."""
    samples: int = 128
    """Light paths per pixel; with the denoiser 16 are enough for small sizes."""
    objects: int = 2
    """Objects per scene; the background is rendered once for all."""
    lights: int = 3
    """Environment maps per object."""
    paper: bool = False
    """Render the paper's number: 190 scenes with 2 objects and 27 lights, 1,900 targets and 51,300 composites."""
    seed: int = 0
    """Seed of all random choices."""
    maps: Path | None = None
    """Folder with .hdr and .exr environment maps; default: the maps that come with Blender."""
    workers: RenderWorkers = field(default_factory=RenderWorkers)

    def execute(self, console: Console) -> int:
        """Render missing pictures and check everything; return 1 if a scene failed or a pair is faulty."""
        scenes = pairs.PAPER_SCENES if self.paper else self.scenes
        plan = pairs.PairPlan(
            objects=2 if self.paper else self.objects,
            lights=pairs.PAPER_LIGHTS if self.paper else self.lights,
            seed=self.seed,
            size=read_render_size(self.size, self.samples),
            maps=SUPPLIED_MAPS if self.maps is None else _maps(self.maps),
        )
        hours, cores = scenes * plan.cpu_seconds / 3600, os.cpu_count() or 1
        console.say(
            f"pairs: {scenes * plan.targets:,} targets, {scenes * plan.composites:,} composites (the paper: 1,900 and "
            f"51,000, --paper); about {hours:.0f} hours of one core, {hours / cores:.0f} on the {cores} here, and on a "
            "Ray cluster (--ray) by the number of its cores"
        )
        python = self.workers.python(console)
        with locked(self.out):
            tasks, folders, failures = [], [], []
            for number in range(self.first, self.first + scenes):
                try:
                    job = pairs.plan(plan, number)
                except ValueError as error:
                    failures.append(f"scene {number}: {error}")
                    continue
                folders.append(self.out / pairs.job_folder_name(job))
                tasks.append(Task(folders[-1].name, partial(render_job, job, folders[-1], python)))
            failures += self.workers.run(tasks, console)
            return pairs.check_pairs(self.out, failures, console)


def _maps(folder: Path) -> tuple[str, ...]:
    found = sorted(str(path.resolve()) for path in folder.rglob("*") if path.suffix.lower() in (".hdr", ".exr"))
    if not found:
        raise ValueError(f"--maps {folder}: expected files that end in .hdr or .exr, found none")
    return tuple(found)


@dataclass(frozen=True)
class SynthBenchmark:
    """Render the benchmark scenes with ground truth; a killed run is continued."""

    out: Positional
    """Folder for one folder per scene."""
    size: Literal["small", "paper"] = "small"
    """small: 352x248, 40 views, 16 samples. paper: 704x496, 200 views, 128 samples."""
    scenes: tuple[str, ...] = ()
    """Names of scenes; default: all nine."""
    rotations: bool = False
    """Add three scenes with the object at three rotations (NAME_p0, NAME_p1, NAME_p2)."""
    views: int | None = None
    """Views per capture; default: that of --size."""
    pixels: str | None = None
    """Pixels of a picture, WIDTHxHEIGHT; default: that of --size."""
    samples: int | None = None
    """Light paths per pixel; default: that of --size."""
    workers: RenderWorkers = field(default_factory=RenderWorkers)

    def execute(self, console: Console) -> int:
        """Render missing files, write the scenes as captures and check them; return 1 if one failed."""
        size = self._size()
        planned = {which: list(zip(benchmark.plan(which, size), self._folders(which), strict=True))
                   for which in self._chosen()}  # fmt: skip
        python = self.workers.python(console)
        with locked(self.out):
            jobs = [one for both in planned.values() for one in both]
            tasks = [Task(folder.name, partial(render_job, job, folder, python)) for job, folder in jobs]
            failures = self.workers.run(tasks, console)
            for which, both in planned.items():
                if all(job.is_done(folder) for job, folder in both):
                    failures += self._gather(which, console)
            write_failures(self.out, failures, console)
        return 1 if failures else 0

    def _gather(self, which: benchmark.BenchmarkScene, console: Console) -> list[str]:
        out = self.out / which.name
        if not (out / TRUE_LIGHT_FILE).is_file():
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
        named = benchmark.SIZES[self.size]
        pixels = self.pixels or f"{named.render.width}x{named.render.height}"
        render = read_render_size(pixels, self.samples or named.render.samples)
        return benchmark.BenchmarkSize(render, self.views or named.views)


@dataclass(frozen=True)
class SynthSpheres:
    """Render pairs of two balls on a floor without Blender, a fifth of a second each; a killed run is continued."""

    out: Positional
    """Folder for one folder per scene and manifest.jsonl."""
    scenes: int = 400
    """Number of scenes."""
    lights: int = 3
    """Number of other suns per scene."""
    size: str = "64x48"
    """Pixels, WIDTHxHEIGHT."""
    seed: int = 0
    """Seed of places, colours and suns."""

    def execute(self, console: Console) -> int:
        """Render the missing scenes."""
        width, height = parse_image_size(self.size)
        self.out.mkdir(parents=True, exist_ok=True)
        with locked(self.out), console.bar("spheres") as progress:
            for number in range(self.scenes):
                folder = self.out / f"{number:05d}"
                if not (folder / RECORD_FILE).is_file():
                    seed = self.seed * 1_000_003 + number
                    sample = render_spheres(seed, width=width, height=height, lights=self.lights)
                    write_sample(folder, sample, {"group": folder.name, "licence": "own render"})
                progress(number + 1, self.scenes, folder.name)
            count = write_relit_manifest(self.out)
        console.say(f"{count} scenes with {self.lights} pairs each")
        console.result(self.out / "manifest.jsonl")
        return 0
