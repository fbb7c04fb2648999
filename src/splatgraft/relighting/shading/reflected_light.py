"""Radiance of a light averaged over lobes around reflected directions: what a glossy surface shows of its light.

Lobes are von Mises-Fisher densities (reflection as convolution, Ramamoorthi and Hanrahan 2001): each light sample is
convolved with one by adding variances, the ambient harmonics by the lobe's own coefficients.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.relighting.light.light import Light
from splatgraft.relighting.shadows.light_sampling import LightSamples


@dataclass(frozen=True)
class ReflectedLight:
    """A light as n surface points reflect it."""

    directions: Float[Tensor, "k 3"]
    """Unit, towards the samples of its sources."""
    irradiance: Float[Tensor, "k 3"]
    """Linear rgb of each sample."""
    softness: Float[Tensor, "k"]
    """Radius of each sample's cone, radians."""
    visibility: Float[Tensor, "n k"]
    """Share of each sample that reaches each point, in [0, 1]."""
    ambient: Float[Tensor, "9 3"]
    """Radiance of everything else, harmonics of degree 2."""

    def select(self, rows: slice | Int[Tensor, "m"]) -> "ReflectedLight":
        """The light at some of the points."""
        return replace(self, visibility=self.visibility[rows])

    def scaled(self, factor: Float[Tensor, "3"]) -> "ReflectedLight":
        """The light with every channel multiplied by a factor."""
        return replace(self, irradiance=self.irradiance * factor, ambient=self.ambient * factor)

    def radiance(self, directions: Float[Tensor, "n v 3"], concentration: float) -> Float[Tensor, "n v 3"]:
        """Linear rgb radiance at n points, averaged over lobes around v unit directions each.

        Args:
            directions: Unit, away from the surface.
            concentration: Of the lobes; one over the square of their width in radians.
        """
        first = 1 / math.tanh(concentration) - 1 / concentration
        bands = torch.tensor([1.0] + [first] * 3 + [1 - 3 * first / concentration] * 5)
        total = (spherical_harmonics.basis(directions, 2) @ (bands[:, None] * self.ambient)).clamp_min(0)
        for i in range(len(self.directions)):
            # per axis the variance of a cone of radius r is r^2 / 4, that of a lobe is 1 / concentration
            k = 1 / (1 / concentration + 0.25 * float(self.softness[i]) ** 2)
            peak = k / (2 * math.pi * (1 - math.exp(-2 * k)))
            lobe = peak * torch.exp(k * (directions @ self.directions[i] - 1)) * self.visibility[:, i : i + 1]
            total = total + lobe[..., None] * self.irradiance[i]
        return total


def reflected_light(light: Light, samples: LightSamples, visibility: Float[Tensor, "n k"]) -> ReflectedLight:
    """The light as n points reflect it.

    Args:
        light: The light.
        samples: Of that light, k.
        visibility: Share of each sample that reaches each point, in [0, 1].
    """
    which = torch.as_tensor(samples.is_source)
    unsure = sum((torch.tensor(s.irradiance) * (1 - s.confidence) for s in light.sources), torch.zeros(3))
    ambient = light.ambient.clone()
    ambient[0] += unsure / (4 * math.pi * spherical_harmonics.C0)
    return ReflectedLight(
        directions=samples.directions[which],
        irradiance=samples.irradiance[which],
        softness=samples.softness[which],
        visibility=visibility[:, which],
        ambient=ambient,
    )
