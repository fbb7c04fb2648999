"""The axis-aligned 3D box around an object."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True)
class Box:
    """All points between two corners."""

    lower: Float[Tensor, "3"]
    """Least x, y, z, world units."""
    upper: Float[Tensor, "3"]
    """Greatest x, y, z, world units."""

    def __post_init__(self) -> None:
        """Raises: ValueError where the corners are not in order."""
        if not bool((self.lower < self.upper).all()):
            raise ValueError(f"box: expected lower < upper, found {self.lower.tolist()} and {self.upper.tolist()}")

    def contains(self, points: Float[Tensor, "*n 3"]) -> Bool[Tensor, "*n"]:
        """Which points lie inside."""
        return ((points >= self.lower.to(points)) & (points <= self.upper.to(points))).all(-1)

    def grown(self, factor: float) -> "Box":
        """The box with edges `factor` times as long and the same centre."""
        centre, half = (self.lower + self.upper) / 2, (self.upper - self.lower) / 2 * factor
        return Box(centre - half, centre + half)

    @property
    def corners(self) -> Float[Tensor, "8 3"]:
        """The eight corners."""
        choice = torch.cartesian_prod(*[torch.arange(2)] * 3).bool()
        return torch.where(choice, self.upper, self.lower)
