"""The value `ViewPrompt`: points and a rectangle by which a user marks the object in one picture."""

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
    """Points on the object, x and y, pixels."""
    outside: Float[Tensor, "m 2"] = field(default_factory=_none)
    """Points beside the object, x and y, pixels."""
    box: Rectangle | None = None
    """Rectangle around all of the object that the picture shows."""

    def scaled(self, x: float, y: float) -> "ViewPrompt":
        """Scale to a picture resampled by the factors `x` and `y`."""
        factor = torch.tensor([x, y])
        box = None if self.box is None else (self.box[0] * x, self.box[1] * y, self.box[2] * x, self.box[3] * y)
        return ViewPrompt(self.inside * factor, self.outside * factor, box)
