"""The light around a place as an average over the local maxima of its posterior density (`radiance_model.py`).

1. Try the clipped patches as sources in every combination; polish the best.
2. Try single unseen or clipped directions as additional lamps; polish the best.
3. Average the maxima, weighted by their density.
4. Spread each unseen lamp over the directions that explain the scene about equally well.

`source_costs` compares strengths of one source alone.
"""

import itertools
import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.relighting.light.panorama import DIRECTIONS, SOLID_ANGLE, shares_of
from splatgraft.relighting.light.radiance_model import (
    ClippedPrior,
    LightEvidence,
    RadianceProblem,
    cost,
    polish,
    start,
    unseen_cost,
)
from splatgraft.relighting.light.sky import ClearSky

_RELEVELED = 0.7  # share of the mean residual that albedos absorb before a state is polished
_MIN_SHARE = 0.1  # minimum unknown share of a direction that may contain a lamp
_STRENGTHS = (4.0, 12.0, 40.0, 120.0)  # radiance of a lamp over the previous radiance
_APART = math.radians(18)  # minimum angle between two directions that are tried as lamps
_SPREAD = math.radians(35)
"""Maximum angle over which a lamp's direction is uncertain, and standard deviation of `RadianceEstimate.spread`."""
_ROUNDS = 8  # iterations of reweighting


@dataclass(frozen=True)
class Maximum:
    """A local maximum of the density."""

    cost: float
    """Negative log density, highlights included."""
    state: Float[Tensor, "s"]
    sources: tuple[bool, ...]
    """Whether each clipped patch is a source."""


@dataclass(frozen=True)
class RadianceEstimate:
    """Linear rgb radiance around a place that no camera recorded, for each direction."""

    unseen: Float[Tensor, "k 3"]
    """Radiance of each direction's unseen part."""
    clipped: Float[Tensor, "k 3"]
    """Radiance of each direction's clipped part beyond the camera's white."""
    residual: Float[Tensor, "m"]
    """Logarithm of observed over explained brightness of the receivers at the best maximum."""

    def radiance(self, evidence: LightEvidence) -> Float[Tensor, "k 3"]:
        """Compute the linear rgb radiance from all `DIRECTIONS` at the object.

        Args:
            evidence: Evidence at the object, whose near surroundings may differ from those of the estimate.
        """
        around = evidence.around
        unseen = (1 - around.seen).clamp_min(0)[:, None] * self.unseen
        return around.radiance + unseen + evidence.visible_sources[:, None] * self.clipped

    def under(self, sky: ClearSky) -> "RadianceEstimate":
        """Take the radiance of the directions above the horizon from a clear sky."""
        above, radiance = (DIRECTIONS @ sky.up > 0)[:, None], sky.radiance(DIRECTIONS)
        clipped = (radiance - 1).clamp_min(0)
        return replace(
            self,
            unseen=torch.where(above, radiance, self.unseen),
            clipped=torch.where(above, clipped, self.clipped),
        )

    def spread(self, seen: Float[Tensor, "k"]) -> "RadianceEstimate":
        """Average the radiance of each direction's unseen part over the unseen parts around it, by a Gaussian.

        Args:
            seen: Seen share of each of the `DIRECTIONS`.
        """
        away = (DIRECTIONS @ DIRECTIONS.T).clamp(-1, 1).acos() / _SPREAD
        weight = (-0.5 * away.square()).exp() * (1 - seen).clamp_min(1e-6)
        return replace(self, unseen=weight @ self.unseen / weight.sum(1, keepdim=True))


def source_costs(
    problem: RadianceProblem,
    evidence: LightEvidence,
    rest: Float[Tensor, "k"],
    direction: Float[Tensor, "3"],
    added: Float[Tensor, "r"],
) -> Float[Tensor, "r"]:
    """Compute the negative log likelihood of one source of each radiance, up to a constant.

    Level and albedos are the best ones for each.

    Args:
        problem: Density of the light at the place.
        evidence: Evidence that `problem` is made of.
        rest: Gray radiance from all `DIRECTIONS` without the source.
        direction: Unit vector towards the source.
        added: Gray radiance of the source, if it fills one of the `DIRECTIONS`; double precision.
    """
    surfaces, rest, shares = evidence.surfaces, rest.double(), shares_of(direction)
    transport, of_source = surfaces.transport(evidence.far.distance).double(), (surfaces.transport() @ shares).double()
    mean_color = (surfaces.weights[:, None] * surfaces.colors).sum(0).mean()
    white = transport @ rest + (1 - transport.sum(1)).clamp_min(0) * mean_color
    received = (white[:, None] + of_source[:, None] * added).clamp_min(1e-5)
    costs = problem.refitted_cost(problem.log_color[:, None] - received.log(), rounds=_ROUNDS)
    if problem.highlights is not None:
        lights = rest + added[:, None] * shares.double()
        explained = torch.tensor([problem.highlights.explained(light) for light in lights], dtype=torch.float64)
        costs = costs + problem.settings.highlights * torch.log1p(-explained)
    return costs


def search_radiance(problem: RadianceProblem) -> RadianceEstimate:
    """Find and average the local maxima of the density of `problem`.

    Args:
        problem: The density.
    """
    no_sources = problem.clipped_prior((False,) * len(problem.patches))
    dark = polish(problem, no_sources, start(problem, no_sources), steps=2)
    combined = _combinations(problem, dark)[:3]
    found = [_polished(problem, one) for one in combined]
    best = combined[0]
    # two steps only: a converged state already explains the effect of a lamp by other light
    early = polish(problem, problem.clipped_prior(best.sources), best.state, steps=2)
    found += _with_lamps(problem, replace(best, state=early), 5)
    found.sort(key=lambda maximum: maximum.cost)
    found += _with_lamps(problem, found[0], 2)
    maxima = _distinct(problem, sorted(found, key=lambda maximum: maximum.cost))
    weights = torch.tensor([(maxima[0].cost - m.cost) / problem.settings.temperature for m in maxima]).double().exp()
    weights /= weights.sum()
    hidden = torch.zeros(2, len(DIRECTIONS), dtype=torch.float64)
    for weight, maximum in zip(weights, maxima, strict=True):
        hidden += weight * _hidden_radiance(problem, maximum)
    _, at_best, albedo = problem.split(maxima[0].state)
    # white, because cameras balance their white to unseen light, and because clipped parts have lost their tint
    unseen, clipped = hidden.float()[..., None].expand(-1, -1, 3)
    return RadianceEstimate(
        unseen=unseen,
        clipped=clipped,
        residual=problem.residual(at_best, albedo).float(),
    )


def _polished(problem: RadianceProblem, at: Maximum) -> Maximum:
    prior = problem.clipped_prior(at.sources)
    return _evaluated(problem, prior, polish(problem, prior, at.state), at.sources)


def _evaluated(
    problem: RadianceProblem, prior: ClippedPrior, state: Float[Tensor, "s"], sources: tuple[bool, ...]
) -> Maximum:
    return Maximum(cost(problem, prior, state) + problem.highlight_cost(state), state, sources)


def _combinations(problem: RadianceProblem, dark: Float[Tensor, "s"]) -> list[Maximum]:
    """Evaluate all combinations of patches as sources, with albedos shifted together; lowest cost first."""
    n, found = problem.transport.shape[1], []
    for sources in itertools.product((True, False), repeat=len(problem.patches)):
        prior, state = problem.clipped_prior(sources), dark.clone()
        state[1 + len(problem.unseen) : 1 + n] = prior.mean
        _, radiances, albedo = problem.split(state)
        residual = problem.residual(radiances, albedo)
        state[1 + n :] += _RELEVELED * float((problem.weights * residual).sum() / problem.weights.sum().clamp_min(1e-9))
        found.append(_evaluated(problem, prior, state, sources))
    return sorted(found, key=lambda maximum: maximum.cost)


def _lamp_costs(
    problem: RadianceProblem, prior: ClippedPrior, state: Float[Tensor, "s"], strengths: tuple[float, ...]
) -> Float[Tensor, "3 n f"]:
    """Make each unknown a lamp of each strength: return cost up to a constant, log radiance and shift of albedos."""
    p, s = problem, problem.settings
    level, radiances, albedo = p.split(state)
    u, now = len(p.unseen), radiances.exp()
    at_least = torch.where(torch.arange(len(now)) < u, level.exp(), 0.3)  # 0.3 beyond white for a clipped lamp
    residual = p.residual(radiances, albedo).float()
    relative = (p.transport / p.received(radiances)[:, None]).float()
    index = torch.cat([p.unseen, p.clipped])
    light = p.radiance_at_object(state)
    columns = []
    for strength in strengths:
        lamp = torch.maximum(now, at_least) * strength
        changed = residual[:, None] - torch.log1p(relative * (lamp - now).float())
        weight = p.weights.float()[:, None]
        shift = _RELEVELED * (weight * changed).sum(0) / weight.sum().clamp_min(1e-9)
        value = p.shading_cost(changed - shift).double()
        away = (albedo - math.log(s.albedo))[:, None]
        value += 0.5 * (p.material_weights[:, None] * ((away + shift) ** 2 - away**2)).sum(0) / s.albedo_sd**2
        value[:u] += unseen_cost(s, lamp[:u].log() - level) - unseen_cost(s, radiances[:u] - level)
        moved, pull = lamp[u:].log() - radiances[u:], prior.precision @ (radiances[u:] - prior.mean)
        value[u:] += moved * pull + 0.5 * moved**2 * prior.precision.diag()
        if p.highlights is not None:
            explained = p.highlights.explained_with_more(light, index, p.shares_at_object * (lamp - now))
            value += s.highlights * torch.log1p(-explained).double()
        value[(p.shares < _MIN_SHARE) | ~p.may_shine] = math.inf
        columns.append(torch.stack([value, lamp.log(), shift.double()]))
    return torch.stack(columns, 2)


def _with_lamps(problem: RadianceProblem, base: Maximum, count: int) -> list[Maximum]:
    """Add one lamp in each of the `count` best directions, and polish each state."""
    prior = problem.clipped_prior(base.sources)
    costs, radiances, shifts = _lamp_costs(problem, prior, base.state, _STRENGTHS)
    left, strength = costs.min(1)
    towards = DIRECTIONS[torch.cat([problem.unseen, problem.clipped])]
    found = []
    for _ in range(min(count, len(left))):
        i = int(left.argmin())
        if not math.isfinite(float(left[i])):
            break
        left = torch.where(towards @ towards[i] > math.cos(_APART), math.inf, left)
        state = base.state.clone()
        state[1 + i] = radiances[i, strength[i]]
        state[1 + len(towards) :] += shifts[i, strength[i]]
        found.append(_polished(problem, replace(base, state=state)))
    return found


def _distinct(problem: RadianceProblem, maxima: list[Maximum]) -> list[Maximum]:
    """Remove maxima whose irradiance a better one gives, too, to 0.04 in the RMS of its logarithm."""
    kept: list[Maximum] = []
    seen: list[Tensor] = []
    for maximum in maxima:
        log_irradiance = irradiance_of(problem.radiance_at_object(maximum.state)).clamp_min(1e-6).log()
        if all(float((log_irradiance - other).pow(2).mean().sqrt()) > 0.04 for other in seen):
            kept.append(maximum)
            seen.append(log_irradiance)
    return kept


def irradiance_of(radiance: Float[Tensor, "k ..."], normals: Float[Tensor, "n 3"] = DIRECTIONS) -> Tensor:
    """Compute the irradiance on unshadowed planes with unit `normals` from the radiance of all `DIRECTIONS`."""
    cosine = (normals @ DIRECTIONS.T).clamp_min(0).to(radiance)
    return cosine @ radiance * SOLID_ANGLE


def _hidden_radiance(problem: RadianceProblem, maximum: Maximum) -> Float[Tensor, "2 k"]:
    """Return the radiance of unseen and clipped parts, with unseen lamps spread over equally likely directions."""
    level, radiances, _ = problem.split(maximum.state)
    count = len(problem.unseen)
    out = torch.zeros(2, len(DIRECTIONS), dtype=torch.float64)
    out[0, problem.unseen], out[1, problem.clipped] = radiances[:count].exp(), radiances[count:].exp()
    towards, shares = DIRECTIONS[problem.unseen], problem.shares[:count].clamp_min(_MIN_SHARE)
    prior = problem.clipped_prior(maximum.sources)
    is_lamp = (radiances[:count] - level > math.log(_STRENGTHS[0])) & problem.may_shine[:count]
    for i in is_lamp.nonzero()[:, 0].tolist():
        without = maximum.state.clone()
        without[1 + i] = level
        strengths = tuple((float(radiances[i] - level) + torch.linspace(-1, 1, 5)).exp().tolist())
        value = _lamp_costs(problem, prior, without, strengths)[0, :count].min(1).values
        value = torch.where(towards @ towards[i] > math.cos(_SPREAD), value, math.inf)
        likely = (-(value - value.min()) / problem.settings.temperature).exp()
        energy = shares[i] * (radiances[i].exp() - level.exp())
        out[0, problem.unseen[i]] = level.exp()
        out[0] = out[0].index_add(0, problem.unseen, energy * likely / likely.sum() / shares)
    return out
