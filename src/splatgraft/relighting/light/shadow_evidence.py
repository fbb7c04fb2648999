"""Where a scene's dominant light comes from, told by the shadows that the scene casts on itself, and by what glints.

For each of some 200 directions the scene is shadow-mapped from there; the direction whose visibility times cosine best
explains the brightness within groups of one material, and whose mirror image best explains how colours change from
view to view, wins. Knows nothing about panoramas, objects or files.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatgraft.core.directions import even_directions, frames_along
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import linear_from_srgb
from splatgraft.core.spherical_harmonics import rgb_from_dc
from splatgraft.relighting.light.highlight_evidence import Highlights
from splatgraft.relighting.light.material_groups import group_materials
from splatgraft.relighting.shading.normals import Normals
from splatgraft.relighting.shadows.shadow_maps import Occluders, Window, occluders_of, splat_depth_maps, visibility

_DIRECTIONS = 320  # on the sphere; those above the horizon, about half, are tried
_CAP, _FINER = math.radians(14), 64  # around the best, where directions are tried more closely
_LOWEST = math.radians(5)
_RECEIVERS = 4000
_OCCLUDERS = 16000
_MAP_SIZE = 128
# errors in visibility make a least-squares slope too small, the more, the less of the brightness it explains
_ATTENUATION, _ATTENUATED = 2.5, 0.25
_HIDDEN = 0.6  # openness below which a point is inside something
_OF_GLINTS = math.radians(9)
_PLAIN_GLINT = 0.25
_NOISE = 0.02  # of log brightness: what no light explains
_STRENGTHS = (0.3, 0.8, 2.0, 4.0, 8.0)


@dataclass(frozen=True)
class DirectionEstimate:
    """What shadows and highlights say."""

    direction: Float[Tensor, "3"]
    """Unit, towards the light."""
    uncertainty: float
    """Standard deviation of `direction`, radians."""
    strength: Float[Tensor, "3"]
    """Irradiance facing the light over the irradiance of the ambient light that was given, linear rgb."""
    confidence: float
    """0 where neither says anything, 1 where one direction explains all."""
    explained: float
    """Share of the brightness variance within materials that the light explains: shadows alone."""
    heard: float
    """How much highlights say, in [0, 1]."""


def estimate_direction(
    scene: Gaussians,
    normals: Normals,
    *,
    center: Float[Tensor, "3"],
    radius: float,
    up: Float[Tensor, "3"],
    highlights: Highlights | None = None,
) -> DirectionEstimate | None:
    """Ask the shadows within `radius` of `center`, and `highlights`; None where there are too few surfaces to ask.

    `strength` is relative to an ambient irradiance of 1 on an open plane, and told by shadows alone.
    """
    receivers = _receivers(scene, normals, center, radius)
    if len(receivers) < 200:
        return None
    points, facing = scene.means[receivers], normals.vectors[receivers]
    brightness = linear_from_srgb(rgb_from_dc(scene.sh[receivers, 0]).clamp(0.01, 1))
    occluders = _occluders(scene, center, radius)
    ambient = _openness(occluders, points, facing, center=center, radius=radius)
    groups = group_materials(brightness, facing)
    weight = (scene.opacities * normals.confidence.clamp_min(0.05))[receivers]
    directions = even_directions(_DIRECTIONS)
    directions = directions[directions @ up > math.sin(_LOWEST)]
    lit = _lit(occluders, points, facing, directions, center=center, radius=radius)
    fit = _Fit.of(brightness, ambient, groups, weight * (ambient > _HIDDEN))
    glints = _glints(highlights, directions)
    trust = _trust(glints)
    coarse = _together(fit.explained(lit)[0], glints, trust)
    # finer: a cap of directions around the best
    finer = _cap(directions[int(coarse.argmax())], _CAP, _FINER)
    finer = finer[finer @ up > math.sin(_LOWEST)]
    lit = _lit(occluders, points, facing, finer, center=center, radius=radius)
    shadows, glints = fit.explained(lit)[0], _glints(highlights, finer)
    scores = _together(shadows, glints, trust)
    top, typical = float(scores.max()), float(coarse.median())
    # the top of the curve is the estimate, its width the doubt
    share = ((scores - 0.85 * top) / max(0.15 * top, 1e-9)).clamp_min(0)
    direction = torch.nn.functional.normalize((share[:, None] * finer).sum(0), dim=0)
    angle = torch.acos((finer @ direction).clamp(-1, 1))
    width = float(((share * angle**2).sum() / share.sum().clamp_min(1e-9)).sqrt())
    nearest = int((finer @ direction).argmax())
    told = float(shadows[nearest])
    # measured on synthetic scenes: the less the best direction explains of the shadows, the farther it is from the
    # truth; highlights know the azimuth, and err by 9 degrees in height
    heard = trust * float(glints[nearest]) / (float(glints[nearest]) + 0.1)
    weight = math.radians(3 + 16 * math.exp(-told / 0.15)) ** -2 + heard / _OF_GLINTS**2
    contrast = (top - typical) / max(top, 1e-9)
    return DirectionEstimate(
        direction=direction,
        uncertainty=math.hypot((1 - heard) * width, weight**-0.5),
        strength=(1 + _ATTENUATION * math.exp(-told / _ATTENUATED)) * fit.strength(lit[:, nearest]),
        confidence=top / (top + 0.08) * min(1.0, 1.6 * contrast),
        explained=told,
        heard=heard,
    )


def _glints(highlights: Highlights | None, directions: Float[Tensor, "d 3"]) -> Float[Tensor, "d"]:
    return torch.zeros(len(directions)) if highlights is None else highlights.explained(directions)


def _trust(glints: Float[Tensor, "d"]) -> float:
    """How far the best direction of highlights may be the main light's, in [0, 1].

    Over rendered scenes with known light it was so wherever it explained more than a quarter of what changes from view
    to view. A lamp close overhead has no one direction to mirror: then what is left of a far window glints instead.
    """
    return min(1.0, (float(glints.max()) / _PLAIN_GLINT) ** 2) if len(glints) else 0.0


def _together(shadows: Float[Tensor, "d"], glints: Float[Tensor, "d"], trust: float) -> Float[Tensor, "d"]:
    """Share that stays unexplained is a likelihood: those of independent witnesses multiply.

    Trusted highlights count twice: where both speak, over the same scenes, they were nearer to the truth.
    """
    return 1 - (1 - shadows) * (1 - glints) ** (2 * trust)


def _receivers(scene: Gaussians, normals: Normals, center: Float[Tensor, "3"], radius: float) -> Int[Tensor, "m"]:
    inside = (scene.means - center).norm(dim=1) < radius
    good = inside & normals.seen & (scene.opacities > 0.3) & (normals.confidence > 0.1)
    chosen = good.nonzero()[:, 0]
    generator = torch.Generator().manual_seed(0)
    return chosen[torch.randperm(len(chosen), generator=generator)[:_RECEIVERS]]


def _occluders(scene: Gaussians, center: Float[Tensor, "3"], radius: float) -> Occluders:
    near = (scene.means - center).norm(dim=1) < 1.3 * radius
    chosen = (near & (scene.opacities > 0.1)).nonzero()[:, 0]
    if len(chosen) <= _OCCLUDERS:
        return occluders_of(scene.select(chosen))
    generator = torch.Generator().manual_seed(0)
    part = scene.select(chosen[torch.randperm(len(chosen), generator=generator)[:_OCCLUDERS]])
    # fewer, wider: together they cover the same area
    grown = part.log_scales + 0.5 * math.log(len(chosen) / _OCCLUDERS)
    return occluders_of(replace(part, log_scales=grown))


def _lit(
    occluders: Occluders,
    points: Float[Tensor, "m 3"],
    normals: Float[Tensor, "m 3"],
    directions: Float[Tensor, "d 3"],
    *,
    center: Float[Tensor, "3"],
    radius: float,
) -> Float[Tensor, "m d"]:
    """Visibility times cosine."""
    window = Window(center=center, radius=radius, frames=frames_along(directions))
    maps = splat_depth_maps(
        occluders, window, size=_MAP_SIZE, with_color=False, nearest=torch.full((len(directions),), -radius)
    )
    cosine = (normals @ directions.T).clamp_min(0)
    return visibility(maps, points, normals, bias=1.5 * maps.texel) * cosine


def _openness(
    occluders: Occluders,
    points: Float[Tensor, "m 3"],
    normals: Float[Tensor, "m 3"],
    *,
    center: Float[Tensor, "3"],
    radius: float,
) -> Float[Tensor, "m"]:
    """Share of an even sky that reaches each point; what is blocked brings half."""
    around = even_directions(48)
    lit = _lit(occluders, points, normals, around, center=center, radius=radius)
    return 0.5 + 0.5 * lit.sum(1) / (normals @ around.T).clamp_min(0).sum(1)


@dataclass(frozen=True)
class _Fit:
    """The model log B = log albedo of the group + log(ambient + strength * lit), one strength for all groups.

    One strength leaves chance one degree of freedom: an own one per group would let textures vote.
    """

    member: Float[Tensor, "g m"]
    """Weight of each receiver in its group."""
    log_rgb: Float[Tensor, "m 3"]
    ambient: Float[Tensor, "m"]

    @staticmethod
    def of(
        brightness: Float[Tensor, "m 3"], ambient: Float[Tensor, "m"], groups: Int[Tensor, "m"], weight: Tensor
    ) -> "_Fit":
        count = int(groups.max()) + 1
        # what is almost black says nothing about light
        weight = weight * brightness.mean(1) / (brightness.mean(1) + 0.02)
        member = torch.nn.functional.one_hot(groups, count).T.float() * weight
        log_rgb = brightness.clamp_min(0.004).log()
        middle = (member @ log_rgb) / member.sum(1, keepdim=True).clamp_min(1e-9)
        # far above the group's mean is a glint, far below another material
        away = (log_rgb - middle[groups]).clamp(-math.log(10), math.log(4))
        return _Fit(member, middle[groups] + away, ambient)

    def _residual(self, values: Float[Tensor, "m d"]) -> Float[Tensor, "d"]:
        """Weighted squares around each group's mean."""
        total = self.member.sum(1, keepdim=True).clamp_min(1e-9)
        sums = self.member @ values
        # rounding takes what is even below zero
        return (self.member.sum(0) @ (values * values) - (sums * sums / total).sum(0)).clamp_min(0)

    def explained(self, lit: Float[Tensor, "m d"]) -> tuple[Float[Tensor, "d"], Float[Tensor, "d"]]:
        """Share of the ambient-only model's error that a light removes, and the strength that removes most."""
        value = self.log_rgb.mean(1)
        without = self._residual((value - self.ambient.log())[:, None])
        tried = [
            self._residual(value[:, None] - (self.ambient[:, None] + strength * lit).log()) for strength in _STRENGTHS
        ]
        residual, which = torch.stack(tried).min(0)
        noise = _NOISE**2 * self.member.sum()
        return (1 - (residual + noise) / (without + noise)).clamp(0, 0.99), torch.tensor(_STRENGTHS)[which]

    def strength(self, lit: Float[Tensor, "m"]) -> Float[Tensor, "3"]:
        """Irradiance facing the light over ambient irradiance, per channel."""
        fine = torch.logspace(-1, 1.3, 24)
        modelled = (self.ambient[:, None] + lit[:, None] * fine).log()
        return torch.stack([fine[self._residual(self.log_rgb[:, c : c + 1] - modelled).argmin()] for c in range(3)])


def _cap(axis: Float[Tensor, "3"], radius: float, count: int) -> Float[Tensor, "n 3"]:
    """Directions spread evenly within `radius` radians of `axis`."""
    right, down, _ = frames_along(axis[None])[0]
    i = torch.arange(count) + 0.5
    r, angle = (i / count).sqrt() * math.sin(radius), i * math.pi * (3 - math.sqrt(5))
    side = (r * angle.cos())[:, None] * right + (r * angle.sin())[:, None] * down
    return side + (1 - r * r).sqrt()[:, None] * axis
