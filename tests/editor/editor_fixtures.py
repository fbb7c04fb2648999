"""A tiny project of two scenes, sessions, editors and windows on copies of it, and one browser for a module."""

import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from chromium import ARGUMENTS, browser_path
from editor_pages import Client, opened_editor, scene_project
from waiting import HANG_LIMIT

from splatgraft.cli import main
from splatgraft.editor.editor import Editor
from splatgraft.editor.project import Project
from splatgraft.editor.session import Session
from splatgraft.project.toml_edit import with_keys


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make two scenes without photographs, and a project with all steps up to `compose`."""
    root = tmp_path_factory.mktemp("scenes")
    assert main(["run", str(scene_project(root)), "--to", "compose"]) == 0
    return root


@pytest.fixture
def project(made: Path, tmp_path: Path) -> Path:
    """Return project.toml of a copy of that project."""
    shutil.copytree(made, tmp_path / "copy")
    return tmp_path / "copy" / "project" / "project.toml"


@pytest.fixture
def session(project: Path) -> Session:
    """Return an open session on that copy."""
    return Session(Project(project))


@pytest.fixture
def editor(project: Path) -> Iterator[Editor]:
    """Return the editor on that copy without the light transfer, whose process takes seconds to start."""
    project.write_text(with_keys(project.read_text(), "relight", {"light": "off"}))
    with opened_editor(project) as found:
        yield found


@pytest.fixture
def window(editor: Editor) -> Iterator[Client]:
    """Return a window on that editor."""
    with Client(editor.server.port).window() as found:
        yield found


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Return a browser without windows; tests that use it are marked `browser` (tests/conftest.py).

    It is closed behind each module: Playwright cannot be started twice in one process, and test_exported_page.py has a
    browser of its own.
    """
    path = browser_path()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver, tempfile.TemporaryDirectory() as folder:
        context = driver.chromium.launch_persistent_context(
            folder,
            executable_path=path,
            headless=True,
            args=[*ARGUMENTS, "--disable-gpu"],
            viewport={"width": 1000, "height": 640},
            timeout=1000 * HANG_LIMIT,
            has_touch=True,
        )
        context.set_default_timeout(1000 * HANG_LIMIT)
        yield context
        context.close()
