"""The value `SceneMetadata`: what a scene file may say about its frame beside the Gaussians."""

from dataclasses import dataclass


@dataclass(frozen=True)
class SceneMetadata:
    """Up direction and size of the world in which Gaussians are given, where they are known."""

    up: tuple[float, float, float] | None = None
    """Unit vector, in the frame of the Gaussians."""
    metres_per_unit: float | None = None
    """Above 0."""
