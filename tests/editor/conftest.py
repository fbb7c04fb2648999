"""Fixtures of this folder; tests import helpers by name from editor_fixtures.py."""

from editor_fixtures import browser, editor, made, project, session, window

__all__ = ["browser", "editor", "made", "project", "session", "window"]
