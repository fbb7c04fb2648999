"""Fixtures of this folder; tests import helpers by name from ball_scenes.py."""

from ball_scenes import relit

__all__ = ["relit"]
