"""Evidence for the light from the shading and the shadows of the surfaces around a place.

The scene is shadow-mapped from every direction: visibility times cosine, the transport, says how much of the light
from each direction arrives at each surface. Surfaces are grouped by colour and position, one material per group.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.directions import frames_along
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import linear_from_srgb
from splatgraft.core.k_means import k_means
from splatgraft.core.spherical_harmonics import rgb_from_dc
from splatgraft.relighting.light.material_groups import log_chromaticity
from splatgraft.relighting.light.surroundings import DIRECTIONS, FARTHEST, nearest_directions
from splatgraft.relighting.shading.normals import Normals
from splatgraft.relighting.shadows.shadow_maps import Occluders, Window, occluders_of, splat_depth_maps, visibility

_CHUNK = 100
"""Receivers at a time; bounds memory."""


@dataclass(frozen=True)
class ShadingEvidenceSettings:
    """Which Gaussians count, and how they are grouped; none of these numbers is sensitive."""

    receivers: int = 1000
    """Most Gaussians whose brightness is explained, chosen at random with a fixed seed."""
    fewest: int = 200
    """Receivers; with fewer there is no evidence."""
    receiver_opacity: float = 0.3
    """Opacity below which a Gaussian is no receiver."""
    least_confidence: float = 0.1
    """Of its normal; below it a Gaussian is no receiver."""
    darkest: float = 0.01
    """sRGB; darker channels count as this."""
    half_weight: float = 0.02
    """Linear brightness at which a receiver has half its weight: almost black ones say little about light."""
    enclosed: float = 0.15
    """Share of the directions above a surface that are open; with less it is inside something, and is left out."""
    occluders: int = 16000
    """Most Gaussians that block light, chosen at random with a fixed seed and grown to cover the same area."""
    occluder_opacity: float = 0.1
    """Opacity below which a Gaussian blocks no light."""
    occluders_within: float = 1.3
    """Radii of the region within which Gaussians block light."""
    map_size: int = 128
    """Pixels, a multiple of 16: width of a shadow map."""
    bias: float = 1.5
    """Pixels of a map; a nearer occluder is the receiver's own surface."""
    materials: int = 24
    """Groups."""
    rounds: int = 12
    """Iterations of k-means."""
    green_magenta: float = 0.25
    """Unit of log(green / sqrt(red blue)) among the features, where that of log(red / blue) is 1."""
    extent: float = 0.4
    """Radii of the region; the unit of position among the features."""


@dataclass(frozen=True)
class ShadingEvidence:
    """m receivers around a place, and what blocks the light from the k `DIRECTIONS` to them."""

    region: BoundingSphere
    """They lie within it; its middle is the place."""
    points: Float[Tensor, "m 3"]
    """Centres, world units."""
    normals: Float[Tensor, "m 3"]
    """Unit."""
    visibility: Float[Tensor, "m k"]
    """In [0, 1]."""
    colors: Float[Tensor, "m 3"]
    """Linear rgb."""
    weights: Float[Tensor, "m"]
    """By visible area and certainty; they sum to 1."""
    material: Int[Tensor, "m"]
    """Group of each receiver, from 0."""

    @property
    def distance(self) -> Float[Tensor, "m"]:
        """From the middle of the region, in its radii."""
        return (self.points - self.region.center).norm(dim=1) / self.region.radius

    def transport(self, distances: Float[Tensor, "k"] | None = None) -> Float[Tensor, "m k"]:
        """Visibility times cosine, scaled so that an open surface's row sums to 1.

        transport @ radiance is the radiance of a white surface.

        Args:
            distances: World units, from the middle of the region to what shines from each of the `DIRECTIONS`: other
                places see it in other directions, and larger where it is nearer. Infinitely far where not given.
        """
        if distances is None:
            return _transported(self.visibility, (self.normals @ DIRECTIONS.T).clamp_min(0))
        lights = self.region.center + DIRECTIONS * distances.clamp(self.region.radius, FARTHEST)[:, None]
        rows = [self._near_transport(part, lights) for part in torch.arange(len(self.points)).split(_CHUNK)]
        return torch.cat(rows) if rows else self.visibility

    def _near_transport(self, part: Int[Tensor, "p"], lights: Float[Tensor, "k 3"]) -> Float[Tensor, "p k"]:
        """Of some receivers, for lights at places in world units."""
        away = lights - self.points[part, None]
        apart = away.norm(dim=2, keepdim=True).clamp_min(1e-6)
        towards = away / apart
        cosine = (towards * self.normals[part, None]).sum(2).clamp_min(0)
        # solid angle of what shines, over that from the middle; it faces the middle
        facing = (towards * DIRECTIONS).sum(2).clamp_min(0)
        size = facing * ((lights - self.region.center).norm(dim=1) / apart[..., 0]) ** 2
        seen = self.visibility[part].gather(1, nearest_directions(towards.reshape(-1, 3)).reshape(cosine.shape))
        return _transported(seen, cosine * size)


def find_shading_evidence(
    scene: Gaussians,
    normals: Normals,
    *,
    region: BoundingSphere,
    settings: ShadingEvidenceSettings = ShadingEvidenceSettings(),
) -> ShadingEvidence:
    """Receivers around a place and the transport of light to them; none where there are too few.

    Args:
        scene: All Gaussians.
        normals: Of all Gaussians.
        region: Receivers lie within it.
        settings: Which Gaussians count.
    """
    chosen = _receivers(scene, normals, region, settings)
    if len(chosen) < settings.fewest:
        return _nothing(region)
    points, facing = scene.means[chosen], normals.vectors[chosen]
    colors = linear_from_srgb(rgb_from_dc(scene.sh[chosen, 0]).clamp(settings.darkest, 1))
    visible = _visibility(_occluders(scene, region, settings), points, facing, region=region, settings=settings)
    open_ = _transported(visible, (facing @ DIRECTIONS.T).clamp_min(0)).sum(1)
    area = scene.scales[chosen].sort(1).values[:, 1:].prod(1)
    certain = scene.opacities[chosen] * normals.confidence[chosen].clamp_min(0.05)
    weights = certain * area.clamp_max(4 * float(area.median()))
    gray = colors.mean(1)
    weights = weights * (gray / (gray + settings.half_weight)) * (open_ > settings.enclosed)
    if float(weights.sum()) <= 0:
        return _nothing(region)
    return ShadingEvidence(
        region=region,
        points=points,
        normals=facing,
        visibility=visible,
        colors=colors,
        weights=weights / weights.sum(),
        material=_materials(colors, points, region, settings),
    )


def _transported(visibility: Float[Tensor, "m k"], weight: Float[Tensor, "m k"]) -> Float[Tensor, "m k"]:
    return visibility * weight / weight.sum(1, keepdim=True).clamp_min(1e-6)


def _nothing(region: BoundingSphere) -> ShadingEvidence:
    none, index = torch.zeros(0, 3), torch.zeros(0, dtype=torch.int64)
    return ShadingEvidence(region, none, none, torch.zeros(0, len(DIRECTIONS)), none, torch.zeros(0), index)


def _receivers(
    scene: Gaussians, normals: Normals, region: BoundingSphere, settings: ShadingEvidenceSettings
) -> Int[Tensor, "m"]:
    inside = (scene.means - region.center).norm(dim=1) < region.radius
    good = inside & normals.seen & (scene.opacities > settings.receiver_opacity)
    chosen = (good & (normals.confidence > settings.least_confidence)).nonzero()[:, 0]
    generator = torch.Generator().manual_seed(0)
    return chosen[torch.randperm(len(chosen), generator=generator)[: settings.receivers]]


def _occluders(scene: Gaussians, region: BoundingSphere, settings: ShadingEvidenceSettings) -> Occluders:
    near = (scene.means - region.center).norm(dim=1) < settings.occluders_within * region.radius
    chosen = (near & (scene.opacities > settings.occluder_opacity)).nonzero()[:, 0]
    if len(chosen) <= settings.occluders:
        return occluders_of(scene.select(chosen))
    generator = torch.Generator().manual_seed(0)
    part = scene.select(chosen[torch.randperm(len(chosen), generator=generator)[: settings.occluders]])
    # fewer, wider: together they cover the same area
    grown = part.log_scales + 0.5 * math.log(len(chosen) / settings.occluders)
    return occluders_of(replace(part, log_scales=grown))


def _visibility(
    occluders: Occluders,
    points: Float[Tensor, "m 3"],
    normals: Float[Tensor, "m 3"],
    *,
    region: BoundingSphere,
    settings: ShadingEvidenceSettings,
) -> Float[Tensor, "m k"]:
    window = Window(center=region.center, radius=region.radius, frames=frames_along(DIRECTIONS))
    nearest = torch.full((len(DIRECTIONS),), -region.radius)
    maps = splat_depth_maps(occluders, window, size=settings.map_size, with_color=False, nearest=nearest)
    return visibility(maps, points, normals, bias=settings.bias * maps.texel)


def _materials(
    colors: Float[Tensor, "m 3"],
    points: Float[Tensor, "m 3"],
    region: BoundingSphere,
    settings: ShadingEvidenceSettings,
) -> Int[Tensor, "m"]:
    """Groups of similar colour and position, not of similar normals: those would hide the light."""
    chroma = log_chromaticity(colors.clamp_min(1e-3)) / torch.tensor([1.0, settings.green_magenta])
    features = torch.cat([chroma, (points - region.center) / (settings.extent * region.radius)], 1)
    generator = torch.Generator().manual_seed(0)
    start = features[torch.randperm(len(features), generator=generator)[: settings.materials]]
    return torch.cdist(features, k_means(features, start, rounds=settings.rounds)).argmin(1)
