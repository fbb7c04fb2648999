"""Samples of a `Light`: directional lights with one shadow map each.

A source becomes one sample. The ambient light becomes 32 samples spread evenly over the sphere.
"""

import math
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.directions import even_pairs
from splatgraft.relighting.light.light import Light

_AMBIENT_SAMPLES = 32  # directions over the sphere, an even number; set by hand


@dataclass(frozen=True)
class LightSamples:
    """k samples whose sum is the light at a place; samples of sources come first."""

    directions: Float[Tensor, "k 3"]
    """Unit vectors towards the light."""
    irradiance: Float[Tensor, "k 3"]
    """Linear rgb irradiance on a plane that faces the sample."""
    softness: Float[Tensor, "k"]
    """Radius of the sample's cone of directions, radians."""
    is_source: tuple[bool, ...]
    """Whether a sample belongs to a source, not to the ambient light."""
    blockers_within: tuple[float, ...]
    """Maximum distance of occluders that block the sample, world units."""
    distances: Float[Tensor, "k"]
    """Distances from the middle of the place, world units; infinite for directional samples."""

    def __len__(self) -> int:
        """Number of samples k."""
        return len(self.is_source)

    @property
    def of_sources(self) -> "LightSamples":
        """The samples of sources."""
        return self._part(slice(None, sum(self.is_source)))

    @property
    def of_ambient(self) -> "LightSamples":
        """The ambient samples; the directions of the second half are opposite to those of the first."""
        return self._part(slice(sum(self.is_source), None))

    def _part(self, rows: slice) -> "LightSamples":
        return LightSamples(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})


def sample_light(light: Light) -> LightSamples:
    """Sample a light: first its sources, brightest first, then its ambient light.

    A source of confidence c gives the share c of its irradiance to its own samples and the rest to the ambient ones.
    Thus a source that may not exist casts a weaker shadow.
    """
    sources = light.sources
    rgb = torch.tensor([source.irradiance for source in sources]).reshape(-1, 3)
    certain = torch.tensor([source.confidence for source in sources]).reshape(-1, 1)
    n = _AMBIENT_SAMPLES
    ambient = even_pairs(n)
    radiance = light.ambient_radiance(ambient) + ((1 - certain) * rgb).sum(0) / (4 * math.pi)
    return LightSamples(
        directions=torch.cat([torch.tensor([s.direction for s in sources]).reshape(-1, 3), ambient]),
        irradiance=torch.cat([certain * rgb, radiance * 4 * math.pi / n]),
        softness=torch.tensor([s.softness for s in sources] + [math.acos(1 - 2 / n)] * n),
        is_source=(True,) * len(sources) + (False,) * n,
        blockers_within=(*(s.blockers_within for s in sources), *(math.inf,) * n),
        distances=torch.tensor([s.distance for s in sources] + [math.inf] * n),
    )
