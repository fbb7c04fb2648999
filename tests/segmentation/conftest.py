"""Fixtures of this folder; tests import helpers by name from ball_views.py."""

from ball_views import ball, cameras, masks, photographs, scene, wall

__all__ = ["ball", "cameras", "masks", "photographs", "scene", "wall"]
