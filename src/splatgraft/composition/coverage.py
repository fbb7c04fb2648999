"""The value `Coverage`: from where an object was photographed, and from where it is looked at; measured and drawn."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.directions import tangents

# set by hand
_PHOTOGRAPHED_DEG = 50.0
"""Largest angle to a photograph's direction from which a side of the object was seen well enough."""
_SIDE_PX = 320  # width and height of the picture
_LOWEST_DEG = -20.0  # elevation at the rim of the picture
_DOT_PX = 4.0
_SEEN, _UNSEEN, _OUTSIDE = (0.85, 0.90, 0.84), (0.93, 0.70, 0.63), (1.0, 1.0, 1.0)
_PHOTOGRAPH, _VIEW = (0.15, 0.15, 0.17), (0.16, 0.36, 0.80)
"""sRGB."""


@dataclass(frozen=True)
class Coverage:
    """Unit vectors from an object to the cameras around it; z is up."""

    photographs: Float[Tensor, "s 3"]
    """To those that photographed it."""
    views: Float[Tensor, "t 3"]
    """To those that show it where it is."""

    @staticmethod
    def of(to_photographs: Float[Tensor, "s 3"], to_views: Float[Tensor, "t 3"], up: Float[Tensor, "3"]) -> "Coverage":
        """From vectors of any length in a frame with unit `up`."""
        axes = torch.stack([*tangents(up.double()), up.double()])
        both = (torch.nn.functional.normalize(x.double(), dim=1) @ axes.T for x in (to_photographs, to_views))
        return Coverage(*both)

    @property
    def unseen_share(self) -> float:
        """Share of the views, in [0, 1], that see the object from where no photograph of it was taken."""
        return 1 - float(self._covers(self.views).double().mean()) if len(self.views) else 0.0

    def _covers(self, directions: Tensor) -> Tensor:
        """Bool[*n]: which directions, Float[*n 3], are near that of some photograph."""
        return (directions @ self.photographs.T).amax(-1) > math.cos(math.radians(_PHOTOGRAPHED_DEG))

    def draw(self) -> Float[Tensor, "h w 3"]:
        """The directions seen from above: straight up in the middle, below the horizon at the rim.

        Green is what the photographs show (dark dots), red what none does; blue dots are the views.
        """
        x = (torch.arange(_SIDE_PX, dtype=torch.float64) + 0.5) / _SIDE_PX * 2 - 1
        y, x = torch.meshgrid(-x, x, indexing="ij")
        radius = torch.hypot(x, y)
        from_up = radius * math.radians(90 - _LOWEST_DEG)
        level = from_up.sin() / radius
        directions = torch.stack([level * x, level * y, from_up.cos()], -1)
        picture = torch.where(self._covers(directions)[..., None], torch.tensor(_SEEN), torch.tensor(_UNSEEN))
        picture[radius > 1] = torch.tensor(_OUTSIDE)
        for dots, color in ((self.views, _VIEW), (self.photographs, _PHOTOGRAPH)):
            for dot in dots:
                away = torch.acos(dot[2].clamp(-1, 1)) / math.radians(90 - _LOWEST_DEG)
                place = torch.nn.functional.normalize(dot[:2], dim=0) * away.clamp_max(1)
                near = torch.hypot(x - place[0], y - place[1]) < _DOT_PX * 2 / _SIDE_PX
                picture[near] = torch.tensor(color)
        return picture
