"""Independent tasks in parallel: in threads on this machine, or on many machines through Ray.

A task writes its result to files and first checks whether they exist. It can therefore be repeated after a kill, even
on another machine with the same file system.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from typing import Any

from splatgraft.runtime.progress import Progress, silent

_RETRIES = 5  # repetitions by Ray of a task whose worker died


@dataclass(frozen=True)
class Task:
    """One task, safe to repeat."""

    name: str
    """Name in failures and in the progress."""
    work: Callable[[], object]
    """Function to call; for Ray, a `functools.partial` of a module's function. It raises ValueError for bad data."""


def run_tasks(
    tasks: Sequence[Task],
    *,
    at_once: int = 1,
    ray_address: str | None = None,
    progress: Progress = silent,
    gpus_each: int = 0,
) -> list[str]:
    """Run all tasks; a task that fails with a ValueError does not stop the others.

    Args:
        tasks: Independent tasks.
        at_once: Number of threads, without Ray.
        ray_address: Address of a Ray cluster (`auto`, `host:port`, `ray://host:port`) whose machines all see the same
            files under the same names. `local` starts one on this machine's cores, which ends with the call.
        progress: Called after each task.
        gpus_each: GPUs that Ray reserves for each task.

    Returns:
        One line per failed task, in the order of the tasks. Any other error of a task is raised.
    """
    if ray_address is not None:
        return _through_ray(tasks, ray_address, progress, gpus_each)
    failures: dict[int, str] = {}
    with ThreadPoolExecutor(max(1, at_once)) as pool:
        running = {pool.submit(task.work): index for index, task in enumerate(tasks)}
        try:
            for done, future in enumerate(as_completed(running), 1):
                index = running[future]
                error = future.exception()
                if isinstance(error, ValueError):
                    failures[index] = f"{tasks[index].name}: {error}"
                elif error is not None:
                    raise error
                progress(done, len(tasks), tasks[index].name)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return [failures[index] for index in sorted(failures)]


def _through_ray(tasks: Sequence[Task], address: str, progress: Progress, gpus_each: int) -> list[str]:
    import ray
    from ray.exceptions import RayTaskError, WorkerCrashedError

    own = not ray.is_initialized()
    if own:
        ray.init(address, include_dashboard=False, log_to_driver=False, configure_logging=False)
    failures: dict[int, str] = {}
    try:
        remote = ray.remote(_call).options(num_cpus=1, num_gpus=gpus_each, max_retries=_RETRIES)
        running: dict[Any, int] = {remote.remote(task.work): index for index, task in enumerate(tasks)}
        while running:
            (reference, *_), _ = ray.wait(list(running))
            index = running.pop(reference)
            try:
                ray.get(reference)
            except RayTaskError as error:
                if not isinstance(error.cause, ValueError):
                    raise
                failures[index] = f"{tasks[index].name}: {error.cause}"
            except WorkerCrashedError:
                failures[index] = f"{tasks[index].name}: expected a worker that lives, found {_RETRIES + 1} that died"
            progress(len(tasks) - len(running), len(tasks), tasks[index].name)
    finally:
        if own:
            ray.shutdown()
    return [failures[index] for index in sorted(failures)]


def _call(work: Callable[[], object]) -> None:
    work()
