"""Loss on inverse depth that keeps plain surfaces flat, beside the photometric loss of a fit.

Photographs alone do not determine the depth of a plain surface, because it looks the same at any depth. On a plane,
inverse depth is linear in the pixel. So the loss is the second difference of the rays' mean inverse depth over plain
parts of a photograph. A bare table gets its depth from its textured rim. This is the planar prior of ACMP (Xu and Tao
2020) as a loss.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

_FAINT = 1e-3  # smallest opacity by which inverse depth is divided
_SOLID = 0.5  # opacity below which a pixel shows no surface
_EDGE = 0.04  # smallest edge of a photograph, sRGB difference over two pixels; twice the noise of a phone's photo


@dataclass(frozen=True)
class SurfaceLoss:
    """Weight and unit of the loss; the weight was chosen with benchmarks/fit_surfaces.py."""

    unit: float
    """Length in which depth is measured, world units: distance of the cameras from their focus point."""
    weight: float = 1.0
    """Factor on the loss."""

    def loss(
        self,
        inverse_depth: Float[Tensor, "h w"],
        alpha: Float[Tensor, "h w"],
        image: Float[Tensor, "h w 3"],
        *,
        generator: torch.Generator,
    ) -> Float[Tensor, ""]:
        """Compute the loss, a mean over pixels; differentiable in `inverse_depth` and `alpha`.

        Args:
            inverse_depth: Blended inverse depth from `render`, per world unit.
            alpha: Opacity of the pixels.
            image: The photograph, sRGB; its edges separate surfaces.
            generator: Draws the axis and the distance of the second difference.
        """
        mean = self.unit * inverse_depth / alpha.clamp_min(_FAINT)
        return self.weight * _bend(mean, alpha, image, generator)


def _bend(
    inverse: Float[Tensor, "h w"],
    alpha: Float[Tensor, "h w"],
    image: Float[Tensor, "h w 3"],
    generator: torch.Generator,
) -> Float[Tensor, ""]:
    """Compute the mean absolute second difference of three pixels in a row or column without an edge between them.

    Their distance is drawn between 2 pixels and half of the side, evenly in its logarithm. Small distances smooth;
    large ones carry the depth of a rim over the whole of a bare surface.
    """
    upright, share = torch.rand(2, generator=generator).tolist()
    if upright < 0.5:
        inverse, alpha, image = inverse.T, alpha.T, image.transpose(0, 1)
    distance = int(2 * (inverse.shape[1] / 4) ** share)
    edge = (image[:, 2:] - image[:, :-2]).abs().amax(-1) > _EDGE
    edge |= alpha[:, 1:-1] < _SOLID
    before = torch.nn.functional.pad(edge.int().cumsum(1), (2, 0))
    plain = before[:, 2 * distance :] == before[:, : -2 * distance]
    bend = inverse[:, 2 * distance :] + inverse[:, : -2 * distance] - 2 * inverse[:, distance:-distance]
    return (bend.abs() * plain).mean()
