"""A `Light` cut into bundles that depth maps can follow: up to 9 for sources, 32 for the rest. Knows no Gaussians."""

import math

import torch
from jaxtyping import Int
from torch import Tensor

from splatgraft.core.directions import even_pairs, frames_along
from splatgraft.relighting.light.light import Light, LightSource
from splatgraft.relighting.shadows.occlusion import LightSamples

AMBIENT_COUNT = 32
SOURCE_SAMPLES = 9
# up to this softness one filtered map is within 0.02 of the truth; beyond, several are used
_SINGLE = math.radians(8.0)


def sample_light(light: Light) -> LightSamples:
    """All bundles of `light`: those of the sources first, then the ambient ones.

    What a source's confidence leaves is given back as even light, so an unsure source casts a weaker shadow.
    """
    directions, irradiance, softness, within = [], [], [], []
    for source, parts in zip(light.sources, _parts(light), strict=False):
        rgb = torch.tensor(source.irradiance) * source.confidence / parts
        for direction in _disk(source, parts):
            directions.append(direction)
            irradiance.append(rgb)
            within.append(source.blockers_within)
            softness.append(source.softness / math.sqrt(parts) if parts > 1 else source.softness)
    doubt = sum((torch.tensor(s.irradiance) * (1 - s.confidence) for s in light.sources), torch.zeros(3))
    around = even_pairs(AMBIENT_COUNT)
    radiance = light.ambient_radiance(around) + doubt / (4 * math.pi)
    return LightSamples(
        directions=torch.cat([torch.stack(directions), around]) if directions else around,
        irradiance=torch.cat(
            [torch.stack(irradiance).reshape(-1, 3) if irradiance else torch.zeros(0, 3), radiance * 4 * math.pi / 32]
        ),
        softness=torch.tensor(softness + [math.acos(1 - 2 / AMBIENT_COUNT)] * AMBIENT_COUNT),
        is_source=(True,) * len(directions) + (False,) * AMBIENT_COUNT,
        blockers_within=(*within, *(math.inf,) * AMBIENT_COUNT),
    )


def main_count(light: Light) -> int:
    """How many of the first bundles belong to the first source."""
    return _parts(light)[0] if light.sources else 0


def _parts(light: Light) -> list[int]:
    """Bundles per source, brightest first: as many for a wide one as are free; half of those where others are wide."""
    wide = [source.softness > _SINGLE for source in light.sources[:SOURCE_SAMPLES]]
    free = SOURCE_SAMPLES - len(wide)
    parts = []
    for i, is_wide in enumerate(wide):
        taken = (free + 1) // 2 if any(wide[i + 1 :]) else free
        parts.append(1 + taken if is_wide else 1)
        free -= parts[-1] - 1
    return parts


def source_pairs(beams: LightSamples) -> tuple[LightSamples, Int[Tensor, "k"], Int[Tensor, "k"]]:
    """The bundles of sources, and where in `cat(directions, -directions)` each one's front and back lie."""
    return _part(beams, source=True)


def ambient_pairs(beams: LightSamples) -> tuple[LightSamples, Int[Tensor, "k"], Int[Tensor, "k"]]:
    """The ambient bundles, and each one's front and back among themselves, as opposites are in the set."""
    return _part(beams, source=False)


def _part(beams: LightSamples, *, source: bool) -> tuple[LightSamples, Int[Tensor, "k"], Int[Tensor, "k"]]:
    which = torch.tensor([flag == source for flag in beams.is_source])
    count = int(which.sum())
    part = LightSamples(
        directions=beams.directions[which],
        irradiance=beams.irradiance[which],
        softness=beams.softness[which],
        is_source=(source,) * count,
        blockers_within=tuple(beams.blockers_within[int(i)] for i in which.nonzero()[:, 0]),
    )
    front = torch.arange(count)
    return part, front, front + count if source else (front + count // 2) % max(count, 1)


def _disk(source: LightSource, parts: int) -> list[torch.Tensor]:
    """Directions spread over the cone of `source` (Vogel spiral), within it by as much as a part's own cone is wide."""
    direction = torch.tensor(source.direction)
    if parts == 1:
        return [direction]
    right, down, _ = frames_along(direction[None])[0]
    j = torch.arange(parts)
    # variances add: of the spiral, radius R sqrt(1 - 1/parts), and of a part, radius R / sqrt(parts)
    r = ((j + 0.5) / parts * (1 - 1 / parts)).sqrt() * math.sin(source.softness)
    angle = j * math.pi * (3 - math.sqrt(5))
    side = (r * angle.cos())[:, None] * right + (r * angle.sin())[:, None] * down
    side = side - side.mean(0)
    return list(side + (1 - (side**2).sum(1, keepdim=True)).sqrt() * direction)
