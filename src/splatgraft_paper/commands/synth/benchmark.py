"""The command `synth benchmark`: benchmark scenes with ground truth, rendered with Blender."""

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal

from splatgraft.project.folder_lock import locked
from splatgraft.project.step import Positional
from splatgraft.runtime.console import Console
from splatgraft.runtime.workers import Task
from splatgraft_paper.benchmark.true_light_file import TRUE_LIGHT_FILE, write_true_light
from splatgraft_paper.synthesis import benchmark
from splatgraft_paper.synthesis.jobs import copy_shared_takes, render_job
from splatgraft_paper.synthesis.rendered_data import RenderWorkers, read_render_size, write_failures


@dataclass(frozen=True)
class SynthBenchmark:
    """Render the benchmark scenes with ground truth; a killed run is continued."""

    out: Positional
    """Folder for one folder per scene."""
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
    workers: RenderWorkers = field(default_factory=RenderWorkers)

    def execute(self, console: Console) -> int:
        """Render what is missing, write the scenes as captures and check them; 1 where one failed."""
        chosen, size = self._chosen(), self._size()
        python = self.workers.python(console)
        with locked(self.out):
            failures = []
            # pictures that several rotations of one object share are rendered once, with the first of them
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
                failures += self.workers.run(tasks, console) if tasks else []
            for which in chosen:
                target, source = benchmark.plan(which, size)
                if target.is_done(self._folders(which)[0]) and source.is_done(self._folders(which)[1]):
                    failures += self._gather(which, console)
            write_failures(self.out, failures, console)
        return 1 if failures else 0

    def _take_over(self, which: benchmark.BenchmarkScene, size: benchmark.BenchmarkSize) -> None:
        for twin in benchmark.scenes_with_shared_renders(which):
            ours, theirs = benchmark.plan(which, size), benchmark.plan(twin, size)
            for job, folder, elder, there in zip(ours, self._folders(which), theirs, self._folders(twin), strict=True):
                if not job.is_done(folder):
                    copy_shared_takes(job, folder, elder, there)

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
        named = benchmark.BenchmarkSize.named(self.size)
        pixels = self.pixels or f"{named.render.width}x{named.render.height}"
        render = read_render_size(pixels, self.samples or named.render.samples)
        return benchmark.BenchmarkSize(render, self.views or named.views)


COMMAND = SynthBenchmark
