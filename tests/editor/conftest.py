"""Fixtures of this folder; tests import helpers by name from editor_fixtures.py."""

from editor_fixtures import browser, made, page, project, session, window

__all__ = ["browser", "made", "page", "project", "session", "window"]
