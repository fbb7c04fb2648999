"""The value `SceneMetadata`: what a scene file may say about its frame beside the Gaussians."""

from dataclasses import dataclass


@dataclass(frozen=True)
class SceneMetadata:
    """Up direction and size of the world in which Gaussians are given, where they are known."""

    up: tuple[float, float, float] | None = None
    """Unit vector, in the frame of the Gaussians."""
    metres_per_unit: float | None = None
    """Above 0."""

    @property
    def known(self) -> dict[str, tuple[float, float, float] | float]:
        """The fields that are known, by their names."""
        fields = {"up": self.up, "metres_per_unit": self.metres_per_unit}
        return {name: value for name, value in fields.items() if value is not None}
