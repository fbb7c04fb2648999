"""The fixtures of this folder; what tests import by name lies in ball_scenes.py."""

from ball_scenes import relit

__all__ = ["relit"]
