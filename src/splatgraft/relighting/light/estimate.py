"""The light at a place of a scene, asked twice: of the panorama from there and of the scene's own shadows; combined.

Knows nothing about objects' shading or files.
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.cameras import Cameras, look_at, pinhole
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.images import linear_from_srgb
from splatgraft.core.spherical_harmonics import rgb_from_dc
from splatgraft.relighting.light.highlight_evidence import find_highlights
from splatgraft.relighting.light.light import Light, LightSource
from splatgraft.relighting.light.panorama import Panorama, cube_cameras, render_panorama
from splatgraft.relighting.light.panorama_sources import light_from_panorama
from splatgraft.relighting.light.shadow_evidence import DirectionEstimate, estimate_direction
from splatgraft.relighting.shading.normals import estimate_normals
from splatgraft.rendering import render

_LOWEST = math.radians(4)  # bright patches below are reflections
_SUN = 0.03  # steradians; the glare of a sun in a photograph is smaller, a window larger
_ENCLOSED = 0.6
_SIZE = 64  # pixels along each face of the panorama
_CLEAR = 0.35  # confidence of a vote beyond which no wider one is asked
_AROUND = 3.0  # object radii within which surfaces tell how bright the light is
_ALBEDO = 0.4  # of a mean surface, linear
_UNSEEN = 0.25
_LEVEL = math.log(9)
_GLARE_DEG = 25.0  # from a bright patch to the light behind it, over rendered scenes: what is above was not captured
_WINDOW = 3.0  # facing it, over the ambient light
_UNTOLD = 0.05  # share that shadows must explain to count as much as what is usual


def estimate_light(
    scene: Gaussians, ball: BoundingSphere, cameras: Cameras, *, also: Gaussians | None = None
) -> tuple[Light | None, str | None]:
    """The light in the middle of `ball`, levelled, or a sentence that says why there is none.

    `also` stands in the scene too and casts shadows, but is not seen from the middle: the object itself.
    """
    lights, problem = estimate_lights(scene, ball, cameras, also=also)
    return (None if lights is None else lights[1]), problem


def estimate_lights(
    scene: Gaussians, ball: BoundingSphere, cameras: Cameras, *, also: Gaussians | None = None
) -> tuple[tuple[Light, Light] | None, str | None]:
    """As `light_at`: first as bright as the panorama alone says, then levelled."""
    panorama, problem = panorama_at(scene, ball)
    if panorama is None:
        return None, problem
    up = estimate_up(cameras)
    whole = scene if also is None else concatenate([scene, also])
    orbit = float((cameras.centers - ball.center).norm(dim=1).median())
    radius = max(3 * ball.radius, min(orbit, 8 * ball.radius))
    voted, radius = _asked(whole, cameras, ball.center, radius, up)
    reflected = _told_by_surfaces(scene, ball, cameras)
    light = combine(panorama, voted, up, asked_within=radius, reflected=reflected)
    light = _through_windows(light, scene, ball)
    return (light, _levelled(light, reflected, up)), None


def _asked(
    whole: Gaussians, cameras: Cameras, center: Float[Tensor, "3"], radius: float, up: Float[Tensor, "3"]
) -> tuple[DirectionEstimate | None, float]:
    """The vote of the shadows near the place, or of those half as far again where the near ones say little; its radius.

    Near ones know best what reaches the place, but a bare table has none.
    """
    found: tuple[DirectionEstimate | None, float] = (None, radius)
    for wide in (radius, 1.5 * radius):
        part = whole.select((whole.means - center).norm(dim=1) < 1.4 * wide)
        normals = estimate_normals(part, cameras)
        glints = find_highlights(part, normals, cameras, center=center, radius=0.5 * wide)
        voted = estimate_direction(part, normals, center=center, radius=wide, up=up, highlights=glints)
        if voted is not None and (found[0] is None or voted.confidence > found[0].confidence):
            found = (voted, wide)
        if voted is not None and voted.confidence > _CLEAR:
            break
    return found


def _levelled(light: Light, told: float | None, up: Float[Tensor, "3"]) -> Light:
    """`light` as bright as two witnesses say in the mean (geometric): what is seen around, and what is lit by it.

    Much of what shines on a place was never photographed, so the panorama alone is off by a factor of two or more.
    The surfaces around the place reflect that light; under the albedo of a mean surface they tell it as well. They
    count as much as the panorama where `_UNSEEN` of it is missing, and nothing where it is whole.
    """
    if told is None:
        return light
    seen = float(light.irradiance(up[None]).mean())
    share = 0.5 * min(1.0, (1 - light.coverage) / _UNSEEN)
    factor = math.exp(share * max(-_LEVEL, min(_LEVEL, math.log(told / max(seen, 1e-9)))))
    sources = [replace(s, irradiance=tuple(factor * v for v in s.irradiance)) for s in light.sources]
    return replace(light, sources=tuple(sources), ambient=factor * light.ambient)


def _told_by_surfaces(scene: Gaussians, ball: BoundingSphere, cameras: Cameras) -> float | None:
    """Irradiance under which a mean surface looks as those that face up around the place; None without any."""
    near = (scene.means - ball.center).norm(dim=1) < _AROUND * ball.radius
    part = scene.select(near & (scene.opacities > 0.3))
    if part.count < 50:
        return None
    upward = estimate_normals(part, cameras).vectors @ estimate_up(cameras) > 0.7
    area = part.opacities * part.scales.sort(1).values[:, 1:].prod(1) * upward
    if int(upward.sum()) < 30:
        return None
    reflected = linear_from_srgb(rgb_from_dc(part.sh[:, 0]).clamp(0.002, 1)).mean(1)
    return math.pi * float((area * reflected).sum() / area.sum()) / _ALBEDO


def _through_windows(light: Light, scene: Gaussians, ball: BoundingSphere) -> Light:
    """Sources that are seen from the place get the distance to what is seen there: that does not block them."""
    sources = []
    for source in light.sources:
        if math.isfinite(source.blockers_within):
            sources.append(source)
            continue
        direction = torch.tensor(source.direction)
        helper = torch.tensor([0.0, 0.0, 1.0]) if abs(source.direction[2]) < 0.9 else torch.tensor([1.0, 0.0, 0.0])
        pose = look_at(ball.center[None], ball.center + direction, helper)
        seen = render(scene, pinhole(pose, 32.0, width=16, height=16), outputs=frozenset({"depth"}))
        there = (seen.alpha > 0.5) & (seen.depth > ball.radius)
        distance = float(seen.depth[there].quantile(0.25)) if bool(there.any()) else math.inf
        sources.append(replace(source, blockers_within=0.7 * distance))
    return replace(light, sources=tuple(sources))


def panorama_at(scene: Gaussians, ball: BoundingSphere) -> tuple[Panorama | None, str | None]:
    """The panorama from the middle of `ball`, or a sentence that says why there is none."""
    if scene.count == 0:
        return None, "The scene is empty."
    depth = render(scene, cube_cameras(ball.center, 24), outputs=frozenset({"depth"}))
    close = (depth.alpha > 0.5) & (depth.depth < 0.4 * ball.radius)
    if float(close.float().mean()) > _ENCLOSED:
        return None, "The object is inside a wall or another thing: there is no light to be found there."
    panorama = render_panorama(scene, ball.center, size=_SIZE, nearest=0.5 * ball.radius)
    if panorama.coverage < 0.1:
        return None, f"Only {100 * panorama.coverage:.0f}% of the object's surroundings were captured."
    mean = float((panorama.radiance.mean(-1) * panorama.alpha * panorama.solid_angles).sum()) / (4 * math.pi)
    if mean < 2e-3:
        return None, "There is no light at the object's place."
    return panorama, None


def combine(
    panorama: Panorama,
    voted: DirectionEstimate | None,
    up: Float[Tensor, "3"],
    *,
    asked_within: float,
    reflected: float | None = None,
) -> Light:
    """One light from both answers: sources that the panorama shows, that the shadows demand, or both.

    A source that only shadows speak for is blocked by what they were cast by: things `asked_within` that distance.
    `reflected` is the irradiance that surfaces around tell.
    """
    seen = light_from_panorama(panorama, up)
    patches = [s for s in seen.sources if float(torch.tensor(s.direction) @ up) > math.sin(_LOWEST)]
    ambient = float(replace(seen, sources=()).irradiance(up[None]).mean())
    main: LightSource | None = None
    used: set[int] = set()
    if voted is not None and voted.confidence > 0.1:
        usual = _usual(voted, ambient, up, reflected)
        main = replace(_from_vote(voted, ambient, usual), blockers_within=asked_within)
        for i, patch in enumerate(patches):
            apart = math.acos(max(-1.0, min(1.0, float(torch.tensor(patch.direction) @ voted.direction))))
            if apart < max(2.5 * voted.uncertainty, math.radians(15)) + math.radians(patch.angular_radius_deg):
                main = _fused(main, patch, apart)
                used.add(i)
                break
    if main is None and patches:
        main = _from_patch(patches[0], ambient, up)
        used.add(0)
    rest = [replace(p, name=_name(p)) for i, p in enumerate(patches) if i not in used]
    sources = ([main] if main is not None else []) + rest
    return replace(seen, sources=tuple(sources))


def _name(source: LightSource) -> str:
    solid_angle = 2 * math.pi * (1 - math.cos(math.radians(source.angular_radius_deg)))
    return "sun" if solid_angle < _SUN else "window"


def _usual(voted: DirectionEstimate, ambient: float, up: Float[Tensor, "3"], reflected: float | None) -> float:
    """Strength of a light that glints where shadows do not tell: as of a window, more where surfaces are too bright.

    What they reflect beyond the ambient light is the source's; as albedo is known to a factor of two, it counts half.
    """
    missing = 0.0 if reflected is None else (reflected - ambient) / (ambient * max(0.2, float(voted.direction @ up)))
    return _WINDOW * math.sqrt(1 + max(0.0, missing))


def _from_vote(voted: DirectionEstimate, ambient: float, usual: float) -> LightSource:
    # the less shadows tell, the more what glints is as strong as such things are
    believed = voted.explained / (voted.explained + _UNTOLD * voted.heard + 1e-6)
    gray = math.exp(believed * float(voted.strength.mean().log()) + (1 - believed) * math.log(usual))
    # the tint of a light is known less well than its strength
    tint = (voted.strength / voted.strength.mean().clamp_min(1e-6)).clamp(0.6, 1.6) ** 0.5
    rgb = gray * tint * ambient
    return LightSource(
        direction=tuple(voted.direction.tolist()),
        irradiance=tuple(rgb.tolist()),
        angular_radius_deg=1.0,
        uncertainty_deg=math.degrees(voted.uncertainty),
        confidence=voted.confidence,
        name="sun",
    )


def _fused(voted: LightSource, patch: LightSource, apart: float) -> LightSource:
    """Two sightings of one light: directions by inverse variance, the larger strength, more confidence."""
    # what shines is somewhere in a patch that a camera clipped: glare is wider than the sun, and not around it
    own = math.hypot(_GLARE_DEG, patch.angular_radius_deg)
    weight_voted, weight_patch = voted.uncertainty_deg**-2, own**-2
    mixed = weight_voted * torch.tensor(voted.direction) + weight_patch * torch.tensor(patch.direction)
    error = (weight_voted + weight_patch) ** -0.5
    disagreement = 0.6 * weight_patch / (weight_voted + weight_patch) * math.degrees(apart)
    return replace(
        voted,
        direction=tuple(torch.nn.functional.normalize(mixed, dim=0).tolist()),
        irradiance=tuple(max(a, b) for a, b in zip(voted.irradiance, patch.irradiance, strict=True)),
        angular_radius_deg=max(0.5 * patch.angular_radius_deg, 0.5),
        uncertainty_deg=math.hypot(error, disagreement),
        confidence=1 - (1 - voted.confidence) * 0.4,
        name=_name(patch),
        blockers_within=math.inf,
    )


def _from_patch(patch: LightSource, ambient: float, up: Float[Tensor, "3"]) -> LightSource:
    """A light that is seen but that no shadow speaks for: the prior 4:1 for a clear sun, 2:1 for a window."""
    name = _name(patch)
    cosine = max(0.25, float(torch.tensor(patch.direction) @ up))
    prior = (3.0 if name == "sun" else 1.0) * ambient / cosine
    seen = patch.luminance
    factor = max(1.0, prior / max(seen, 1e-9))
    return replace(
        patch,
        irradiance=tuple(v * factor for v in patch.irradiance),
        uncertainty_deg=max(patch.uncertainty_deg, 4.0),
        confidence=0.55,
        name=name,
    )
