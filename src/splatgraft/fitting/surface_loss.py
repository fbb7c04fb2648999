"""Losses on inverse depth that put Gaussians onto surfaces, beside the photometric loss of a fit.

Photographs alone leave depth open: faint Gaussians in front of others, or a plain surface at any depth, give the same
pictures. Two terms, both on the moments of inverse depth along each ray that `render` blends:

1. Spread: the variance of inverse depth along a ray, because a ray should meet one thin surface. It is the distortion
   of Mip-NeRF 360 (Barron et al. 2022) and 2DGS (Huang et al. 2024) in closed form; its logarithm bounds the pull of a
   Gaussian just in front of a camera.
2. Bend: the second difference of inverse depth over plain parts of a photograph. Inverse depth is linear in the pixel
   on a plane, so that a bare table is held by its textured rim (the planar prior of ACMP, Xu and Tao 2020, as a loss).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

_FAINT = 1e-3  # opacity that a ray's moments are divided by at least
_SOLID = 0.5  # opacity below which a pixel shows no surface
_EDGE = (
    0.04  # difference over two pixels, sRGB, from which a photograph is not plain: twice the noise of a phone's photo
)


@dataclass(frozen=True)
class SurfaceLoss:
    """Weights of both terms, and when they act; chosen with benchmarks/fit_surfaces.py."""

    unit: float
    """Length in which depth is measured, world units: the distance of what the cameras look at."""
    spread: float = 0.3
    """Factor on the spread."""
    bend: float = 0.3
    """Factor on the bend."""
    spread_from: float = 0.5
    """Share of the steps after which the spread counts. Earlier it holds what is far at the nearest surface's edge."""

    def loss(
        self,
        inverse_depth: Float[Tensor, "h w 2"],
        alpha: Float[Tensor, "h w"],
        image: Float[Tensor, "h w 3"],
        *,
        done: float,
        generator: torch.Generator,
    ) -> Float[Tensor, ""]:
        """Sum of both terms, means over pixels; differentiable in `inverse_depth` and `alpha`.

        Args:
            inverse_depth: Moments as `render` gives them, per world unit and its square.
            alpha: Opacity of the pixels.
            image: The photograph, sRGB, which says where the surface is plain.
            done: Share of the steps that are done, in [0, 1].
            generator: Draws the axis and the distance of the second difference.
        """
        first, second = inverse_depth.unbind(-1)
        mean = first / alpha.clamp_min(_FAINT)
        bend = self.bend * _bend(self.unit * mean, alpha, image, generator)
        if done < self.spread_from:
            return bend
        variance = self.unit**2 * (second - first * mean)
        return bend + self.spread * variance.clamp_min(0).log1p().mean()


def _bend(
    inverse: Float[Tensor, "h w"],
    alpha: Float[Tensor, "h w"],
    image: Float[Tensor, "h w 3"],
    generator: torch.Generator,
) -> Float[Tensor, ""]:
    """Mean absolute second difference between three pixels in a row or column, with no edge of the image between them.

    Their distance is drawn between 2 pixels and half of the side, evenly in its logarithm: small ones smooth, large
    ones carry the depth of a rim over the whole of a bare surface.
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
