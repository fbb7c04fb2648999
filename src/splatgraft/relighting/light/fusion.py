"""Fusion of the light that a panorama shows with the light that shadows and highlights are evidence for.

Directions are averaged by inverse variance; the strength of a light without shadow evidence comes from priors.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.relighting.light.direction_estimate import DirectionEstimate
from splatgraft.relighting.light.light import Light, LightSource
from splatgraft.relighting.light.panorama import Panorama
from splatgraft.relighting.light.panorama_sources import light_from_panorama


@dataclass(frozen=True)
class LightFusionSettings:
    """Priors on sources, and when two are one."""

    lowest: float = math.radians(4)
    """Radians above the horizon; bright patches below are reflections; set by hand."""
    sun: float = 0.03
    """Steradians; a smaller patch is called sun (its glare in a photograph included), a larger one window; set by
    hand."""
    least_confidence: float = 0.1
    """Of the direction estimate; with less it is not used; set by hand."""
    match: tuple[float, float] = (2.5, math.radians(15))
    """A patch and the estimate are one light within this many standard deviations of the estimate, and at least within
    this angle, radians, beside the patch's own radius; set by hand."""
    glare_deg: float = 25.0
    """Degrees from a bright patch to the light behind it, measured over rendered scenes: what is above was not
    captured."""
    disagreement: float = 0.6
    """Share of the angle between patch and estimate that adds to the uncertainty; set by hand."""
    confirmed_doubt: float = 0.4
    """Factor on 1 - confidence of an estimate that a patch confirms; set by hand."""
    window_strength: float = 3.0
    """Irradiance facing a light over ambient irradiance, where shadows are no evidence: as of a window; set by hand."""
    lowest_sine: float = 0.2
    """Sine of a light's elevation that divides its irradiance on level ground, at least; set by hand."""
    half_evidence: float = 0.05
    """Share that shadows explain at which their strength counts as much as the prior's; set by hand."""
    tint: tuple[float, float] = (0.6, 1.6)
    """Limits of each channel over the mean: the tint of a light is known less well than its strength; set by hand."""
    tint_power: float = 0.5
    """Power on the tint after it is limited; set by hand."""
    estimate_radius_deg: float = 1.0
    """Degrees: angular radius of a light that no patch shows; set by hand."""
    patch_radius: float = 0.5
    """Factor on a patch's angular radius, which glare has enlarged; set by hand."""
    least_radius_deg: float = 0.5
    """Degrees; angular radius of a confirmed light, at least; set by hand."""
    sun_prior: float = 3.0
    """Irradiance of a visible sun on level ground over ambient irradiance, at least: 4 to 1 with ambient light; set by
    hand."""
    window_prior: float = 1.0
    """The same for a window: 2 to 1."""
    patch_lowest_sine: float = 0.25
    """As `lowest_sine`, for these two."""
    patch_uncertainty_deg: float = 4.0
    """Degrees, at least, of a patch without other evidence; set by hand."""
    patch_confidence: float = 0.55
    """Of a patch without other evidence; set by hand."""


def fuse_light(
    panorama: Panorama,
    estimate: DirectionEstimate | None,
    up: Float[Tensor, "3"],
    *,
    estimated_within: float,
    reflected: float | None = None,
    settings: LightFusionSettings = LightFusionSettings(),
) -> Light:
    """One light from a panorama and the evidence of shadows and highlights.

    Args:
        panorama: At the place.
        estimate: The dominant light; None without evidence.
        up: Unit, world frame.
        estimated_within: World units: radius of the surroundings that gave the estimate. Only occluders within it block
            a source that the panorama does not show, as it was their shadows that were seen.
        reflected: Gray irradiance that the surfaces around reflect; None where it is not known.
        settings: Priors.

    Returns:
        The dominant light first, then the panorama's other sources and its ambient light.
    """
    captured = light_from_panorama(panorama, up)
    patches = [s for s in captured.sources if float(torch.tensor(s.direction) @ up) > math.sin(settings.lowest)]
    ambient = float(replace(captured, sources=()).irradiance(up[None]).mean())
    main: LightSource | None = None
    used: set[int] = set()
    if estimate is not None and estimate.confidence > settings.least_confidence:
        prior = _prior_strength(estimate, ambient, up, reflected, settings=settings)
        main = replace(_estimated_source(estimate, ambient, prior, settings), blockers_within=estimated_within)
        deviations, least_match = settings.match
        for i, patch in enumerate(patches):
            angle = math.acos(max(-1.0, min(1.0, float(torch.tensor(patch.direction) @ estimate.direction))))
            match = max(deviations * estimate.uncertainty, least_match)
            if angle < match + math.radians(patch.angular_radius_deg):
                main = _fused_source(main, patch, angle, settings)
                used.add(i)
                break
    if main is None and patches:
        main = _patch_source(patches[0], ambient, up, settings)
        used.add(0)
    rest = [replace(p, name=_name(p, settings)) for i, p in enumerate(patches) if i not in used]
    sources = ([main] if main is not None else []) + rest
    return replace(captured, sources=tuple(sources))


def _name(source: LightSource, settings: LightFusionSettings) -> str:
    solid_angle = 2 * math.pi * (1 - math.cos(math.radians(source.angular_radius_deg)))
    return "sun" if solid_angle < settings.sun else "window"


def _prior_strength(
    estimate: DirectionEstimate,
    ambient: float,
    up: Float[Tensor, "3"],
    reflected: float | None,
    *,
    settings: LightFusionSettings,
) -> float:
    """Irradiance over ambient where shadows are no evidence: a window's, more where surfaces reflect more than ambient.

    What they reflect beyond the ambient light is the source's; as albedo is known to a factor of two, it counts half
    (geometric mean).
    """
    sine = max(settings.lowest_sine, float(estimate.direction @ up))
    missing = 0.0 if reflected is None else (reflected - ambient) / (ambient * sine)
    return settings.window_strength * math.sqrt(1 + max(0.0, missing))


def _estimated_source(
    estimate: DirectionEstimate, ambient: float, prior: float, settings: LightFusionSettings
) -> LightSource:
    """The source of an estimate; its strength is between that of shadows and the prior, by the shadows' evidence."""
    shadows = estimate.shadow_evidence
    believed = shadows / (shadows + settings.half_evidence * estimate.highlight_evidence + 1e-6)
    gray = math.exp(believed * float(estimate.strength.mean().log()) + (1 - believed) * math.log(prior))
    tint = (estimate.strength / estimate.strength.mean().clamp_min(1e-6)).clamp(*settings.tint) ** settings.tint_power
    rgb = gray * tint * ambient
    return LightSource(
        direction=tuple(estimate.direction.tolist()),
        irradiance=tuple(rgb.tolist()),
        angular_radius_deg=settings.estimate_radius_deg,
        uncertainty_deg=math.degrees(estimate.uncertainty),
        confidence=estimate.confidence,
        name="sun",
    )


def _fused_source(
    estimated: LightSource, patch: LightSource, angle: float, settings: LightFusionSettings
) -> LightSource:
    """One source from an estimate and the patch that shows it, `angle` radians apart.

    Directions by inverse variance, the larger strength, more confidence.
    """
    # the light is somewhere behind a patch that the camera clipped: glare is wider than the sun, and not centred on it
    patch_error = math.hypot(settings.glare_deg, patch.angular_radius_deg)
    weight, patch_weight = estimated.uncertainty_deg**-2, patch_error**-2
    direction = weight * torch.tensor(estimated.direction) + patch_weight * torch.tensor(patch.direction)
    error = (weight + patch_weight) ** -0.5
    disagreement = settings.disagreement * patch_weight / (weight + patch_weight) * math.degrees(angle)
    return replace(
        estimated,
        direction=tuple(torch.nn.functional.normalize(direction, dim=0).tolist()),
        irradiance=tuple(max(a, b) for a, b in zip(estimated.irradiance, patch.irradiance, strict=True)),
        angular_radius_deg=max(settings.patch_radius * patch.angular_radius_deg, settings.least_radius_deg),
        uncertainty_deg=math.hypot(error, disagreement),
        confidence=1 - (1 - estimated.confidence) * settings.confirmed_doubt,
        name=_name(patch, settings),
        blockers_within=math.inf,
    )


def _patch_source(
    patch: LightSource, ambient: float, up: Float[Tensor, "3"], settings: LightFusionSettings
) -> LightSource:
    """The source of a patch without other evidence, at least as strong as the prior."""
    name = _name(patch, settings)
    sine = max(settings.patch_lowest_sine, float(torch.tensor(patch.direction) @ up))
    prior = (settings.sun_prior if name == "sun" else settings.window_prior) * ambient / sine
    factor = max(1.0, prior / max(patch.luminance, 1e-9))
    return replace(
        patch,
        irradiance=tuple(v * factor for v in patch.irradiance),
        uncertainty_deg=max(patch.uncertainty_deg, settings.patch_uncertainty_deg),
        confidence=settings.patch_confidence,
        name=name,
    )
