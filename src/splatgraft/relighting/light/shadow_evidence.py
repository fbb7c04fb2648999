"""Evidence for the direction of a scene's dominant light from the shadows that the scene casts on itself.

The scene is shadow-mapped from every candidate direction; visibility times cosine is compared with the brightness of
Gaussians within groups of one material.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.directions import even_directions, frames_along
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import linear_from_srgb
from splatgraft.core.spherical_harmonics import rgb_from_dc
from splatgraft.relighting.light.material_groups import group_materials
from splatgraft.relighting.shading.normals import Normals
from splatgraft.relighting.shadows.shadow_maps import Occluders, Window, occluders_of, splat_depth_maps, visibility


@dataclass(frozen=True)
class ShadowEvidenceSettings:
    """Which Gaussians count, and the model of their brightness; all set by hand."""

    receivers: int = 4000
    """Most Gaussians whose brightness is explained, chosen at random with a fixed seed."""
    fewest: int = 200
    """Receivers; with fewer there is no evidence."""
    receiver_opacity: float = 0.3
    """Opacity below which a Gaussian is no receiver."""
    least_confidence: float = 0.1
    """Of its normal; below it a Gaussian is no receiver."""
    confidence_floor: float = 0.05
    """Confidence of normals that weights never fall below."""
    darkest: float = 0.01
    """sRGB; darker channels count as this."""
    occluders: int = 16000
    """Most Gaussians that block light, chosen at random with a fixed seed and grown to cover the same area."""
    occluder_opacity: float = 0.1
    """Opacity below which a Gaussian blocks no light."""
    occluders_within: float = 1.3
    """Radii of the place within which Gaussians block light."""
    map_size: int = 128
    """Pixels, a multiple of 16: width of a shadow map."""
    bias: float = 1.5
    """Pixels of a map; a nearer occluder is the receiver's own surface."""
    sky_directions: int = 48
    """Directions over the sphere from which ambient visibility is computed."""
    sky_blocked: float = 0.5
    """Share of ambient light that still arrives where the sky is blocked."""
    enclosed: float = 0.6
    """Ambient visibility below which a point is inside something, and is left out."""
    half_weight: float = 0.02
    """Linear brightness at which a receiver has half its weight: almost black ones say little about light."""
    least_log: float = 0.004
    """Linear brightness; darker channels count as this in the logarithm."""
    highlight: float = 4.0
    """Factor on a group's mean brightness; brighter receivers are limited to it, as highlights."""
    other_material: float = 10.0
    """Factor below a group's mean brightness; darker receivers are limited to it, as another material."""
    noise: float = 0.02
    """Standard deviation of log brightness that no light explains."""
    strengths: tuple[float, ...] = (0.3, 0.8, 2.0, 4.0, 8.0)
    """Irradiance facing the light over ambient irradiance, as tried for every direction."""
    strength_range: tuple[float, float, int] = (-1, 1.3, 24)
    """Decimal logarithms of the least and the most strength of the estimate, and how many are tried between them."""
    most_explained: float = 0.99
    """Most share of the variance that one direction is said to explain."""


@dataclass(frozen=True)
class ShadowEvidence:
    """m receivers around a place, their occluders, and the fitted model of their brightness.

    log brightness = log albedo of the group + log(ambient + strength * lit), with one strength for all groups: one per
    group would explain textures too.
    """

    points: Float[Tensor, "m 3"]
    """Centres of the receivers, world units."""
    normals: Float[Tensor, "m 3"]
    """Unit."""
    log_rgb: Float[Tensor, "m 3"]
    """Logarithm of linear brightness, limited around the group's mean."""
    ambient: Float[Tensor, "m"]
    """Share of an even sky that reaches each receiver, in [0.5, 1]."""
    membership: Float[Tensor, "g m"]
    """Weight of each receiver in its material group, 0 in all others."""
    maps: "_ShadowMapper"
    """Shadow maps from any direction."""
    settings: ShadowEvidenceSettings
    """Of the model."""

    def lit(self, directions: Float[Tensor, "d 3"]) -> Float[Tensor, "m d"]:
        """Visibility times cosine of a light in each of d unit directions."""
        return self.maps.lit(self.points, self.normals, directions)

    def explained(self, lit: Float[Tensor, "m d"]) -> Float[Tensor, "d"]:
        """Share of the brightness variance within groups that a light explains beyond ambient light, in [0, 1]."""
        value = self.log_rgb.mean(1)
        without = self._residual((value - self.ambient.log())[:, None])
        tried = [
            self._residual(value[:, None] - (self.ambient[:, None] + strength * lit).log())
            for strength in self.settings.strengths
        ]
        residual = torch.stack(tried).min(0).values
        noise = self.settings.noise**2 * self.membership.sum()
        return (1 - (residual + noise) / (without + noise)).clamp(0, self.settings.most_explained)

    def strength(self, lit: Float[Tensor, "m"]) -> Float[Tensor, "3"]:
        """Irradiance facing the light over ambient irradiance, per channel; searched over `strength_range`."""
        fine = torch.logspace(*self.settings.strength_range)
        modelled = (self.ambient[:, None] + lit[:, None] * fine).log()
        return torch.stack([fine[self._residual(self.log_rgb[:, c : c + 1] - modelled).argmin()] for c in range(3)])

    def _residual(self, values: Float[Tensor, "m d"]) -> Float[Tensor, "d"]:
        """Weighted sum of squares around each group's mean."""
        total = self.membership.sum(1, keepdim=True).clamp_min(1e-9)
        sums = self.membership @ values
        # rounding can make a sum of zero negative
        return (self.membership.sum(0) @ (values * values) - (sums * sums / total).sum(0)).clamp_min(0)


def find_shadow_evidence(
    scene: Gaussians,
    normals: Normals,
    *,
    region: BoundingSphere,
    settings: ShadowEvidenceSettings = ShadowEvidenceSettings(),
) -> ShadowEvidence | None:
    """Receivers and occluders around a place, ready to be compared with light from any direction.

    Args:
        scene: All Gaussians.
        normals: Of all Gaussians.
        region: Receivers lie within it.
        settings: Which Gaussians count.

    Returns:
        None where there are too few receivers.
    """
    receivers = _choose_receivers(scene, normals, region, settings)
    if len(receivers) < settings.fewest:
        return None
    points, facing = scene.means[receivers], normals.vectors[receivers]
    brightness = linear_from_srgb(rgb_from_dc(scene.sh[receivers, 0]).clamp(settings.darkest, 1))
    maps = _ShadowMapper(_choose_occluders(scene, region, settings), region, settings)
    ambient = maps.ambient_visibility(points, facing)
    groups = group_materials(brightness, facing)
    weight = (scene.opacities * normals.confidence.clamp_min(settings.confidence_floor))[receivers]
    weight = weight * (ambient > settings.enclosed)
    gray = brightness.mean(1)
    weight = weight * gray / (gray + settings.half_weight)
    membership = torch.nn.functional.one_hot(groups, int(groups.max()) + 1).T.float() * weight
    log_rgb = brightness.clamp_min(settings.least_log).log()
    mean = (membership @ log_rgb) / membership.sum(1, keepdim=True).clamp_min(1e-9)
    away = (log_rgb - mean[groups]).clamp(-math.log(settings.other_material), math.log(settings.highlight))
    return ShadowEvidence(points, facing, mean[groups] + away, ambient, membership, maps, settings)


def _choose_receivers(
    scene: Gaussians, normals: Normals, region: BoundingSphere, settings: ShadowEvidenceSettings
) -> Int[Tensor, "m"]:
    inside = (scene.means - region.center).norm(dim=1) < region.radius
    good = inside & normals.seen & (scene.opacities > settings.receiver_opacity)
    chosen = (good & (normals.confidence > settings.least_confidence)).nonzero()[:, 0]
    generator = torch.Generator().manual_seed(0)
    return chosen[torch.randperm(len(chosen), generator=generator)[: settings.receivers]]


def _choose_occluders(scene: Gaussians, region: BoundingSphere, settings: ShadowEvidenceSettings) -> Occluders:
    near = (scene.means - region.center).norm(dim=1) < settings.occluders_within * region.radius
    chosen = (near & (scene.opacities > settings.occluder_opacity)).nonzero()[:, 0]
    if len(chosen) <= settings.occluders:
        return occluders_of(scene.select(chosen))
    generator = torch.Generator().manual_seed(0)
    part = scene.select(chosen[torch.randperm(len(chosen), generator=generator)[: settings.occluders]])
    # fewer, wider: together they cover the same area
    grown = part.log_scales + 0.5 * math.log(len(chosen) / settings.occluders)
    return occluders_of(replace(part, log_scales=grown))


@dataclass(frozen=True)
class _ShadowMapper:
    """Shadow maps of occluders around a place, made per call for given directions."""

    occluders: Occluders
    region: BoundingSphere
    settings: ShadowEvidenceSettings

    def lit(
        self, points: Float[Tensor, "m 3"], normals: Float[Tensor, "m 3"], directions: Float[Tensor, "d 3"]
    ) -> Float[Tensor, "m d"]:
        """Visibility times cosine."""
        window = Window(center=self.region.center, radius=self.region.radius, frames=frames_along(directions))
        nearest = torch.full((len(directions),), -self.region.radius)
        maps = splat_depth_maps(self.occluders, window, size=self.settings.map_size, with_color=False, nearest=nearest)
        cosine = (normals @ directions.T).clamp_min(0)
        return visibility(maps, points, normals, bias=self.settings.bias * maps.texel) * cosine

    def ambient_visibility(self, points: Float[Tensor, "m 3"], normals: Float[Tensor, "m 3"]) -> Float[Tensor, "m"]:
        """Share of an even sky that reaches each point."""
        sky, blocked = even_directions(self.settings.sky_directions), self.settings.sky_blocked
        lit = self.lit(points, normals, sky)
        return blocked + (1 - blocked) * lit.sum(1) / (normals @ sky.T).clamp_min(0).sum(1)
