"""The colours of each photograph over those of the scene: exposure and white balance, fitted beside the scene.

A photograph's colours are an affine map of the scene's (12 numbers instead of the embeddings of Martin-Brualla et al.
2021). The maps' mean over the views is kept at the identity, so that the scene shows the mean appearance; they are no
part of the scene. Adam updates a view's map when the view is visited, with the view's own bias correction.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

_BETA_1, _BETA_2, _EPSILON = 0.9, 0.99, 1e-12
"""Adam's; a view is visited tens of times, which a slower second moment would not follow."""


@dataclass(frozen=True)
class ViewColors:
    """Maps of v views, each 3x4, as differences from the identity."""

    maps: Float[Tensor, "v 3 4"]
    """Their mean over the views is 0."""
    first: Float[Tensor, "v 3 4"]
    """Running mean of gradients."""
    second: Float[Tensor, "v 3 4"]
    """Running mean of squared gradients."""
    steps: Int[Tensor, "v"]
    """Updates of each view."""

    @staticmethod
    def identity(views: int, device: torch.device) -> "ViewColors":
        """No view differs from the scene."""
        zeros = torch.zeros(views, 3, 4, device=device)
        return ViewColors(zeros, zeros, zeros, torch.zeros(views, dtype=torch.int32, device=device))

    def of(self, view: int) -> Float[Tensor, "3 4"]:
        """Matrix and offset from the scene's colours to the view's."""
        return self.maps[view] + torch.eye(3, 4, device=self.maps.device)

    def updated(self, view: int, gradient: Float[Tensor, "3 4"], rate: float) -> "ViewColors":
        """After a step of Adam on one view; the mean of all maps is taken out."""
        maps, first, second, steps = (tensor.clone() for tensor in (self.maps, self.first, self.second, self.steps))
        steps[view] += 1
        first[view] = _BETA_1 * first[view] + (1 - _BETA_1) * gradient
        second[view] = _BETA_2 * second[view] + (1 - _BETA_2) * gradient**2
        count = int(steps[view])
        mean, square = first[view] / (1 - _BETA_1**count), second[view] / (1 - _BETA_2**count)
        maps[view] -= rate * mean / (square.sqrt() + _EPSILON)
        return ViewColors(maps - maps.mean(0), first, second, steps)


def rate_at(rate: float, done: float) -> float:
    """Learning rate after the share `done` of all steps: it falls along half a cosine to 0."""
    return rate * (0.5 + 0.5 * math.cos(math.pi * done))


def apply_colors(image: Float[Tensor, "h w 3"], colors: Float[Tensor, "3 4"]) -> Float[Tensor, "h w 3"]:
    """`image` with an affine map of its colours."""
    return image @ colors[:, :3].T + colors[:, 3]
