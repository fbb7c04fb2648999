"""Harmonisation of a folder's views by several processes: on this machine's GPUs by accelerate, or anywhere by Ray."""

import pickle
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from splatgraft.folders.harmonized_views import Part, finished, harmonize_part
from splatgraft.folders.view_folder import ViewFolder
from splatgraft.runtime.console import Console
from splatgraft.runtime.progress import Progress
from splatgraft.runtime.workers import Task, run_tasks

_JOB_FILE = "job.pickle"
_LOG_FILE = "parts.log"
_POLL_SECONDS = 0.5


def harmonize_with_processes(whole: Part, processes: int, *, console: Console, progress: Progress) -> None:
    """Split the views over processes on this machine, one per GPU where there are GPUs.

    Raises:
        ValueError: A process failed.
    """
    job = whole.kept / _JOB_FILE
    job.write_bytes(pickle.dumps(whole))
    views, log = ViewFolder.open(whole.views), whole.kept / _LOG_FILE
    with log.open("wb") as stream:
        launch = [*_launcher(whole, processes), "-m", __name__, str(job)]
        worker = subprocess.Popen(launch, stdout=stream, stderr=stream)
        try:
            while worker.poll() is None:
                progress(len(finished(whole.kept, views)), len(views), f"{processes} processes")
                time.sleep(_POLL_SECONDS)
        finally:
            worker.terminate()
            worker.wait()
    job.unlink()
    if worker.returncode != 0:
        lines = [line for line in log.read_text(errors="replace").splitlines() if "Error: " in line]
        raise ValueError((lines or [f"{log}: expected all parts to succeed, found one that failed"])[0].strip())
    console.say(f"{processes} processes on this machine")


def harmonize_with_ray(whole: Part, parts: int, *, address: str, progress: Progress) -> None:
    """Split the views into parts that Ray's workers harmonise, each with a GPU unless the device is cpu.

    Raises:
        ValueError: A part failed.
    """
    split = [replace(whole, number=i, of=parts) for i in range(parts)]
    tasks = [Task(f"part {part.number}", partial(harmonize_part, part)) for part in split]
    gpus = 0 if whole.device == "cpu" else 1
    if failures := run_tasks(tasks, ray_address=address, progress=progress, gpus_each=gpus):
        raise ValueError(failures[0])


def _launcher(whole: Part, processes: int) -> list[str]:
    kind = "--cpu" if whole.device == "cpu" or not torch.cuda.is_available() else "--multi_gpu"
    launch = [sys.executable, "-m", "accelerate.commands.launch", kind, "--num_machines", "1"]
    launch += ["--mixed_precision", "no", "--dynamo_backend", "no"]
    return [*launch, "--num_processes", str(processes), "--main_process_port", "0"]


def _main(arguments: Sequence[str]) -> None:
    """Harmonise this process's share; accelerate starts several of them."""
    from accelerate import PartialState

    whole: Part = pickle.loads(Path(arguments[0]).read_bytes())
    state = PartialState(cpu=whole.device == "cpu" or not torch.cuda.is_available())
    harmonize_part(
        replace(whole, number=state.process_index, of=state.num_processes, assigned_device=str(state.device))
    )


if __name__ == "__main__":
    _main(sys.argv[1:])
