"""The light at a place of a scene, asked twice: of the panorama from there and of the scene's own shadows; combined.

Knows nothing about objects' shading or files.
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.cameras import Cameras, look_at, pinhole
from splatgraft.gaussians import Gaussians, concatenate
from splatgraft.relight.estimate_light import light_of
from splatgraft.relight.light import Light, LightSource
from splatgraft.relight.normals import estimate_normals
from splatgraft.relight.panorama import Panorama, cube_cameras, render_panorama
from splatgraft.relight.scene_shading import Ball
from splatgraft.relight.vote import Vote, vote
from splatgraft.rendering import render

_LOWEST = math.radians(4)  # bright patches below are reflections
_SUN = 0.03  # steradians; the glare of a sun in a photograph is smaller, a window larger
_ENCLOSED = 0.6
_SIZE = 64  # pixels along each face of the panorama


def up_of(cameras: Cameras) -> Float[Tensor, "3"]:
    """The mean upward direction of cameras held by people: the least that images' columns agree on."""
    return torch.nn.functional.normalize(-cameras.world_from_camera[:, :3, 1].mean(0), dim=0)


def light_at(
    scene: Gaussians, ball: Ball, cameras: Cameras, *, also: Gaussians | None = None
) -> tuple[Light | None, str | None]:
    """The light in the middle of `ball`, or a sentence that says why there is none.

    `also` stands in the scene too and casts shadows, but is not seen from the middle: the object itself.
    """
    panorama, problem = panorama_at(scene, ball)
    if panorama is None:
        return None, problem
    up = up_of(cameras)
    whole = scene if also is None else concatenate([scene, also])
    orbit = float((cameras.centers - ball.center).norm(dim=1).median())
    radius = max(3 * ball.radius, min(orbit, 8 * ball.radius))
    near = (whole.means - ball.center).norm(dim=1) < 1.4 * radius
    whole = whole.select(near)
    voted = vote(whole, estimate_normals(whole, cameras), center=ball.center, radius=radius, up=up)
    light = combine(panorama, voted, up, asked_within=radius)
    return _through_windows(light, scene, ball), None


def _through_windows(light: Light, scene: Gaussians, ball: Ball) -> Light:
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
        assert seen.depth is not None
        there = (seen.alpha > 0.5) & (seen.depth > ball.radius)
        distance = float(seen.depth[there].quantile(0.25)) if bool(there.any()) else math.inf
        sources.append(replace(source, blockers_within=0.7 * distance))
    return replace(light, sources=tuple(sources))


def panorama_at(scene: Gaussians, ball: Ball) -> tuple[Panorama | None, str | None]:
    """The panorama from the middle of `ball`, or a sentence that says why there is none."""
    if scene.count == 0:
        return None, "The scene is empty."
    depth = render(scene, cube_cameras(ball.center, 24), outputs=frozenset({"depth"}))
    assert depth.depth is not None
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


def combine(panorama: Panorama, voted: Vote | None, up: Float[Tensor, "3"], *, asked_within: float) -> Light:
    """One light from both answers: sources that the panorama shows, that the shadows demand, or both.

    A source that only shadows speak for is blocked by what they were cast by: things `asked_within` that distance.
    """
    seen = light_of(panorama, up)
    patches = [s for s in seen.sources if float(torch.tensor(s.direction) @ up) > math.sin(_LOWEST)]
    ambient = float(replace(seen, sources=()).irradiance(up[None]).mean())
    main: LightSource | None = None
    used: set[int] = set()
    if voted is not None and voted.confidence > 0.1:
        main = replace(_from_vote(voted, ambient), blockers_within=asked_within)
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


def _from_vote(voted: Vote, ambient: float) -> LightSource:
    # the tint of a light is known less well than its strength
    gray = voted.strength.mean()
    tint = (voted.strength / gray.clamp_min(1e-6)).clamp(0.6, 1.6) ** 0.5
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
    own = math.hypot(patch.uncertainty_deg, 0.5 * patch.angular_radius_deg)
    weight_voted, weight_patch = voted.uncertainty_deg**-2, own**-2
    mixed = weight_voted * torch.tensor(voted.direction) + weight_patch * torch.tensor(patch.direction)
    error = (weight_voted + weight_patch) ** -0.5
    disagreement = 0.3 * math.degrees(apart)
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
