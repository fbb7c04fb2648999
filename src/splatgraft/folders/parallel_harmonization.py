"""Harmonisation of a folder's views by several processes: on this machine by torchrun, or anywhere by Ray."""

import os
import pickle
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
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
_REPORT = "process "
"""First word of the line that each process writes when its views are done."""


def harmonize_with_processes(whole: Part, processes: int, *, console: Console, progress: Progress) -> None:
    """Split the views over processes on this machine, one per GPU where there are GPUs.

    Raises:
        ValueError: A process failed.
    """
    job = whole.kept / _JOB_FILE
    job.write_bytes(pickle.dumps(whole))
    views, log = ViewFolder.open(whole.views), whole.kept / _LOG_FILE
    with log.open("wb") as stream:
        launch = [*_launcher(processes), "-m", __name__, str(job)]
        worker = subprocess.Popen(launch, stdout=stream, stderr=stream, env=_environment(processes))
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
    for line in sorted(line for line in log.read_text(errors="replace").splitlines() if line.startswith(_REPORT)):
        console.say(line)


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


def _launcher(processes: int) -> list[str]:
    return [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(processes)]


def _environment(processes: int) -> dict[str, str]:
    """The processes share the cores; torchrun would give each of them one."""
    return {"OMP_NUM_THREADS": str(max(1, (os.cpu_count() or 1) // processes)), **os.environ}


def _main(arguments: Sequence[str], environment: Mapping[str, str]) -> None:
    """Harmonise this process's share; torchrun starts several of them, one per GPU where there are GPUs."""
    whole: Part = pickle.loads(Path(arguments[0]).read_bytes())
    number, count = int(environment["RANK"]), int(environment["WORLD_SIZE"])
    gpus = 0 if whole.device == "cpu" else torch.cuda.device_count()
    device = f"cuda:{number % gpus}" if gpus else "cpu"
    part = replace(whole, number=number, of=count, assigned_device=device)
    missing = len(part.missing(ViewFolder.open(part.views)))
    harmonize_part(part)
    print(f"{_REPORT}{number + 1} of {count} on {device}: {missing} views", flush=True)


if __name__ == "__main__":
    _main(sys.argv[1:], os.environ)
