"""The fixtures of this folder; what tests import by name lies in editor_fixtures.py."""

from editor_fixtures import browser, made, page, project, session, window

__all__ = ["browser", "made", "page", "project", "session", "window"]
