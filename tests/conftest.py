"""One thread a worker, Hypothesis without time limits, and one finished project that tests copy.

No test may fail because the machine is slow or busy: time limits (pyproject.toml) are there against hangs alone.
"""

import os

# before torch and numba are imported, because they read these then; two workers share two cores
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ["OMP_NUM_THREADS"] = os.environ["NUMBA_NUM_THREADS"] = "1"

import gc
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from filelock import FileLock
from hypothesis import HealthCheck, settings

# both are limits on the machine's speed
settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")

_THREAD_SECONDS = 60.0  # longest wait for all threads, because the thread of a page that no test closed never ends

_STORY_SECONDS = 600
"""Seconds after which a browser test counts as hanging; pytest-timeout then shows what each thread does."""


_LONGEST = ("test_editor_in_browser.py", "test_examples.py", "test_try.py", "test_exported_page.py")
"""Modules that run first, so that no worker is alone with one of them at the end."""


@pytest.fixture(scope="session")
def finished_project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make the folder of tiny_project.py's project with the results of all steps, once for all workers.

    Read it, never write into it: `copy_project` gives a copy. Beside it, in `../photos/source` and `../photos/target`,
    are the captures that its project.toml names.
    """
    root = tmp_path_factory.getbasetemp()
    root = (root.parent if "PYTEST_XDIST_WORKER" in os.environ else root) / "tiny_transfer"
    done = root / "done"
    with FileLock(root.with_suffix(".lock")):
        if not done.exists():
            from tiny_project import finish_project

            shutil.rmtree(root, ignore_errors=True)
            root.mkdir()
            finish_project(root)
            done.touch()
    return root / "project"


@pytest.fixture(scope="module", autouse=True)
def _no_open_files() -> Iterator[None]:
    """Collect garbage after each module, so that a file left open fails there and not later by chance.

    Objects that are still in use are left out of later searches, which saves half a second for each module.
    """
    yield
    gc.collect()
    gc.freeze()


@pytest.fixture
def copy_project(finished_project: Path, tmp_path: Path) -> Callable[[], Path]:
    """Return a function that copies `finished_project` with its captures into `tmp_path` and returns the copy's folder.

    Every step of the copy is up to date. For a copy that a module's tests share, call `copy_of` of tiny_project.py in a
    fixture of the module: `copy_of(finished_project, tmp_path_factory.mktemp("shared"))`.
    """
    from tiny_project import copy_of

    return lambda: copy_of(finished_project, tmp_path)


def pytest_sessionfinish() -> None:
    """Wait for the editor's threads, because Python aborts if one of them is in torch at the end."""
    end = time.monotonic() + _THREAD_SECONDS
    for thread in threading.enumerate():
        if thread.name.startswith("splatgraft"):
            thread.join(max(0.0, end - time.monotonic()))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest modules first, mark the tests that use a browser, and end browser tests that hang."""
    # `.ci/run` tells xdist to keep the order
    items.sort(key=lambda item: _LONGEST.index(item.path.name) if item.path.name in _LONGEST else len(_LONGEST))
    for item in items:
        if "browser" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.browser)
            if item.get_closest_marker("long") is None:
                item.add_marker(pytest.mark.timeout(_STORY_SECONDS))
