"""The fixtures of this folder; what tests import by name lies in ball_views.py."""

from ball_views import ball, cameras, masks, photographs, scene, wall

__all__ = ["ball", "cameras", "masks", "photographs", "scene", "wall"]
