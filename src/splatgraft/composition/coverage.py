"""The value `Coverage`: directions from an object to its photographs and to the target's views, and their picture."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.directions import tangents

_PHOTOGRAPHED_DEG = 50.0  # largest angle to a photograph's direction at which a side was seen well; set by hand
_SIDE_PX = 320  # width and height of the picture
_RIM_DEG = 110.0  # angle from up at the rim of the picture
_DOT_PX = 4.0  # radius
# sRGB
_SEEN, _UNSEEN, _OUTSIDE = (0.85, 0.90, 0.84), (0.93, 0.70, 0.63), (1.0, 1.0, 1.0)
_PHOTOGRAPH, _VIEW = (0.15, 0.15, 0.17), (0.16, 0.36, 0.80)


@dataclass(frozen=True)
class Coverage:
    """Unit vectors from an object to the cameras around it; z is up."""

    photographs: Float[Tensor, "s 3"]
    """Directions to the cameras that photographed the object."""
    views: Float[Tensor, "t 3"]
    """Directions to the cameras of the target."""

    @staticmethod
    def of(to_photographs: Float[Tensor, "s 3"], to_views: Float[Tensor, "t 3"], up: Float[Tensor, "3"]) -> "Coverage":
        """Make the value from vectors of any length in a frame with unit `up`."""
        axes = torch.stack([*tangents(up.double()), up.double()])
        both = (torch.nn.functional.normalize(x.double(), dim=1) @ axes.T for x in (to_photographs, to_views))
        return Coverage(*both)

    @property
    def unseen_share(self) -> float:
        """Share of the views, in [0, 1], that look at a side of the object which no photograph shows."""
        return 1 - float(self._covers(self.views).double().mean()) if len(self.views) else 0.0

    def _covers(self, directions: Tensor) -> Tensor:
        """Test whether `directions`, Float[*n 3], are near that of some photograph; Bool[*n]."""
        return (directions @ self.photographs.T).amax(-1) > math.cos(math.radians(_PHOTOGRAPHED_DEG))

    def draw(self) -> Float[Tensor, "h w 3"]:
        """Draw the directions as seen from above: up is the middle, the rim lies 20 degrees below the horizon.

        Sides that a photograph shows are green, the others red. Dark dots are photographs, blue dots are views.
        """
        x = (torch.arange(_SIDE_PX, dtype=torch.float64) + 0.5) / _SIDE_PX * 2 - 1
        y, x = torch.meshgrid(-x, x, indexing="ij")
        radius = torch.hypot(x, y)
        from_up = radius * math.radians(_RIM_DEG)
        level = from_up.sin() / radius
        directions = torch.stack([level * x, level * y, from_up.cos()], -1)
        picture = torch.where(self._covers(directions)[..., None], torch.tensor(_SEEN), torch.tensor(_UNSEEN))
        picture[radius > 1] = torch.tensor(_OUTSIDE)
        for dots, color in ((self.views, _VIEW), (self.photographs, _PHOTOGRAPH)):
            for dot in dots:
                away = torch.acos(dot[2].clamp(-1, 1)) / math.radians(_RIM_DEG)
                place = torch.nn.functional.normalize(dot[:2], dim=0) * away.clamp_max(1)
                near = torch.hypot(x - place[0], y - place[1]) < _DOT_PX * 2 / _SIDE_PX
                picture[near] = torch.tensor(color)
        return picture
