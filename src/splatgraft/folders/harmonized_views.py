"""Harmonisation of the views of a folder by one process, by several, or by Ray.

A view is finished when its image file exists, so that an interrupted part continues in any process.
"""

import os
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import active_children, get_context
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.images import stored_size, write_image
from splatgraft.folders.view_folder import ViewFolder
from splatgraft.harmonization import HarmonizerContext, HarmonizerOptions, make_harmonizer
from splatgraft.project.step import choose_device
from splatgraft.runtime.console import Console
from splatgraft.runtime.progress import Progress, silent
from splatgraft.runtime.workers import Task, run_tasks

_READERS, _WRITERS = 1, 2
"""Threads that decode and encode images beside the model; one thread takes about 0.09 s per view of 704x496."""
_WAITING_VIEWS = 2  # maximum number of views that wait to be written


@dataclass(frozen=True)
class Part:
    """Share of a folder's views for one process: every `of`-th view, starting at `number`."""

    views: Path
    """Folder of views."""
    method: HarmonizerOptions
    """Options of the harmoniser."""
    kept: Path
    """Folder for finished images, with images/."""
    number: int = 0
    of: int = 1
    device: str = "auto"
    """Device: auto, cpu, cuda, or the one assigned to this part, such as cuda:1."""

    def missing(self, views: ViewFolder) -> list[int]:
        """List the indices of the part's views that are not finished."""
        done = finished(self.kept, views)
        return [i for i in range(self.number, len(views), self.of) if i not in done]


def finished(kept: Path, views: ViewFolder) -> set[int]:
    """Find the indices of the views whose image exists."""
    return {i for i, stem in enumerate(views.stems) if (kept / "images" / f"{stem}.png").is_file()}


def harmonize_part(part: Part, say: Callable[[str], None] = lambda sentence: None, progress: Progress = silent) -> int:
    """Harmonise the unfinished views of the part; returns their number."""
    views = ViewFolder.open(part.views)
    missing = part.missing(views)
    if not missing:
        return 0
    device = choose_device(part.device, Console()) if part.device in ("auto", "cuda") else torch.device(part.device)
    width, height = stored_size(views.path("composite", missing[0]))
    context = HarmonizerContext(device=device, views=len(missing), pixels=width * height, say=say)
    harmonizer = make_harmonizer(part.method, context)
    done = len(views) - len(missing) if part.of == 1 else 0
    # files are decoded and encoded beside the model, which waits only for the first view and the last write
    with ThreadPoolExecutor(_READERS) as readers, ThreadPoolExecutor(_WRITERS) as writers:
        ahead, written = readers.submit(views.read, missing[0]), deque[Future[None]]()
        for index, following in zip(missing, [*missing[1:], None], strict=True):
            view = ahead.result()
            ahead = ahead if following is None else readers.submit(views.read, following)
            written.append(writers.submit(_write, part.kept, views.stems[index], harmonizer.harmonize(view)))
            if len(written) > _WAITING_VIEWS:
                written.popleft().result()
            done += 1
            progress(done, len(views), views.stems[index])
        for writing in written:
            writing.result()
    return len(missing)


def harmonize_with_processes(whole: Part, processes: int, *, say: Callable[[str], None], progress: Progress) -> None:
    """Split the views over processes on this machine, one per GPU where there are GPUs."""
    gpus = 0 if whole.device == "cpu" else torch.cuda.device_count()
    devices = [f"cuda:{number % gpus}" if gpus else "cpu" for number in range(processes)]
    parts = [replace(whole, number=i, of=processes, device=device) for i, device in enumerate(devices)]
    views, threads = ViewFolder.open(whole.views), max(1, (os.cpu_count() or 1) // processes)
    with ProcessPoolExecutor(processes, get_context("spawn"), torch.set_num_threads, (threads,)) as pool:
        try:
            running = [pool.submit(harmonize_part, part) for part in parts]
            while wait(running, timeout=0.5).not_done:
                progress(len(finished(whole.kept, views)), len(views), f"{processes} processes")
            counts = [one.result() for one in running]
        except BrokenProcessPool as error:
            found = "found one that was killed; run the step again, or with fewer processes"
            raise ValueError(f"{whole.views}: expected processes that finish, {found}") from error
        except BaseException:
            for process in active_children():
                process.terminate()
            raise
    for number, (device, count) in enumerate(zip(devices, counts, strict=True), 1):
        say(f"process {number} of {processes} on {device}: {count} views")


def harmonize_with_ray(whole: Part, parts: int, *, address: str, progress: Progress) -> None:
    """Split the views into parts for Ray's workers, each with a GPU unless the device is cpu."""
    split = [replace(whole, number=i, of=parts) for i in range(parts)]
    tasks = [Task(f"part {part.number}", partial(harmonize_part, part)) for part in split]
    gpus = 0 if whole.device == "cpu" else 1
    if failures := run_tasks(tasks, ray_address=address, progress=progress, gpus_each=gpus):
        raise ValueError(failures[0])


def _write(kept: Path, stem: str, image: Float[Tensor, "h w 3"]) -> None:
    write_image(kept / "images" / f"{stem}.png", image)
