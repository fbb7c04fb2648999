"""A tiny project of two scenes, sessions and pages on copies of it, and one browser for all stories."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from editor_pages import opened_page, scene_project

from splatgraft.cli import main
from splatgraft.editor.page.page import Page
from splatgraft.editor.project import Project
from splatgraft.editor.session import Session


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
def page(project: Path) -> Iterator[Page]:
    """Return the page on that copy, with a real server."""
    with opened_page(project) as found:
        yield found


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Return a browser without windows; tests that use it are marked `browser` (tests/conftest.py).

    It is closed behind each module: Playwright cannot be started twice in one process, and test_exported_page.py has a
    browser of its own.
    """
    from editor_driver import with_browser

    with with_browser() as found:
        yield found


@pytest.fixture
def window(browser: Any, page: Page) -> Iterator[Any]:
    """Return a window on the page."""
    from editor_driver import Window

    opened = Window.opened(browser, address_of(page))
    yield opened
    opened.page.close()


def address_of(page: Page) -> str:
    """Return the complete address of a page that a test serves."""
    return f"http://127.0.0.1:{page.context.guarded.port}/?token=secret"
