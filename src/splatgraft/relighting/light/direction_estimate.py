"""Direction and strength of a scene's dominant light, from shadow evidence and highlight evidence together.

Every direction of an even set above the horizon is scored by the share of variance that a light there explains; a
finer set around the best one gives the estimate and its uncertainty.
"""

import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.directions import even_directions, vogel_offsets
from splatgraft.core.gaussians import Gaussians
from splatgraft.relighting.light.highlight_evidence import Highlights
from splatgraft.relighting.light.shadow_evidence import ShadowEvidenceSettings, find_shadow_evidence
from splatgraft.relighting.shading.normals import Normals


@dataclass(frozen=True)
class DirectionSettings:
    """Search over directions, and what evidence is worth."""

    directions: int = 320
    """Directions over the sphere, of which those above the horizon, about half, are tried; set by hand."""
    cap: float = math.radians(14)
    """Radians around the best direction within which finer ones are tried; set by hand."""
    finer: int = 64
    """Directions within the cap; set by hand."""
    lowest: float = math.radians(5)
    """Radians above the horizon, of a direction that is tried; set by hand."""
    peak: tuple[float, float] = (0.85, 0.15)
    """Shares of the best score: where a direction's weight in the estimate starts, and over which it rises to 1; set by
    hand."""
    shadow_error_deg: tuple[float, float, float] = (3.0, 16.0, 0.15)
    """Error of shadows in degrees: a + b exp(-explained / c). Measured on synthetic scenes: the less the best direction
    explains, the farther it is from the truth."""
    highlight_error: float = math.radians(9)
    """Radians: error of highlights, in height; they determine the azimuth. Measured on rendered scenes."""
    clear_highlight: float = 0.25
    """Share of the variance from view to view. Over rendered scenes with known light the best direction was the main
    light's wherever it explained more."""
    half_highlight: float = 0.1
    """Share of that variance at which highlights count half at the estimate; set by hand."""
    attenuation: tuple[float, float] = (2.5, 0.25)
    """(a, b) of the factor 1 + a exp(-explained / b) on strength: errors in visibility make a least-squares strength
    too small, the more, the less is explained (regression dilution); set by hand."""
    half_confidence: float = 0.08
    """Score at which confidence is one half; set by hand."""
    contrast_gain: float = 1.6
    """Confidence is limited by this times the best score's contrast to the median; set by hand."""
    shadows: ShadowEvidenceSettings = field(default_factory=ShadowEvidenceSettings)
    """Of the evidence from shadows."""


@dataclass(frozen=True)
class DirectionEstimate:
    """The dominant light by shadows and highlights."""

    direction: Float[Tensor, "3"]
    """Unit, towards the light."""
    uncertainty: float
    """Standard deviation of `direction`, radians."""
    strength: Float[Tensor, "3"]
    """Irradiance facing the light over the irradiance of ambient light on an open plane, linear rgb; shadows alone."""
    confidence: float
    """In [0, 1]: 0 without evidence, 1 where one direction explains all."""
    shadow_evidence: float
    """Share of the brightness variance within materials that the light explains, in [0, 1]."""
    highlight_evidence: float
    """Weight of the highlights in the estimate, in [0, 1]."""


def estimate_direction(
    scene: Gaussians,
    normals: Normals,
    *,
    region: BoundingSphere,
    up: Float[Tensor, "3"],
    highlights: Highlights | None = None,
    settings: DirectionSettings = DirectionSettings(),
) -> DirectionEstimate | None:
    """Estimate the dominant light around a place.

    Args:
        scene: All Gaussians.
        normals: Of all Gaussians.
        region: Around the place; surfaces within it are the evidence.
        up: Unit, world frame.
        highlights: Around the same place; None without view-dependent colours.
        settings: Search and weights.

    Returns:
        None where there are too few surfaces.
    """
    evidence = find_shadow_evidence(scene, normals, region=region, settings=settings.shadows)
    if evidence is None:
        return None
    directions = even_directions(settings.directions)
    directions = directions[directions @ up > math.sin(settings.lowest)]
    by_highlights = _highlight_shares(highlights, directions)
    belief = _highlight_belief(by_highlights, settings)
    coarse = _scores(evidence.explained(evidence.lit(directions)), by_highlights, belief)
    directions = _cap(directions[int(coarse.argmax())], settings.cap, settings.finer)
    directions = directions[directions @ up > math.sin(settings.lowest)]
    lit = evidence.lit(directions)
    by_shadows, by_highlights = evidence.explained(lit), _highlight_shares(highlights, directions)
    scores = _scores(by_shadows, by_highlights, belief)
    direction, width = _peak(directions, scores, settings)
    nearest = int((directions @ direction).argmax())
    explained = float(by_shadows[nearest])
    highlight = float(by_highlights[nearest])
    highlight_weight = belief * highlight / (highlight + settings.half_highlight)
    least, more, decay = settings.shadow_error_deg
    shadow_error = math.radians(least + more * math.exp(-explained / decay))
    precision = shadow_error**-2 + highlight_weight / settings.highlight_error**2
    gain, dilution = settings.attenuation
    best, typical = float(scores.max()), float(coarse.median())
    contrast = (best - typical) / max(best, 1e-9)
    return DirectionEstimate(
        direction=direction,
        uncertainty=math.hypot((1 - highlight_weight) * width, precision**-0.5),
        strength=(1 + gain * math.exp(-explained / dilution)) * evidence.strength(lit[:, nearest]),
        confidence=best / (best + settings.half_confidence) * min(1.0, settings.contrast_gain * contrast),
        shadow_evidence=explained,
        highlight_evidence=highlight_weight,
    )


def _highlight_shares(highlights: Highlights | None, directions: Float[Tensor, "d 3"]) -> Float[Tensor, "d"]:
    return torch.zeros(len(directions)) if highlights is None else highlights.explained(directions)


def _highlight_belief(shares: Float[Tensor, "d"], settings: DirectionSettings) -> float:
    """How likely the best direction of highlights is the main light's, in [0, 1].

    A lamp close overhead is mirrored in no single direction: highlights then show what remains of a distant window.
    """
    return min(1.0, (float(shares.max()) / settings.clear_highlight) ** 2) if len(shares) else 0.0


def _scores(shadows: Float[Tensor, "d"], highlights: Float[Tensor, "d"], belief: float) -> Float[Tensor, "d"]:
    """One minus the product of the unexplained shares, as likelihoods of independent evidence.

    Believed highlights count twice: on rendered scenes with both they were nearer to the truth.
    """
    return 1 - (1 - shadows) * (1 - highlights) ** (2 * belief)


def _peak(
    directions: Float[Tensor, "d 3"], scores: Float[Tensor, "d"], settings: DirectionSettings
) -> tuple[Float[Tensor, "3"], float]:
    """Centre of the peak of the scores, a unit vector, and its width (standard deviation, radians)."""
    best = float(scores.max())
    start, rise = settings.peak
    share = ((scores - start * best) / max(rise * best, 1e-9)).clamp_min(0)
    direction = torch.nn.functional.normalize((share[:, None] * directions).sum(0), dim=0)
    angle = torch.acos((directions @ direction).clamp(-1, 1))
    return direction, float(((share * angle**2).sum() / share.sum().clamp_min(1e-9)).sqrt())


def _cap(axis: Float[Tensor, "3"], radius: float, count: int) -> Float[Tensor, "n 3"]:
    """Directions spread evenly within `radius` radians of `axis`."""
    i = torch.arange(count) + 0.5
    r = (i / count).sqrt() * math.sin(radius)
    return vogel_offsets(axis, r, i) + (1 - r * r).sqrt()[:, None] * axis
