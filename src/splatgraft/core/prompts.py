"""The value `ViewPrompt`: what a user says about the object in one picture, by points and a rectangle."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

Rectangle = tuple[float, float, float, float]
"""Left, top, right, bottom, pixels."""


def _none() -> Float[Tensor, "0 2"]:
    return torch.zeros(0, 2)


@dataclass(frozen=True)
class ViewPrompt:
    """Points on and beside the object and a rectangle around it, in one picture; each may be missing."""

    inside: Float[Tensor, "k 2"] = field(default_factory=_none)
    """x and y of points on the object, pixels."""
    outside: Float[Tensor, "m 2"] = field(default_factory=_none)
    """x and y of points beside the object, pixels."""
    box: Rectangle | None = None
    """Holds the whole object, as far as the picture shows it."""

    def scaled(self, x: float, y: float) -> "ViewPrompt":
        """The same in a picture resampled by the factors `x` and `y`."""
        factor = torch.tensor([x, y])
        box = None if self.box is None else (self.box[0] * x, self.box[1] * y, self.box[2] * x, self.box[3] * y)
        return ViewPrompt(self.inside * factor, self.outside * factor, box)
