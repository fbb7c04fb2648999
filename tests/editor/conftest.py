"""Provides a browser."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A browser without windows; tests that use it are marked `browser` (tests/conftest.py)."""
    from editor_driver import with_browser

    with with_browser() as found:
        yield found


@pytest.fixture
def window(browser: Any, project: Path) -> Iterator[Any]:
    """The editor's page on a project of the test's module."""
    from editor_driver import Editor, Window

    editor = Editor(project)
    opened = Window.opened(browser, editor)
    try:
        yield opened
    finally:
        opened.page.close()
        editor.kill()
