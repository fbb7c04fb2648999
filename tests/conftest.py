"""Puts this folder on the path, so that every test can import the tiny models; marks browser tests and slow tests.

No test may fail because the machine is slow or busy: time limits (pyproject.toml) are there against hangs alone.
"""

import threading
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# both are limits on the machine's speed
settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")

SLOW = (
    "benchmarks/test_gpu.py",
    "capture/test_colmap_process.py",
    "capture/test_pose_photos.py",
    "commands",
    "consolidation/test_consolidate.py",
    "editor/test_behind_a_proxy.py",
    "editor/test_editor_session.py",
    "editor/test_front_server.py",
    "editor/test_project_list.py",
    "editor/test_scenes_without_photos.py",
    "editor/test_server_and_windows.py",
    "editor/test_sharing.py",
    "exports/test_page_in_browser.py",
    "exports/test_parts_and_pictures.py",
    "exports/test_playcanvas_reads.py",
    "harmonization/test_flux_views.py",
    "reconstruction/test_training.py",
    "relighting/test_edges.py",
    "relighting/test_threads.py",
    "relighting/test_transfer.py",
    "synthesis",
    "training",
)
"""Folders and files of tests that train, run whole steps or start servers."""


_THREAD_SECONDS = 60.0
"""Longest wait for all threads: that of a page which no test closed never ends."""


def pytest_sessionfinish() -> None:
    """Wait for the editor's threads, since Python aborts where one of them is in torch when it ends."""
    end = time.monotonic() + _THREAD_SECONDS
    for thread in threading.enumerate():
        if thread.name.startswith("splatgraft"):
            thread.join(max(0.0, end - time.monotonic()))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests that use a browser, and slow tests."""
    here = Path(__file__).parent
    missing = [name for name in SLOW if not (here / name).exists()]
    if missing:
        raise pytest.UsageError(f"{__file__}: expected the slow tests {', '.join(missing)}, found no such file")
    slow = tuple(here / name for name in SLOW)
    for item in items:
        if "browser" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.browser)
        if any(item.path.is_relative_to(path) for path in slow):
            item.add_marker(pytest.mark.slow)
