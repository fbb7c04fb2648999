"""The posterior density of the light around a place, and its local maxima by Gauss-Newton steps.

This is MAP estimation in precomputed radiance transfer (Sloan 2002), in gray. The unknowns are logarithms:

- the radiance of every direction that no camera saw,
- the radiance of every clipped direction beyond the recorded white,
- one albedo per material.

For receiver i of material m with transport t_i

    log colour_i = log albedo_m + log(t_i . radiance + blocked_i * mean colour) + error.

Errors have a Student-t density. Neighbours share their errors, so the weights of all receivers sum to a small number of
independent ones. The priors:

- Albedos are log-normal.
- Unseen directions share the level of the seen sky, but single ones may be far brighter (Student-t).
- A clipped patch is either a source or a bright surface, each log-normal.

The likelihood of the highlights is a function of the share of view-dependent change that the light explains.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatgraft.relighting.light.evidence import HighlightEvidence, ShadingEvidence
from splatgraft.relighting.light.panorama import DIRECTIONS, Surroundings

_MAX_LOG_ALBEDO = math.log(0.9)
_ABOVE_MAX = 100.0  # precision of the prior that keeps albedos below the maximum
_TOUCHING = math.cos(math.radians(15))  # clipped directions nearer than this are one patch
_LOWEST = math.sin(math.radians(-8))  # lowest sine of a source's height; windows reach below the horizon
_MAX_PATCHES = 5  # clipped patches that may be sources; the search tries all their combinations
_AT_HORIZON, _ABOVE_HORIZON = (-0.1, 0.2), (0.1, 0.4)  # sines of heights; set by hand
_OPEN = 1.2  # ratio of the distances seen there; rooms have up to 1.19, gardens and terraces 1.23 or more (log)


@dataclass(frozen=True)
class RadianceSettings:
    """Parameters of the density, fitted together over training scenes by benchmarks/fit_light.py."""

    albedo: float = 0.29
    """Median linear albedo of a material in a room."""
    albedo_outdoors: float = 0.208
    """Median linear albedo of a material out of doors: lawns, soil and leaves are darker than walls and furniture."""
    albedo_sd: float = 0.332
    """Standard deviation of the log albedo."""
    materials: float = 9.04
    """Maximum number of independent albedos in a scene."""
    residual: float = 0.816
    """Scale of the error of log colour."""
    nu: float = 4.0
    """Degrees of freedom of that error; set by hand because the fit cannot separate it from the scale."""
    effective: float = 52.3
    """Number of independent receivers that all receivers count as, because neighbours share their errors."""
    near: float = 1.28
    """Standard deviation of a receiver's weight over its distance from the object, radii of the region; the light is
    estimated at the object."""
    highlights: float = 105.0
    """Number of independent view-dependent colours that all highlights count as."""
    sky_bias: float = -0.07
    """Mean log radiance of unseen directions over that of the seen ones above the horizon."""
    sky_sd: float = 0.431
    """Standard deviation of that difference between scenes."""
    unseen_sd: float = 1.13
    """Scale of one unseen direction's log radiance around the common level."""
    unseen_nu: float = 1.28
    """Degrees of freedom of that density; lower values make a lamp among the unseen directions likelier."""
    source: float = 77.4
    """Median radiance of a clipped source; the camera's white is 1."""
    source_sd: float = 0.444
    """Standard deviation of the source's log radiance."""
    surface: float = 0.121
    """Median radiance of a clipped bright surface beyond white."""
    surface_sd: float = 0.897
    """Standard deviation of the surface's log radiance."""
    within_patch_sd: float = 0.272
    """Standard deviation of log radiance within a patch."""
    temperature: float = 4.6
    """Divisor of differences of the log density when its local maxima are averaged."""


@dataclass(frozen=True)
class LightEvidence:
    """Evidence for the light at a place."""

    surfaces: ShadingEvidence
    """Shading of the surfaces in a region around the place."""
    highlights: HighlightEvidence | None
    """Highlights on these surfaces; None without view-dependent colours."""
    far: Surroundings
    """Surroundings outside of the region."""
    around: Surroundings
    """Surroundings of the object, near surfaces included."""
    up: Float[Tensor, "3"]
    """Unit, world frame."""

    @property
    def is_outdoors(self) -> bool:
        """Whether what is seen above the horizon is farther away than at the horizon; a room's walls are not."""
        sine, seen, distance = DIRECTIONS @ self.up, self.far.seen > 0.5, self.far.distance
        at, above = (distance[seen & (sine > low) & (sine < high)] for low, high in (_AT_HORIZON, _ABOVE_HORIZON))
        return len(at) > 0 and len(above) > 0 and float(above.median()) > _OPEN * float(at.median())

    def is_sun(self, distance: float) -> bool:
        """Whether a source at this distance that casts shadows is the sun; in a room it may be a window."""
        return self.is_outdoors and math.isinf(distance)

    @property
    def visible_sources(self) -> Float[Tensor, "k"]:
        """Clipped share of each direction outside of the region, as seen from the object, in [0, 1].

        Clipped surfaces within the region are errors of the reconstruction or bright surfaces.
        """
        return torch.minimum(self.around.clipped, self.far.clipped)


@dataclass(frozen=True)
class ClippedPrior:
    """Normal density of the x clipped unknowns, for one choice of the patches that are sources.

    All choices are equally likely: odds fitted to rooms turned four white walls around a square into lights.
    """

    mean: Float[Tensor, "x"]
    precision: Float[Tensor, "x x"]


@dataclass(frozen=True)
class RadianceProblem:
    """Density at one place: m receivers, u unseen and x clipped directions, g materials; double precision."""

    evidence: ShadingEvidence
    highlights: HighlightEvidence | None
    around: Surroundings
    """Surroundings of the object, near surfaces included."""
    settings: RadianceSettings
    unseen: Int[Tensor, "u"]
    """Positions of unseen directions in `DIRECTIONS`."""
    clipped: Int[Tensor, "x"]
    """Positions of clipped directions in `DIRECTIONS`."""
    transport: Float[Tensor, "m n"]
    """Transport of the n = u + x unknowns, each multiplied by its share of its direction."""
    shares: Float[Tensor, "n"]
    """Unseen or clipped share of each unknown's direction, outside of the region."""
    shares_at_object: Float[Tensor, "n"]
    """Unseen or clipped share of each unknown's direction, seen from the object."""
    may_shine: Bool[Tensor, "n"]
    """Whether the direction may contain a lamp: it is above the horizon. Below, bright directions are surfaces."""
    known: Float[Tensor, "m"]
    """Radiance of white receivers under the captured light."""
    log_color: Float[Tensor, "m"]
    weights: Float[Tensor, "m"]
    """Weights of the receivers; they sum to `effective`."""
    is_white: Bool[Tensor, "m"]
    """Whether a receiver is clipped and may be brighter than recorded."""
    material_weights: Float[Tensor, "g"]
    """Number of independent albedos that each material counts as."""
    sky: float
    """Expected log radiance of unseen directions."""
    connected: Bool[Tensor, "x x"]
    """Whether two clipped directions belong to one patch."""
    patches: tuple[Int[Tensor, "_"], ...]
    """Positions in `clipped` of the patches that may be sources because they are above the horizon, largest first."""

    def split(self, x: Float[Tensor, "s"]) -> tuple[Tensor, Tensor, Tensor]:
        """Split a state into the level of the unseen sky, n log radiances and g log albedos."""
        n = self.transport.shape[1]
        return x[0], x[1 : 1 + n], x[1 + n :]

    def received(self, radiances: Float[Tensor, "n"]) -> Float[Tensor, "m"]:
        """Compute the radiance of white receivers from the log radiances of the unknowns."""
        return (self.known + self.transport @ radiances.exp()).clamp_min(1e-5)

    def residual(self, radiances: Float[Tensor, "n"], albedos: Float[Tensor, "g"]) -> Float[Tensor, "m"]:
        """Compute the logarithm of observed over explained brightness of the receivers from logarithms."""
        return self.log_color - albedos[self.evidence.material] - self.received(radiances).log()

    def counted(self, residual: Float[Tensor, "m ..."]) -> Float[Tensor, "m ..."]:
        """Set negative residuals of clipped receivers to 0, because these may be brighter than recorded."""
        is_white = self.is_white.reshape(-1, *[1] * (residual.ndim - 1))
        return torch.where(is_white, residual.clamp_min(0), residual)

    def shading_cost(self, residual: Float[Tensor, "m ..."]) -> Float[Tensor, "..."]:
        """Compute the negative log likelihood of the receivers' colours."""
        s, weights = self.settings, self.weights.to(residual).reshape(-1, *[1] * (residual.ndim - 1))
        away = self.counted(residual) ** 2 / (s.nu * s.residual**2)
        return 0.75 * (s.nu + 1) * (weights * torch.log1p(away)).sum(0)

    def refitted_cost(self, log_ratio: Float[Tensor, "m r"], *, rounds: int) -> Float[Tensor, "r"]:
        """Compute the cost of shading and albedos for r lights of unknown level, each with its best level and albedos.

        Args:
            log_ratio: Logarithm of the colour of each receiver over the radiance that a white one would have.
            rounds: Iterations of reweighting.
        """
        s, prior = self.settings, math.log(self.settings.albedo)
        precision = self.material_weights[:, None] * s.albedo_sd**-2
        albedos = torch.full((len(self.material_weights), log_ratio.shape[1]), prior, dtype=torch.float64)
        level = torch.zeros(log_ratio.shape[1], dtype=torch.float64)
        for _ in range(rounds):
            residual = self.counted(log_ratio - level - albedos[self.evidence.material])
            weights = self.weights[:, None] * 1.5 * (s.nu + 1) / (s.nu * s.residual**2 + residual**2)
            level = level + (weights * residual).sum(0) / weights.sum(0).clamp_min(1e-9)
            residual = self.counted(log_ratio - level - albedos[self.evidence.material])
            pull = _by_material(self, weights * residual) - precision * (albedos - prior)
            albedos = albedos + pull / (_by_material(self, weights) + precision + 1e-6)
        away = precision * (albedos - prior) ** 2
        return self.shading_cost(log_ratio - level - albedos[self.evidence.material]) + 0.5 * away.sum(0)

    def radiance_at_object(self, x: Float[Tensor, "s"]) -> Float[Tensor, "k"]:
        """Return the gray radiance from all `DIRECTIONS` at the object."""
        total = self.around.radiance.mean(1).double()
        index = torch.cat([self.unseen, self.clipped])
        return total.index_add(0, index, self.shares_at_object * self.split(x)[1].exp())

    def highlight_cost(self, x: Float[Tensor, "s"]) -> float:
        """Compute the negative log likelihood of the highlights, up to a constant."""
        if self.highlights is None:
            return 0.0
        return self.settings.highlights * math.log1p(-self.highlights.explained(self.radiance_at_object(x)))

    def clipped_prior(self, sources: tuple[bool, ...]) -> ClippedPrior:
        """Return the prior of the clipped unknowns if exactly the patches marked in `sources` are sources."""
        s, count = self.settings, len(self.clipped)
        mean = torch.full((count,), math.log(s.surface), dtype=torch.float64)
        deviation = torch.full((count,), s.surface_sd, dtype=torch.float64)
        for patch, is_source in zip(self.patches, sources, strict=True):
            if is_source:
                mean[patch], deviation[patch] = math.log(s.source), s.source_sd
        if not count:
            return ClippedPrior(mean, torch.zeros(0, 0, dtype=torch.float64))
        covariance = (
            self.connected.double() * deviation[:, None] * deviation + s.within_patch_sd**2 * torch.eye(count).double()
        )
        return ClippedPrior(mean, torch.linalg.inv(covariance))


def radiance_problem(found: LightEvidence, *, settings: RadianceSettings = RadianceSettings()) -> RadianceProblem:
    """Set up the density at one place.

    Args:
        found: The evidence at the place.
        settings: Parameters of the density.
    """
    evidence, far, around, up = found.surfaces, found.far, found.around, found.up
    s = replace(settings, albedo=settings.albedo_outdoors) if found.is_outdoors else settings
    # smaller shares get no unknown
    unseen = (torch.maximum(1 - far.seen, 1 - around.seen) > 0.05).nonzero()[:, 0]
    clipped = (far.clipped > 0.02).nonzero()[:, 0]
    shares = torch.cat([1 - far.seen[unseen], far.clipped[clipped]]).clamp_min(0).double()
    transport = evidence.transport(far.distance).double()
    blocked = (1 - transport.sum(1)).clamp_min(0)
    label = _patch_labels(clipped, up)
    mean_color = (evidence.weights[:, None] * evidence.colors).sum(0).mean()
    weights = (evidence.weights * torch.exp(-0.5 * (evidence.distance / s.near) ** 2)).double()
    weights *= s.effective / weights.sum().clamp_min(1e-12)
    groups = int(evidence.material.max()) + 1 if len(weights) else 0
    by_material = torch.zeros(groups, dtype=torch.float64).index_add_(0, evidence.material, weights)
    material_weights = by_material / (by_material + 1)
    material_weights *= min(1.0, s.materials / max(float(material_weights.sum()), 1e-9))
    # without any seen direction the sky is taken to be almost black
    sky = max(float(_seen_sky(far, up, mean_color.expand(3)).mean()), 1e-3)
    return RadianceProblem(
        evidence=evidence,
        highlights=found.highlights,
        around=around,
        settings=s,
        unseen=unseen,
        clipped=clipped,
        transport=transport[:, torch.cat([unseen, clipped])] * shares,
        shares=shares,
        shares_at_object=torch.cat([1 - around.seen[unseen], found.visible_sources[clipped]]).clamp_min(0).double(),
        may_shine=DIRECTIONS[torch.cat([unseen, clipped])] @ up > 0,
        known=transport @ far.radiance.mean(1).double() + blocked * float(mean_color),
        log_color=evidence.colors.mean(1).double().log(),
        weights=weights,
        is_white=evidence.colors.max(1).values > 0.9,
        material_weights=material_weights,
        sky=math.log(sky) + s.sky_bias,
        connected=label[:, None] == label[None],
        patches=_patches(far, clipped, label, up)[:_MAX_PATCHES],
    )


def _seen_sky(far: Surroundings, up: Float[Tensor, "3"], otherwise: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """Return the geometric mean radiance seen above the horizon; else of all seen directions; else `otherwise`."""
    weights = far.seen * (DIRECTIONS @ up > 0)
    if float(weights.sum()) < 2:
        weights = far.seen
    if float(weights.sum()) < 1:
        return otherwise
    radiance = far.radiance / far.seen.clamp_min(1e-3)[:, None]
    return ((weights / weights.sum())[:, None] * radiance.clamp_min(1e-3).log()).sum(0).exp()


def _patch_labels(clipped: Int[Tensor, "x"], up: Float[Tensor, "3"]) -> Int[Tensor, "x"]:
    """Label connected sets of directions; a window is not connected with its reflection on a table below it."""
    towards = DIRECTIONS[clipped]
    above = towards @ up > _LOWEST
    touching = (towards @ towards.T > _TOUCHING) & (above[:, None] == above)
    label = torch.arange(len(clipped))
    for _ in range(len(clipped)):
        spread = torch.where(touching, label[None], len(clipped)).min(1).values
        if torch.equal(spread, label):
            break
        label = spread
    return label


def _patches(
    far: Surroundings, clipped: Int[Tensor, "x"], label: Int[Tensor, "x"], up: Float[Tensor, "3"]
) -> tuple[Int[Tensor, "p"], ...]:
    found = []
    for value in label.unique():
        members = (label == value).nonzero()[:, 0]
        size = float(far.clipped[clipped[members]].sum())
        # all members are on the same side of the horizon; smaller patches are noise
        if float(DIRECTIONS[clipped[members[0]]] @ up) > _LOWEST and size > 0.05:
            found.append((size, members))
    return tuple(members for _, members in sorted(found, key=lambda patch: -patch[0]))


def start(problem: RadianceProblem, prior: ClippedPrior) -> Float[Tensor, "s"]:
    """Return the state of an even sky, with albedos between the prior's and those that explain the colours."""
    p, s = problem, problem.settings
    radiances = torch.cat([torch.full((len(p.unseen),), p.sky, dtype=torch.float64), prior.mean])
    residual = p.log_color - p.received(radiances).log()
    total = _by_material(p, p.weights)
    mean = _by_material(p, p.weights * residual) / total.clamp_min(1e-9)
    precision = total * 0.5 / s.residual**2
    share = precision / (precision + p.material_weights * s.albedo_sd**-2 + 1e-3)
    albedo = share * mean + (1 - share) * math.log(s.albedo)
    return torch.cat([torch.tensor([p.sky], dtype=torch.float64), radiances, albedo])


def cost(problem: RadianceProblem, prior: ClippedPrior, x: Float[Tensor, "s"]) -> float:
    """Compute the negative log density of shading and priors, up to a constant."""
    p, s = problem, problem.settings
    level, radiances, albedo = p.split(x)
    unseen, clipped = radiances[: len(p.unseen)], radiances[len(p.unseen) :]
    total = float(p.shading_cost(p.residual(radiances, albedo)))
    total += 0.5 * float((p.material_weights * ((albedo - math.log(s.albedo)) / s.albedo_sd) ** 2).sum())
    total += 0.5 * _ABOVE_MAX * float(((albedo - _MAX_LOG_ALBEDO).clamp_min(0) ** 2).sum())
    total += 0.5 * ((float(level) - p.sky) / s.sky_sd) ** 2 + float(unseen_cost(s, unseen - level).sum())
    away = clipped - prior.mean
    return total + 0.5 * float(away @ prior.precision @ away)


def unseen_cost(settings: RadianceSettings, away: Tensor) -> Tensor:
    """Compute the negative log density of unseen directions' log radiances around their level."""
    s = settings
    return 0.5 * (s.unseen_nu + 1) * torch.log1p(away**2 / (s.unseen_nu * s.unseen_sd**2))


def polish(
    problem: RadianceProblem, prior: ClippedPrior, x: Float[Tensor, "s"], *, steps: int = 8
) -> Float[Tensor, "s"]:
    """Find the nearest local maximum of the density of shading and priors (reweighted Levenberg-Marquardt)."""
    best, damping = cost(problem, prior, x), 1e-3
    for _ in range(steps):
        moved = x + _step(problem, prior, x, damping).clamp(-1.5, 1.5)
        value = cost(problem, prior, moved)
        if value < best:
            gained, x, best, damping = best - value, moved, value, max(0.3 * damping, 1e-4)
            if gained < 0.01:
                break
        else:
            damping *= 10
    return x


def _by_material(problem: RadianceProblem, values: Float[Tensor, "m ..."]) -> Float[Tensor, "g ..."]:
    out = torch.zeros(len(problem.material_weights), *values.shape[1:], dtype=values.dtype)
    return out.index_add_(0, problem.evidence.material, values)


def _step(problem: RadianceProblem, prior: ClippedPrior, x: Float[Tensor, "s"], damping: float) -> Float[Tensor, "s"]:
    """Compute one damped Gauss-Newton step."""
    p, s = problem, problem.settings
    level, radiances, albedo = p.split(x)
    u, n = len(p.unseen), len(radiances)
    residual = p.counted(p.residual(radiances, albedo))
    weights = 1.5 * p.weights * (s.nu + 1) / (s.nu * s.residual**2 + residual**2)
    weights = torch.where(p.is_white & (residual <= 0), 0.0, weights)
    slope = (p.transport * radiances.exp()) / p.received(radiances)[:, None]  # d log received / d log radiance
    hessian = torch.zeros(len(x), len(x), dtype=torch.float64)
    gradient = torch.zeros(len(x), dtype=torch.float64)
    light, material = slice(1, 1 + n), slice(1 + n, len(x))
    single = slope.float()
    hessian[light, light] = (single.T @ (weights.float()[:, None] * single)).double()
    mixed = _by_material(p, weights[:, None] * slope)
    hessian[material, light], hessian[light, material] = mixed, mixed.T
    gradient[light] = -(slope.T @ (weights * residual))
    gradient[material] = -_by_material(p, weights * residual)
    diagonal = hessian.diagonal()
    above = (albedo > _MAX_LOG_ALBEDO) * _ABOVE_MAX
    diagonal[material] += _by_material(p, weights) + p.material_weights * s.albedo_sd**-2 + above + 1e-6
    gradient[material] += p.material_weights * (albedo - math.log(s.albedo)) * s.albedo_sd**-2
    gradient[material] += above * (albedo - _MAX_LOG_ALBEDO)
    away = radiances[:u] - level
    tied = (s.unseen_nu + 1) / (s.unseen_nu * s.unseen_sd**2 + away**2)
    diagonal[1 : 1 + u] += tied
    hessian[0, 1 : 1 + u], hessian[1 : 1 + u, 0] = -tied, -tied
    diagonal[0] += tied.sum() + s.sky_sd**-2
    gradient[1 : 1 + u] += tied * away
    gradient[0] = -(tied * away).sum() + (level - p.sky) * s.sky_sd**-2
    hessian[1 + u : 1 + n, 1 + u : 1 + n] += prior.precision
    gradient[1 + u : 1 + n] += prior.precision @ (radiances[u:] - prior.mean)
    diagonal += damping * diagonal
    factor, failed = torch.linalg.cholesky_ex(hessian)
    # after a zero step the caller increases the damping
    return torch.zeros_like(x) if int(failed) else -torch.cholesky_solve(gradient[:, None], factor)[:, 0]
