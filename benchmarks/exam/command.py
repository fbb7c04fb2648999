"""The exam of the light transfer: new synthetic scenes from a number, rendered, reconstructed, relit and measured.

`make exam NUMBER=...` or `python benchmarks/exam NUMBER --out FOLDER`. The scenes follow from the number alone. A
number is used for one exam: whoever has looked at its scenes may tune to them. Number 0 is for training and never a
proof. `--benchmark` renders and measures the nine scenes of `splatgraft synth benchmark` in the exam's size instead, as
a regression table, and `--scenes-from FOLDER` scenes that are rendered already.

OUT gets scenes/ (captures and the truth), work/ (reconstructions), results/ (a .json per scene), pictures/ (views one
above the other: pasted, transfer, told everything, truth), exam.md and exam.json. A run that was stopped goes on where
it was; what changes of the code or of the options concern is measured again.
"""

import argparse
import hashlib
import json
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import splatgraft
from exam.draw import SIZE, TRAINING_NUMBER, draw_scenes
from exam.evaluate_scene import SceneResult, evaluate_scene
from exam.render_scene import render_scene
from exam.rows import ROWS
from exam.scene_files import read_scene
from exam.summary import summarize_light, summarize_row, summary_markdown
from splatgraft.reconstruction import ReconstructOptions
from splatgraft.runtime.console import Console
from splatgraft.runtime.files import atomic_write
from splatgraft_paper.synthesis.benchmark import SCENES

_ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Exam:
    """What is to be measured, and where."""

    out: Path
    work: Path
    """Folder of all reconstructions."""
    rows: tuple[str, ...]
    options: ReconstructOptions
    """Of all reconstructions."""

    def key(self, folder: Path) -> str:
        """A hash of what a scene's result depends on: its folder, the rows, the options and the code."""
        text = hashlib.sha256(f"{folder.resolve()} {self.rows} {self.options}".encode())
        for code in (Path(splatgraft.__file__).parent, Path(__file__).parent):
            for path in sorted(code.rglob("*.py")):
                text.update(path.read_bytes())
        return text.hexdigest()

    def result(self, folder: Path, console: Console) -> SceneResult:
        """The result of one rendered scene, measured where that is not done yet."""
        file, key = self.out / "results" / f"{folder.name}.json", self.key(folder)
        if file.is_file() and (record := json.loads(file.read_text()))["key"] == key:
            return SceneResult.from_json(record["result"])
        started = time.perf_counter()
        scene = read_scene(folder, self.work / folder.name, self.options, console)
        composed = time.perf_counter()
        found = evaluate_scene(scene, self.rows, self.out / "pictures" / f"{folder.name}.png")
        console.say(
            f"{folder.name}: reconstructed in {composed - started:.0f} s, "
            f"measured in {time.perf_counter() - composed:.0f} s"
        )
        file.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(file) as stream:
            stream.write(json.dumps({"key": key, "result": found.as_json()}, indent=1).encode())
        return found


def main() -> int:
    """Render, measure and report; 1 where a scene could not be made."""
    asked = _parse()
    console = Console()
    options = ReconstructOptions(iterations=asked.iterations, budget=asked.budget)
    exam = Exam(asked.out, asked.work or asked.out / "work", tuple(row for row in ROWS if row in asked.rows), options)
    results, failures = [], []
    for name, make_folder in _scene_folders(asked):
        try:
            started = time.perf_counter()
            folder = make_folder()
            console.say(f"{name}: rendered in {time.perf_counter() - started:.0f} s")
            results.append(exam.result(folder, console))
        except ValueError as error:
            failures.append(f"{name}: {error}")
            console.say(failures[-1])
    _write_report(asked, exam, results, failures)
    return 1 if failures else 0


def _scene_folders(asked: argparse.Namespace) -> Iterator[tuple[str, partial[Path]]]:
    """Name of each scene, and the function that renders what is missing of it and gives its folder."""
    if asked.scenes_from is None:
        scenes = SCENES[: asked.scenes] if asked.benchmark else draw_scenes(asked.number, asked.scenes or 12)
        for which in scenes:
            yield which.name, partial(render_scene, which, asked.out, asked.blender_python, jobs=asked.jobs)
        return
    folders = sorted(path.parent for path in asked.scenes_from.glob("*/placement.json"))
    for folder in folders[: asked.scenes]:
        yield folder.name, partial(Path, folder)


def _write_report(asked: argparse.Namespace, exam: Exam, results: list[SceneResult], failures: list[str]) -> None:
    head = {
        "command": shlex.join(["python", *sys.argv]),
        "commit": _commit(),
        "number": asked.number,
        "iterations": exam.options.all_iterations,
        "budget": exam.options.max_gaussians,
        "failures": failures,
    }
    text = f"# {_title(asked)}\n\n{_conditions(asked, head)}\n\n{summary_markdown(results)}"
    text += "".join(f"- not measured: {failure}\n" for failure in failures)
    rows = {row: asdict(summarize_row(row, results)) for row in exam.rows}
    light = {title: None if found is None else asdict(found) for title, found in summarize_light(results).items()}
    record = {**head, "rows": rows, "light": light, "scenes": [one.as_json() for one in results]}
    exam.out.mkdir(parents=True, exist_ok=True)
    (exam.out / "exam.json").write_text(json.dumps(record, indent=1, allow_nan=False))
    (exam.out / "exam.md").write_text(text)
    print(text)


def _title(asked: argparse.Namespace) -> str:
    if asked.scenes_from is not None:
        return "Scenes that were given: no proof"
    if asked.benchmark:
        return "The benchmark's nine scenes: no proof"
    if asked.number == TRAINING_NUMBER:
        return f"Number {asked.number}, for training: no proof"
    return f"Exam {asked.number}"


def _conditions(asked: argparse.Namespace, head: dict) -> str:
    size = f"{SIZE.render.width}x{SIZE.render.height}, {SIZE.views} views, {SIZE.render.samples} samples; "
    return (
        f"`{head['command']}` at commit {head['commit']}. {size if asked.scenes_from is None else ''}"
        f"{head['iterations']} iterations, at most {head['budget']} Gaussians a capture; every 8th view is held out "
        "and measured."
    )


def _commit() -> str:
    command = ["git", "-C", str(_ROOT), "describe", "--always", "--dirty", "--exclude=*"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.stdout.strip() or "unknown"


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python benchmarks/exam", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("number", type=int, nargs="?", help="seeds follow from it; 0 is for training, never a proof")
    parser.add_argument("--scenes", type=int, help="number of scenes (12; all of --benchmark and --scenes-from)")
    parser.add_argument("--scenes-from", type=Path, help="folder of rendered scenes, instead of a number")
    parser.add_argument("--benchmark", action="store_true", help="the nine benchmark scenes, instead of a number")
    parser.add_argument("--out", type=Path, help="folder of everything that is made (build/exam/NUMBER)")
    parser.add_argument("--work", type=Path, help="folder of the reconstructions, to be shared by runs (OUT/work)")
    parser.add_argument("--iterations", type=int, default=1000, help="of each reconstruction (1000)")
    parser.add_argument("--budget", type=int, default=20_000, help="Gaussians of each reconstruction (20000)")
    parser.add_argument("--jobs", type=int, default=2, help="Blender processes at a time (2)")
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), default=list(ROWS), help="rows to measure (all)")
    parser.add_argument(
        "--blender-python", type=Path, default=_ROOT / ".venv-blender/bin/python", help="made by `make blender`"
    )
    asked = parser.parse_args()
    given = [asked.number is not None, asked.benchmark, asked.scenes_from is not None]
    if sum(given) != 1:
        parser.error(f"expected a NUMBER, --benchmark or --scenes-from FOLDER, found {sum(given)} of them")
    if asked.out is None:
        asked.out = _ROOT / "build" / "exam" / (str(asked.number) if given[0] else "benchmark" if given[1] else "given")
    return asked
