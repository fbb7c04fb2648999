"""The browser of tests: its path, and the arguments that it starts with."""

import os
import shutil
from pathlib import Path

import pytest

ARGUMENTS = (
    *("--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--disable-dev-shm-usage"),
)
GL_ARGUMENTS = (
    *ARGUMENTS,
    # Mesa's software OpenGL takes a third of the time of the browser's own
    *("--use-gl=angle", "--use-angle=gl-egl", "--ignore-gpu-blocklist"),
)


def browser_path() -> str:
    """Return the path of the system's Chromium, else of Playwright's.

    Without any the test fails, or is skipped where SPLATGRAFT_NO_BROWSER gives a reason.
    """
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if found is not None:
        return found
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        own = playwright.chromium.executable_path
    if Path(own).is_file():
        return own
    reason = os.environ.get("SPLATGRAFT_NO_BROWSER")
    if reason:
        pytest.skip(f"no browser: {reason}")
    pytest.fail("no Chromium found: `make browser`, or set SPLATGRAFT_NO_BROWSER to the reason why there is none")
