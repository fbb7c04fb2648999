"""Harmonises the views of a folder, or every k-th of them, one finished file each; splits them over GPUs and machines.

A view whose image is there is done: so any part may be begun again, after a kill or by another worker.
"""

import pickle
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from splatgraft.core.images import stored_size, write_image
from splatgraft.folders.view_folder import ViewFolder
from splatgraft.harmonization import BatchHarmonizer, Harmonized, HarmonizerOptions, make_harmonizer
from splatgraft.project.step import choose_device
from splatgraft.runtime.console import Console
from splatgraft.runtime.progress import Progress, silent
from splatgraft.runtime.workers import Task, run_tasks

if TYPE_CHECKING:
    from splatgraft.commands.steps.harmonize import Harmonize

_JOB_FILE = "job.pickle"


@dataclass(frozen=True)
class Part:
    """Every `of`-th view from `number` on."""

    step: "Harmonize"
    """What is wanted."""
    kept: Path
    """Where finished images go: images/ and confidence/."""
    number: int = 0
    of: int = 1
    device: str | None = None
    """Another device than the step's."""
    key: str | None = None
    """Of a service."""

    def stems(self, views: ViewFolder) -> list[int]:
        """Indices of the part's views that are not done."""
        done = finished(self.kept, views)
        return [i for i in range(self.number, len(views), self.of) if i not in done]


def picture_folders(kept: Path) -> None:
    """Make the folders for finished images."""
    for name in ("images", "confidence"):
        (kept / name).mkdir(exist_ok=True)


def finished(kept: Path, views: ViewFolder) -> set[int]:
    """Indices of the views whose image is there."""
    return {i for i, stem in enumerate(views.stems) if (kept / "images" / f"{stem}.png").is_file()}


def harmonize_part(part: Part, say: Callable[[str], None] = lambda sentence: None, progress: Progress = silent) -> None:
    """Make the images of the part that are missing.

    Raises: ValueError where the method misses something or a view is broken.
    """
    views = ViewFolder.open(part.step.views)
    missing = part.stems(views)
    if not missing:
        return
    harmonizer = make_harmonizer(part.step.method, _options(part, views, missing, say))
    at_once = harmonizer.views_at_once if isinstance(harmonizer, BatchHarmonizer) else 1
    done = len(views) - len(missing) if part.of == 1 else 0
    for indices in _groups(views, missing, at_once):
        if isinstance(harmonizer, BatchHarmonizer):
            results = harmonizer.harmonize_all([views.read(i) for i in indices])
        else:
            results = [harmonizer.harmonize(views.read(i)) for i in indices]
        for index, result in zip(indices, results, strict=True):
            _write(part.kept, views.stems[index], result)
        done += len(indices)
        progress(done, len(views), views.stems[indices[-1]])


def harmonize_parts(whole: Part, *, console: Console, progress: Progress) -> None:
    """Split the views over the GPUs of this machine by accelerate, or over workers by Ray.

    Raises: ValueError where a part fails.
    """
    step = whole.step
    if step.ray is not None:
        parts = [replace(whole, number=i, of=step.processes) for i in range(step.processes)]
        tasks = [Task(f"part {part.number}", partial(harmonize_part, part)) for part in parts]
        gpus = 0 if step.device == "cpu" else 1
        if failures := run_tasks(tasks, ray_address=step.ray, progress=progress, gpus_each=gpus):
            raise ValueError(failures[0])
        return
    job = whole.kept / _JOB_FILE
    job.write_bytes(pickle.dumps(whole))
    cpu = ["--cpu"] if step.device == "cpu" or not torch.cuda.is_available() else ["--multi_gpu"]
    launch = [
        sys.executable,
        "-m",
        "accelerate.commands.launch",
        *cpu,
        "--num_machines",
        "1",
        "--mixed_precision",
        "no",
    ]
    launch += ["--dynamo_backend", "no", "--num_processes", str(step.processes), "--main_process_port", "0"]
    views, log = ViewFolder.open(step.views), whole.kept / "parts.log"
    with log.open("wb") as stream:
        worker = subprocess.Popen([*launch, "-m", __name__, str(job)], stdout=stream, stderr=stream)
        try:
            while worker.poll() is None:
                progress(len(finished(whole.kept, views)), len(views), f"{step.processes} processes")
                time.sleep(0.5)
        finally:
            worker.terminate()
            worker.wait()
    job.unlink()
    if worker.returncode != 0:
        lines = [line for line in log.read_text(errors="replace").splitlines() if "Error: " in line]
        raise ValueError((lines or [f"{log}: expected all parts to succeed, found one that failed"])[0].strip())
    console.say(f"{step.processes} processes on this machine")


def _options(part: Part, views: ViewFolder, missing: list[int], say: Callable[[str], None]) -> HarmonizerOptions:
    step = part.step
    needs_device = step.method not in ("none", "reinhard", "mv-colight", "image-editing")
    device = part.device or (choose_device(step.device, Console()).type if needs_device else "cpu")
    width, height = stored_size(views.path("composite", missing[0]))
    return HarmonizerOptions(
        weights=step.weights,
        base=step.base,
        lora=step.lora,
        variant=step.variant,
        checkout=step.checkout,
        seed=step.seed,
        sampling_steps=step.sampling_steps,
        strength=step.strength,
        detail=step.detail,
        device=torch.device(device),
        precision=step.precision,
        batch=step.batch,
        compiled=step.compile,
        views=len(missing),
        pixels=width * height,
        max_cost=step.max_cost,
        key=part.key,
        say=say,
    )


def _groups(views: ViewFolder, indices: list[int], at_once: int) -> list[list[int]]:
    """The indices in their order, in groups of views of one size."""
    groups: list[list[int]] = []
    sizes = {i: stored_size(views.path("composite", i)) for i in indices} if at_once > 1 else {}
    for index in indices:
        if groups and len(groups[-1]) < at_once and sizes[groups[-1][0]] == sizes[index]:
            groups[-1].append(index)
        else:
            groups.append([index])
    return groups


def _write(kept: Path, stem: str, result: Harmonized) -> None:
    if result.confidence is not None:
        write_image(kept / "confidence" / f"{stem}.png", result.confidence)
    write_image(kept / "images" / f"{stem}.png", result.image)  # last: it says that the view is done


def _main(arguments: Sequence[str]) -> None:
    """One process of several that accelerate began."""
    from accelerate import PartialState

    whole: Part = pickle.loads(Path(arguments[0]).read_bytes())
    state = PartialState(cpu=whole.step.device == "cpu" or not torch.cuda.is_available())
    part = replace(whole, number=state.process_index, of=state.num_processes, device=str(state.device))
    harmonize_part(part)


if __name__ == "__main__":
    _main(sys.argv[1:])
