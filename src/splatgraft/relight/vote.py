"""Where a scene's dominant light comes from, told by the shadows that the scene casts on itself.

For each of some 500 directions the scene is shadow-mapped from there; the direction whose visibility times cosine best
explains the brightness within groups of one material wins. Knows nothing about panoramas, objects or files.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatgraft.gaussians import Gaussians
from splatgraft.images import linear_from_srgb
from splatgraft.relight.directions import even_directions, frames_along
from splatgraft.relight.normals import Normals
from splatgraft.relight.visibility import Window, splat_depth_maps, visibility
from splatgraft.spherical_harmonics import rgb_from_dc

_DIRECTIONS = 1024  # on the sphere; those above the horizon, about half, are tried
_LOWEST = math.radians(5)
_RECEIVERS = 6000
_OCCLUDERS = 40000
_GROUPS = 48
_MAP_SIZE = 128


@dataclass(frozen=True)
class Vote:
    """What the shadows say."""

    direction: Float[Tensor, "3"]
    """Unit, towards the light."""
    uncertainty: float
    """Standard deviation of `direction`, radians."""
    strength: Float[Tensor, "3"]
    """Irradiance facing the light over the irradiance of the ambient light that was given, linear rgb."""
    confidence: float
    """0 where shadows say nothing, 1 where one direction explains them alone."""
    explained: float
    """Share of the brightness variance within materials that the light explains."""
    directions: Float[Tensor, "d 3"]
    """All that were tried."""
    scores: Float[Tensor, "d"]
    """`explained` of each."""


def vote(
    scene: Gaussians, normals: Normals, *, center: Float[Tensor, "3"], radius: float, up: Float[Tensor, "3"]
) -> Vote | None:
    """Ask the shadows within `radius` of `center`; None where there are too few surfaces to ask.

    `strength` is relative to an ambient irradiance of 1 on an open plane.
    """
    receivers = _receivers(scene, normals, center, radius)
    if len(receivers) < 200:
        return None
    points, facing = scene.means[receivers], normals.vectors[receivers]
    brightness = linear_from_srgb(rgb_from_dc(scene.sh[receivers, 0]).clamp(0.01, 1))
    occluders = _occluders(scene, center, radius)
    ambient = _openness(occluders, points, facing, center=center, radius=radius)
    groups = _materials(brightness, facing)
    weight = (scene.opacities * normals.confidence.clamp_min(0.05))[receivers]
    directions = even_directions(_DIRECTIONS)
    directions = directions[directions @ up > math.sin(_LOWEST)]
    lit = _lit(occluders, points, facing, directions, center=center, radius=radius)
    fit = _Fit.of(brightness, ambient, groups, weight)
    scores = fit.explained(lit)
    best = int(scores.argmax())
    # finer: a cap of directions around the best
    finer = _cap(directions[best], math.radians(7), 48)
    finer = finer[finer @ up > math.sin(_LOWEST)]
    lit_finer = _lit(occluders, points, facing, finer, center=center, radius=radius)
    directions, scores = torch.cat([directions, finer]), torch.cat([scores, fit.explained(lit_finer)])
    lit = torch.cat([lit, lit_finer], 1)
    top = float(scores.max())
    # the top of the curve is the estimate, its width the doubt
    share = ((scores - 0.85 * top) / max(0.15 * top, 1e-9)).clamp_min(0)
    direction = torch.nn.functional.normalize((share[:, None] * directions).sum(0), dim=0)
    angle = torch.acos((directions @ direction).clamp(-1, 1))
    uncertainty = float(((share * angle**2).sum() / share.sum().clamp_min(1e-9)).sqrt())
    nearest = int((directions @ direction).argmax())
    typical = float(scores.median())
    contrast = (top - typical) / max(top, 1e-9)
    significance = top / (top + 0.06)
    confidence = significance * min(1.0, 1.6 * contrast) * math.exp(-((uncertainty / math.radians(35)) ** 2))
    return Vote(
        direction=direction,
        uncertainty=max(uncertainty, math.radians(2)),
        strength=fit.strength(lit[:, nearest]),
        confidence=confidence,
        explained=top,
        directions=directions,
        scores=scores,
    )


def _receivers(scene: Gaussians, normals: Normals, center: Float[Tensor, "3"], radius: float) -> Int[Tensor, "m"]:
    inside = (scene.means - center).norm(dim=1) < radius
    good = inside & (scene.opacities > 0.3) & (normals.confidence > 0.1)
    chosen = good.nonzero()[:, 0]
    generator = torch.Generator().manual_seed(0)
    return chosen[torch.randperm(len(chosen), generator=generator)[:_RECEIVERS]]


def _occluders(scene: Gaussians, center: Float[Tensor, "3"], radius: float) -> Gaussians:
    near = (scene.means - center).norm(dim=1) < 1.3 * radius
    chosen = (near & (scene.opacities > 0.1)).nonzero()[:, 0]
    if len(chosen) <= _OCCLUDERS:
        return scene.select(chosen)
    generator = torch.Generator().manual_seed(0)
    part = scene.select(chosen[torch.randperm(len(chosen), generator=generator)[:_OCCLUDERS]])
    # fewer, wider: together they cover the same area
    grown = part.log_scales + 0.5 * math.log(len(chosen) / _OCCLUDERS)
    return Gaussians(part.means, grown, part.quaternions, part.opacity_logits, part.sh)


def _lit(
    occluders: Gaussians,
    points: Float[Tensor, "m 3"],
    normals: Float[Tensor, "m 3"],
    directions: Float[Tensor, "d 3"],
    *,
    center: Float[Tensor, "3"],
    radius: float,
) -> Float[Tensor, "m d"]:
    """Visibility times cosine."""
    window = Window(center=center, radius=radius, frames=frames_along(directions))
    maps = splat_depth_maps(occluders, window, size=_MAP_SIZE, depth_range=(-radius, radius))
    cosine = (normals @ directions.T).clamp_min(0)
    return visibility(maps, points, normals, bias=1.5 * maps.texel) * cosine


def _openness(
    occluders: Gaussians,
    points: Float[Tensor, "m 3"],
    normals: Float[Tensor, "m 3"],
    *,
    center: Float[Tensor, "3"],
    radius: float,
) -> Float[Tensor, "m"]:
    """Share of an even sky that reaches each point; what is blocked brings half."""
    around = even_directions(64)
    lit = _lit(occluders, points, normals, around, center=center, radius=radius)
    return 0.5 + 0.5 * lit.sum(1) / (normals @ around.T).clamp_min(0).sum(1)


def _materials(brightness: Float[Tensor, "m 3"], normals: Float[Tensor, "m 3"]) -> Int[Tensor, "m"]:
    """k-means on chromaticity and normal: brightness itself is left out, or lit and shaded would part."""
    log_rgb = brightness.clamp_min(1e-3).log()
    chroma = torch.stack([log_rgb[:, 0] - log_rgb[:, 1], log_rgb[:, 2] - log_rgb[:, 1]], 1)
    features = torch.cat([chroma / 0.25, normals / 0.5], 1)
    generator = torch.Generator().manual_seed(0)
    count = min(_GROUPS, max(2, len(features) // 60))
    middles = features[torch.randperm(len(features), generator=generator)[:count]]
    label = torch.zeros(len(features), dtype=torch.long)
    for _ in range(8):
        label = torch.cdist(features, middles).argmin(1)
        sums = torch.zeros_like(middles).index_add_(0, label, features)
        counts = torch.bincount(label, minlength=count).clamp_min(1)[:, None]
        middles = sums / counts
    return label


@dataclass(frozen=True)
class _Fit:
    """Least squares of brightness on (ambient, lit) in every group at once."""

    member: Float[Tensor, "g m"]
    """Weight of each receiver in its group, divided by the group's mean brightness squared."""
    brightness: Float[Tensor, "m 3"]
    ambient: Float[Tensor, "m"]

    @staticmethod
    def of(
        brightness: Float[Tensor, "m 3"], ambient: Float[Tensor, "m"], groups: Int[Tensor, "m"], weight: Tensor
    ) -> "_Fit":
        count = int(groups.max()) + 1
        member = torch.nn.functional.one_hot(groups, count).T.float() * weight
        mean = (member @ brightness.mean(1)) / member.sum(1).clamp_min(1e-9)
        # no receiver counts for more than three times its group's mean: glints are not light on a surface
        limit = 3 * mean[groups]
        brightness = brightness * (limit / brightness.mean(1).clamp_min(1e-6)).clamp_max(1)[:, None]
        return _Fit(member / mean.clamp_min(1e-3)[:, None] ** 2, brightness, ambient)

    def _sums(self, lit: Float[Tensor, "m d"]) -> tuple[Tensor, Tensor, Tensor]:
        a = self.ambient[:, None]
        return self.member @ (a * a), self.member @ (a * lit), self.member @ (lit * lit)

    def explained(self, lit: Float[Tensor, "m d"]) -> Float[Tensor, "d"]:
        """Share of the squared error of the ambient-only model that a light from each direction removes."""
        b, a = self.brightness.mean(1, keepdim=True), self.ambient[:, None]
        aa, ax, xx = self._sums(lit)
        ba, bx, bb = self.member @ (b * a), self.member @ (b * lit), self.member @ (b * b)
        residual = bb - ba * ba / aa.clamp_min(1e-12)
        slope_variance = (xx - ax * ax / aa.clamp_min(1e-12)).clamp_min(0)
        covariance = (bx - ba * ax / aa.clamp_min(1e-12)).clamp_min(0)
        # a group in which hardly anything is lit differently has nothing to say: the ridge is 1% of its weight
        ridge = 0.01 * xx + 0.003 * aa
        gain = covariance**2 / (slope_variance + ridge)
        return gain.sum(0) / residual.sum().clamp_min(1e-12)

    def strength(self, lit: Float[Tensor, "m"]) -> Float[Tensor, "3"]:
        """Irradiance facing the light over ambient irradiance, per channel: a mean over groups by what they know."""
        x, a = lit[:, None], self.ambient[:, None]
        aa, ax, xx = self._sums(x)
        ba, bx = self.member @ (self.brightness * a), self.member @ (self.brightness * x)
        determinant = (aa * xx - ax * ax).clamp_min(1e-12)
        shade, light = (ba * xx - bx * ax) / determinant, (bx * aa - ba * ax) / determinant
        ratio = (light / shade.clamp_min(0.05 * ba / aa.clamp_min(1e-12))).clamp(0, 12)
        known = (xx - ax * ax / aa.clamp_min(1e-12)).clamp_min(0)
        known = known * (aa > 0)
        # a mean of log(1 + ratio), so that one group without a shaded part does not decide
        log_ratio = (known * (1 + ratio).log()).sum(0) / known.sum().clamp_min(1e-12)
        return log_ratio.exp() - 1


def _cap(axis: Float[Tensor, "3"], radius: float, count: int) -> Float[Tensor, "n 3"]:
    """Directions spread evenly within `radius` radians of `axis`."""
    right, down, _ = frames_along(axis[None])[0]
    i = torch.arange(count) + 0.5
    r, angle = (i / count).sqrt() * math.sin(radius), i * math.pi * (3 - math.sqrt(5))
    side = (r * angle.cos())[:, None] * right + (r * angle.sin())[:, None] * down
    return side + (1 - r * r).sqrt()[:, None] * axis
