"""Samples of a `Light`: directional lights with one shadow map each.

A source becomes one sample, or several over its cone if it is wide. The ambient light becomes 32 samples spread evenly
over the sphere.
"""

import math
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.directions import even_pairs, vogel_offsets
from splatgraft.relighting.light.light import Light, LightSource

_AMBIENT_SAMPLES = 32  # directions over the sphere, an even number; set by hand
_SOURCE_SAMPLES = 9  # maximum number of samples of all sources together; set by hand
_SINGLE_SOFTNESS = math.radians(8.0)
"""Maximum softness of a source that is one sample. Measured: one filtered map is then within 0.02 of traced rays."""


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
    directions, irradiance, softness, within, distances = [], [], [], [], []
    for source, count in zip(light.sources, _sample_counts(light), strict=False):
        rgb = torch.tensor(source.irradiance) * source.confidence / count
        for direction in _cone_directions(source, count):
            directions.append(direction)
            irradiance.append(rgb)
            within.append(source.blockers_within)
            distances.append(source.distance)
            softness.append(source.softness / math.sqrt(count) if count > 1 else source.softness)
    unsure = sum((torch.tensor(s.irradiance) * (1 - s.confidence) for s in light.sources), torch.zeros(3))
    n = _AMBIENT_SAMPLES
    ambient = even_pairs(n)
    radiance = light.ambient_radiance(ambient) + unsure / (4 * math.pi)
    return LightSamples(
        directions=torch.cat([torch.stack(directions), ambient]) if directions else ambient,
        irradiance=torch.cat(
            [torch.stack(irradiance).reshape(-1, 3) if irradiance else torch.zeros(0, 3), radiance * 4 * math.pi / n]
        ),
        softness=torch.tensor(softness + [math.acos(1 - 2 / n)] * n),
        is_source=(True,) * len(directions) + (False,) * n,
        blockers_within=(*within, *(math.inf,) * n),
        distances=torch.tensor(distances + [math.inf] * n),
    )


def main_source_samples(light: Light) -> int:
    """Return the number of samples of the first source of `light`, which come first."""
    return _sample_counts(light)[0] if light.sources else 0


def _sample_counts(light: Light) -> list[int]:
    """Divide the samples among sources, brightest first.

    Every source gets one. A wide source takes all free samples, or half of them if a later source is wide, too.
    """
    wide = [source.softness > _SINGLE_SOFTNESS for source in light.sources[:_SOURCE_SAMPLES]]
    free = _SOURCE_SAMPLES - len(wide)
    counts = []
    for i, is_wide in enumerate(wide):
        taken = (free + 1) // 2 if any(wide[i + 1 :]) else free
        counts.append(1 + taken if is_wide else 1)
        free -= counts[-1] - 1
    return counts


def _cone_directions(source: LightSource, count: int) -> list[torch.Tensor]:
    """Spread directions over the cone of `source` (Vogel spiral), so that the samples' own cones end at its rim."""
    direction = torch.tensor(source.direction)
    if count == 1:
        return [direction]
    j = torch.arange(count)
    # the variances of the spiral, radius R sqrt(1 - 1/count), and of a sample, radius R / sqrt(count), sum to R^2's
    r = ((j + 0.5) / count * (1 - 1 / count)).sqrt() * math.sin(source.softness)
    offsets = vogel_offsets(direction, r, j)
    offsets = offsets - offsets.mean(0)
    return list(offsets + (1 - (offsets**2).sum(1, keepdim=True)).sqrt() * direction)
