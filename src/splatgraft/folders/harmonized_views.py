"""Harmonisation of a folder's views in this process, by several on this machine (torchrun), or anywhere (Ray).

Every finished view has an image file, so a part can be started again after a kill or by another process.
"""

import os
import pickle
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch

from splatgraft.core.images import stored_size, write_image
from splatgraft.folders.view_folder import ViewFolder
from splatgraft.harmonization import (
    BatchHarmonizer,
    Harmonized,
    HarmonizerContext,
    HarmonizerOptions,
    make_harmonizer,
)
from splatgraft.project.step import choose_device
from splatgraft.runtime.console import Console
from splatgraft.runtime.progress import Progress, silent
from splatgraft.runtime.workers import Task, run_tasks

_READERS, _WRITERS = 2, 2
"""Threads that decode and encode images beside the model. Set by hand: about 0.09 s a view of 704x496 in one thread."""
_WAITING_GROUPS = 2
"""Groups of finished views that may wait to be written."""
_CPU_METHODS = ("none", "reinhard", "mv-colight", "image-editing")
"""Methods that use no device of this process."""

_JOB_FILE = "job.pickle"
_LOG_FILE = "parts.log"
_POLL_SECONDS = 0.5
_REPORT = "process "
"""First word of the line that each process writes when its views are done."""


@dataclass(frozen=True)
class Part:
    """Every `of`-th view of a folder, from `number` on."""

    views: Path
    """The folder of views."""
    method: HarmonizerOptions
    """The harmoniser's options."""
    kept: Path
    """Folder for finished images: images/ and confidence/."""
    number: int = 0
    of: int = 1
    device: str = "auto"
    """As in `choose_device`: auto, cpu or cuda."""
    assigned_device: str | None = None
    """The device that a launcher assigned to this process; replaces `device`."""
    key: str | None = None
    """Of a service."""

    def missing(self, views: ViewFolder) -> list[int]:
        """Indices of the part's views that are not finished."""
        done = finished(self.kept, views)
        return [i for i in range(self.number, len(views), self.of) if i not in done]


def picture_folders(kept: Path) -> None:
    """Make the folders for finished images."""
    for name in ("images", "confidence"):
        (kept / name).mkdir(exist_ok=True)


def finished(kept: Path, views: ViewFolder) -> set[int]:
    """Indices of the views whose image exists."""
    return {i for i, stem in enumerate(views.stems) if (kept / "images" / f"{stem}.png").is_file()}


def harmonize_part(part: Part, say: Callable[[str], None] = lambda sentence: None, progress: Progress = silent) -> None:
    """Harmonise the views of the part that are not finished.

    Raises:
        ValueError: The method's weights or packages are missing, or a view is damaged.
    """
    views = ViewFolder.open(part.views)
    missing = part.missing(views)
    if not missing:
        return
    harmonizer = make_harmonizer(part.method, _context(part, views, missing, say))
    at_once = harmonizer.views_at_once if isinstance(harmonizer, BatchHarmonizer) else 1
    done = len(views) - len(missing) if part.of == 1 else 0
    groups = _groups(views, missing, at_once)
    # files are decoded and encoded beside the model: it waits for the first group alone, and for writing at the end
    with ThreadPoolExecutor(_READERS) as readers, ThreadPoolExecutor(_WRITERS) as writers:
        ahead = [readers.submit(views.read, i) for i in groups[0]]
        written: deque[Future[None]] = deque()
        for indices, following in zip(groups, [*groups[1:], []], strict=True):
            now, ahead = [reading.result() for reading in ahead], [readers.submit(views.read, i) for i in following]
            if isinstance(harmonizer, BatchHarmonizer):
                results = harmonizer.harmonize_all(now)
            else:
                results = [harmonizer.harmonize(view) for view in now]
            for index, result in zip(indices, results, strict=True):
                written.append(writers.submit(_write, part.kept, views.stems[index], result))
            while len(written) > _WAITING_GROUPS * at_once:
                written.popleft().result()
            done += len(indices)
            progress(done, len(views), views.stems[indices[-1]])
        for writing in written:
            writing.result()


def _context(part: Part, views: ViewFolder, missing: list[int], say: Callable[[str], None]) -> HarmonizerContext:
    device = part.assigned_device
    if device is None:
        device = "cpu" if part.method.name in _CPU_METHODS else choose_device(part.device, Console()).type
    width, height = stored_size(views.path("composite", missing[0]))
    return HarmonizerContext(
        device=torch.device(device), views=len(missing), pixels=width * height, key=part.key, say=say
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
    write_image(kept / "images" / f"{stem}.png", result.image)  # last: the view counts as finished


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
