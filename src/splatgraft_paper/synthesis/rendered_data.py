"""Rendering of synthetic data by Blender processes, and the checks and failure lists of the folders they write."""

import sys
from dataclasses import dataclass
from pathlib import Path

from splatgraft.runtime.console import Console
from splatgraft.runtime.workers import Task, run_tasks
from splatgraft_paper.synthesis import pairs
from splatgraft_paper.synthesis.jobs import RenderSize, check_blender

FAILURES_FILE = "failures.txt"
_SHOWN_FAILURES = 10


@dataclass(frozen=True)
class RenderWorkers:
    """The Blender processes that render."""

    blender_python: Path | None = None
    """A Python 3.11 that has bpy; this one where not given."""
    processes: int = 2
    """Blender processes at a time on this machine."""
    ray: str | None = None
    """Address of a Ray cluster whose machines all see the folder; `local` for one of this machine's cores."""

    def python(self, console: Console) -> Path:
        """The interpreter, after a trial import of bpy.

        Raises:
            ValueError: It has no bpy.
        """
        found = self.blender_python or Path(sys.executable)
        console.say(f"blender: {check_blender(found)} in {found}")
        return found

    def run(self, tasks: list[Task], console: Console) -> list[str]:
        """Render, and return one line per task that failed."""
        with console.bar("render") as progress:
            return run_tasks(tasks, at_once=self.processes, ray_address=self.ray, progress=progress)


def read_render_size(text: str, samples: int) -> RenderSize:
    """Parse WIDTHxHEIGHT.

    Raises:
        ValueError: It is not of this form, a side is below 16 pixels, or `samples` is below 1.
    """
    parts = text.split("x")
    if len(parts) != 2 or not all(part.isdigit() and int(part) >= 16 for part in parts) or samples < 1:
        raise ValueError(
            f"--size, --samples: expected such as 704x496 and at least one sample, found {text}, {samples}"
        )
    return RenderSize(int(parts[0]), int(parts[1]), samples)


def check_pairs(out: Path, failures: list[str], console: Console) -> int:
    """Check all rendered scenes in `out`; write the manifest of their pairs and the list of failures.

    Returns:
        0 where nothing failed and no pair is faulty, otherwise 1.

    Raises:
        ValueError: There are neither scenes nor failures.
    """
    folders = sorted(path.parent for path in out.glob("*/job.json"))
    if not folders and not failures:
        raise ValueError(f"{out}: expected rendered pairs or benchmark scenes, found none")
    count, faults = pairs.write_manifest(out, folders)
    console.say(f"{count} sound pairs in {len(folders)} scenes; {len(failures)} scenes failed, {len(faults)} faults")
    write_failures(out, [*failures, *faults], console)
    if folders:
        console.result(out / "manifest.jsonl")
    return 1 if failures or faults else 0


def write_failures(out: Path, failures: list[str], console: Console) -> None:
    """Write failures.txt, or remove it where nothing failed, and say the first lines."""
    path = out / FAILURES_FILE
    path.unlink(missing_ok=True)
    if failures:
        path.write_text("\n".join(failures) + "\n")
        for failure in failures[:_SHOWN_FAILURES]:
            console.say(failure)
        console.say(f"{len(failures)} failures, all in {path}")
