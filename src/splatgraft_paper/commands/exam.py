"""The command `paper exam`: the held-out benchmark of the light transfer, on synthetic scenes drawn from a number."""

import hashlib
import json
import shlex
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

import splatgraft
import splatgraft_paper.exam
from splatgraft.reconstruction import ReconstructOptions
from splatgraft.reconstruction.options import Quality
from splatgraft.runtime.console import Console
from splatgraft.runtime.files import atomic_write
from splatgraft.runtime.process import source_commit
from splatgraft_paper.exam.measure import ROWS, SceneResult, evaluate_scene
from splatgraft_paper.exam.scenes import SIZE, TRAINING_NUMBER, draw_scenes, read_scene, render_scene
from splatgraft_paper.exam.summary import summarize_light, summarize_row, summary_markdown
from splatgraft_paper.synthesis.benchmark import BenchmarkSize
from splatgraft_paper.synthesis.jobs import RenderWorkers, read_render_size
from splatgraft_paper.synthesis.places import KINDS


@dataclass(frozen=True)
class Exam:
    """Measure the light transfer on scenes drawn from a number, or on given scenes; a stopped run is continued.

    The number alone determines the scenes. Use each number once: whoever has looked at its scenes may tune to them.
    """

    number: Annotated[int | None, tyro.conf.Positional] = None
    """Number that the scenes' seeds are drawn from; 0 is for training and proves nothing."""
    scenes_from: Path | None = None
    """Folder of rendered scenes, instead of a number."""
    scenes: int | None = None
    """Number of scenes; default: 12 of a number, all of --scenes-from."""
    out: Path | None = None
    """Folder for scenes/, work/ (reconstructions), results/, pictures/, exam.md and exam.json; default:
    build/exam/NUMBER. A picture has columns of held-out views: pasted, transfer, transfer with all truth, truth."""
    work: Path | None = None
    """Folder of the reconstructions, which runs may share; default: OUT/work."""
    kinds: tuple[str, ...] = KINDS
    """Kinds of places that the scenes are drawn from."""
    views: int = SIZE.views
    """Views of each capture."""
    pixels: str = f"{SIZE.render.width}x{SIZE.render.height}"
    """Pixels of a picture, WIDTHxHEIGHT."""
    quality: Quality = "draft"
    """Quality of each reconstruction."""
    iterations: int | None = None
    """Steps of each reconstruction; default: 1000 for a draft, else those of the quality."""
    budget: int | None = None
    """Gaussians of each reconstruction; default: 20,000 for a draft, else those of the quality."""
    rows: tuple[str, ...] = tuple(row for row in ROWS if row != "3dgs-dr")
    """Rows of the table; 3dgs-dr is not in the default, because it fits two more scenes."""
    workers: RenderWorkers = field(default_factory=RenderWorkers)

    def execute(self, console: Console) -> int:
        """Render, measure and report; return 1 if a scene could not be made."""
        if (self.number is None) == (self.scenes_from is None):
            raise ValueError("exam: expected either a NUMBER or --scenes-from, found both or neither")
        rows = self._rows()
        out = self.out or Path("build") / "exam" / ("given" if self.number is None else str(self.number))
        results, failures = [], []
        for scene, make_folder in self._scene_folders(out, console):
            try:
                results.append(self._result(make_folder(), out, rows, console))
            except ValueError as error:
                failures.append(f"{scene}: {error}")
                console.say(failures[-1])
        self._write_report(out, rows, results, failures)
        console.result(out / "exam.md")
        return 1 if failures else 0

    def _rows(self) -> tuple[str, ...]:
        if unknown := [row for row in self.rows if row not in ROWS]:
            raise ValueError(f"--rows: expected names among {', '.join(ROWS)}; found {unknown[0]}")
        return tuple(row for row in ROWS if row in self.rows)

    @property
    def _options(self) -> ReconstructOptions:
        steps, most = (1000, 20_000) if self.quality == "draft" else (None, None)
        return ReconstructOptions(quality=self.quality, iterations=self.iterations or steps, budget=self.budget or most)

    @property
    def _size(self) -> BenchmarkSize:
        return BenchmarkSize(read_render_size(self.pixels, SIZE.render.samples), self.views)

    def _scene_folders(self, out: Path, console: Console) -> Iterator[tuple[str, partial[Path]]]:
        """Yield the name of each scene, and a function that renders its missing files and returns its folder."""
        if self.scenes_from is not None:
            folders = sorted(path.parent for path in self.scenes_from.glob("*/placement.json"))
            for folder in folders[: self.scenes]:
                yield folder.name, partial(Path, folder)
            return
        python = self.workers.python(console)
        assert self.number is not None
        if unknown := [kind for kind in self.kinds if kind not in KINDS]:
            raise ValueError(f"--kinds: expected names among {', '.join(KINDS)}; found {unknown[0]}")
        jobs, size = self.workers.processes, self._size
        for which in draw_scenes(self.number, self.scenes or 12, self.kinds, size):
            yield which.name, partial(render_scene, which, out, python, jobs=jobs, size=size)

    def _result(self, folder: Path, out: Path, rows: tuple[str, ...], console: Console) -> SceneResult:
        """Return the result of one rendered scene; measure it again if the code or an option has changed."""
        text = hashlib.sha256(f"{folder.resolve()} {rows} {self._options}".encode())
        for package in (splatgraft, splatgraft_paper.exam):
            for path in sorted(Path(package.__file__ or "").parent.rglob("*.py")):
                text.update(path.read_bytes())
        file, key = out / "results" / f"{folder.name}.json", text.hexdigest()
        if file.is_file() and (record := json.loads(file.read_text(encoding="utf-8")))["key"] == key:
            return SceneResult.from_json(record["result"])
        started = time.perf_counter()
        scene = read_scene(folder, (self.work or out / "work") / folder.name, self._options, console)
        composed = time.perf_counter()
        found = evaluate_scene(scene, rows, out / "pictures" / f"{folder.name}.png")
        console.say(
            f"{folder.name}: reconstructed in {composed - started:.0f} s, "
            f"measured in {time.perf_counter() - composed:.0f} s"
        )
        file.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(file) as stream:
            stream.write(json.dumps({"key": key, "result": found.as_json()}, indent=1).encode())
        return found

    def _write_report(self, out: Path, rows: tuple[str, ...], results: list[SceneResult], failures: list[str]) -> None:
        head = {
            "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
            "commit": source_commit(),
            "number": self.number,
            "iterations": self._options.all_iterations,
            "budget": self._options.max_gaussians,
            "failures": failures,
        }
        size = f"{self.pixels}, {self.views} views, {SIZE.render.samples} samples; "
        conditions = (
            f"`{head['command']}` at commit {head['commit']}. {size if self.scenes_from is None else ''}"
            f"{self.quality}, {head['iterations']} iterations, at most {head['budget']} Gaussians a capture; every 8th "
            "view is held out and measured."
        )
        text = f"# {self._title()}\n\n{conditions}\n\n{summary_markdown(results)}"
        text += "".join(f"- not measured: {failure}\n" for failure in failures)
        light = {title: None if found is None else asdict(found) for title, found in summarize_light(results).items()}
        record = {
            **head,
            "rows": {row: asdict(summarize_row(row, results)) for row in rows},
            "light": light,
            "scenes": [one.as_json() for one in results],
        }
        out.mkdir(parents=True, exist_ok=True)
        (out / "exam.json").write_text(json.dumps(record, indent=1, allow_nan=False), encoding="utf-8")
        (out / "exam.md").write_text(text, encoding="utf-8")

    def _title(self) -> str:
        if self.number is None:
            return "Scenes that were given: no proof"
        if self.number == TRAINING_NUMBER:
            return f"Number {self.number}, for training: no proof"
        return f"Held-out benchmark {self.number}"
