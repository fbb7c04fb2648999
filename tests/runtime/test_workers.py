"""Parallel tasks: order of failures, a failure stops no other task, Ray with a killed worker."""

import os
import signal
import time
from functools import partial
from pathlib import Path

import pytest

from splatgraft.runtime.workers import Task, run_tasks


def write_once(out: Path) -> None:
    """Check for its file first, and write it whole, like every job of the package."""
    if not out.exists():
        time.sleep(0.2)
        out.with_suffix(f".by{os.getpid()}").touch()
        out.write_text("done")


def write_after_dying_once(out: Path, deaths: Path) -> None:
    """Kill its own process the first time, like a machine that loses power."""
    if not deaths.exists():
        deaths.write_text(str(os.getpid()))
        os.kill(os.getpid(), signal.SIGKILL)
    write_once(out)


def fail(words: str) -> None:
    raise ValueError(words)


def tasks_in(folder: Path, count: int) -> list[Task]:
    return [Task(f"job{i}", partial(write_once, folder / f"{i}.txt")) for i in range(count)]


def test_every_job_is_done_and_failures_come_in_the_order_of_the_jobs(tmp_path):
    tasks = tasks_in(tmp_path, 3)
    tasks.insert(1, Task("bad", partial(fail, "x.png: expected light, found none")))
    tasks.append(Task("worse", partial(fail, "y.png: expected light, found none")))
    reported = []
    failures = run_tasks(tasks, at_once=3, progress=lambda done, total, name: reported.append((done, total)))
    assert failures == ["bad: x.png: expected light, found none", "worse: y.png: expected light, found none"]
    assert len(list(tmp_path.glob("*.txt"))) == 3
    assert reported == [(i, 5) for i in range(1, 6)]


def test_an_error_that_is_no_fault_of_the_data_is_raised(tmp_path):
    with pytest.raises(ZeroDivisionError):
        run_tasks([Task("bug", lambda: 1 / 0)])


@pytest.mark.filterwarnings("ignore")
@pytest.mark.long
def test_two_ray_workers_and_one_is_killed(tmp_path):
    ray = pytest.importorskip("ray")
    here = {"env_vars": {"PYTHONPATH": str(Path(__file__).parent)}}
    ray.init(num_cpus=2, runtime_env=here, include_dashboard=False, log_to_driver=False, configure_logging=False)
    try:
        tasks = tasks_in(tmp_path, 6)
        deaths = tmp_path / "death"
        tasks.append(Task("dies", partial(write_after_dying_once, tmp_path / "6.txt", deaths)))
        tasks.append(Task("bad", partial(fail, "x.png: expected light, found none")))
        failures = run_tasks(tasks, ray_address="local")
    finally:
        ray.shutdown()
    assert failures == ["bad: x.png: expected light, found none"]
    assert sorted(path.stem for path in tmp_path.glob("*.txt")) == [str(i) for i in range(7)]
    workers = {path.suffix for path in tmp_path.glob("*.by*")}
    assert len(workers) >= 2
    with pytest.raises(ProcessLookupError):
        os.kill(int(deaths.read_text()), 0)
