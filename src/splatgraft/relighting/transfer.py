"""Physically based light transfer: objects placed in a scene get shading, shadows, bounce and gloss in layers.

Differential rendering (Debevec 1998) on Gaussians: the light at the old and the new place is estimated, and colours are
multiplied by ratios of irradiance. No training, no rendered views.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.bounds import bounding_sphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.composite import Composite
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.spherical_harmonics import MAX_DEGREE, coefficient_count
from splatgraft.relighting.layers import Relit, unchanged
from splatgraft.relighting.light.estimate import NoLight
from splatgraft.relighting.light.light import Light
from splatgraft.relighting.prepared_object import PreparedObject, SourceScene, prepare_object
from splatgraft.relighting.prepared_scene import PreparedScene, prepare_scene
from splatgraft.relighting.shading.gloss import gloss_bands
from splatgraft.relighting.shading.irradiance import (
    KNOWN_LIGHTS,
    ShadeSettings,
    irradiance,
    light_scale,
    shade_ratio,
    unknown_origin_ratio,
)
from splatgraft.relighting.shading.normals import raised
from splatgraft.relighting.shading.reflected_light import reflected_light
from splatgraft.relighting.shadows.receivers import RIM, Receivers, shade_receivers
from splatgraft.relighting.shadows.scene_ratio import (
    SceneRatio,
    light_sums,
    ratio_from_sums,
    reachable,
    scene_ratio,
    scene_visibility,
)
from splatgraft.relighting.shadows.view_fit import fit_to_views
from splatgraft.runtime.memo import Memo

_LEAST_BUDGET = 40_000
"""Gaussians that splitting may add to any scene: enough for the edges of one shadow on a surface of many layers; set by
hand."""


@dataclass(frozen=True)
class RelightOptions:
    """Reach of a transfer and the number of Gaussians it may add."""

    reach: float = 8.0
    """Shadows are computed up to this many object radii from the object."""
    most_added: float = 0.3
    """At most this share of the composite's Gaussians is added by splitting, or 40,000 where that is more; 0: none."""
    fitted_views: int = 8
    """Views of the target in which shadows are fitted to the surface that is seen; 0: none, for a quick draft."""


SHADOW_POWER = 1.3
"""Exponent of shadows under a light that was estimated: an average over what is possible has less contrast than the
light itself. Fitted by benchmarks/fit_shadows.py."""


@dataclass(frozen=True)
class _LitObject:
    """One object of n Gaussians in the prepared scene."""

    prepared: PreparedObject
    sample_visibility: Float[Tensor, "n k"]
    """Share of every light sample that reaches it past the scene, in [0, 1]."""
    received: Float[Tensor, "n 3"]
    """Linear rgb irradiance at the new place."""
    shade: Float[Tensor, "n 3"]
    """Factor on linear rgb by its own shading."""
    gloss: Float[Tensor, "n 16 3"] | None
    """Coefficients of what it reflects at its new place; None where it is matt."""


def relight(
    composite: Composite,
    cameras: Cameras,
    *,
    sources: Sequence[SourceScene | None] = (),
    light: Light | None = None,
    options: RelightOptions = RelightOptions(),
    cache: Memo | None = None,
) -> Relit:
    """Light the objects of a composite by the target scene, and add their shadows and reflected light to it.

    Colours change by ratios of irradiance (differential rendering), without training and without images.

    Args:
        composite: The target with the objects placed in it.
        cameras: The target's cameras; from them follows the up direction.
        sources: For every object the scene that it was taken from, without the object, whose light is divided out;
            None, or no sources at all, where it is not known: the object then keeps its mean brightness.
        light: The light at the place of the objects; estimated from the target where not given.
        options: How far shadows reach and how many Gaussians may be added.
        cache: Intermediate results, which later calls with the same objects at other places use again. After a short
            move they include the sources of the light and the region of the shadow maps: a call without them differs.

    Returns:
        The composite with its change of light in layers. Where no light can be estimated the layers change nothing
        and `report` gives the reason.

    Raises:
        ValueError: `sources` is neither empty nor one per object, or tells normals of another number of Gaussians.
    """
    if len(sources) not in (0, len(composite.objects)):
        raise ValueError(f"relight: expected {len(composite.objects)} source scenes, found {len(sources)}")
    baked, is_object = composite.merged()
    pairs = zip_longest(composite.objects, sources)
    placed = [(number, p, s) for number, (p, s) in enumerate(pairs, 1) if p.gaussians.count]
    if not placed:
        return unchanged(baked, is_object, objects=(), report=("No object is placed: nothing to light.",))
    cache = cache or Memo()
    target = cache.get(
        "scene", (composite.target, composite.erased), lambda: composite.target.select(~composite.erased)
    )
    spheres = [bounding_sphere(p.in_target()) for _, p, _ in placed]
    scene = prepare_scene(target, cameras, spheres=spheres, reach=options.reach, light=light, cache=cache)
    if isinstance(scene, NoLight):
        in_target = tuple(p.in_target() for _, p, _ in placed)
        return unchanged(
            baked, is_object, objects=in_target, report=(f"{scene.reason} The object is pasted as it is.",)
        )
    report = [scene.light.describe(estimate_up(cameras)) + (", as given." if scene.estimate is None else ".")]
    objects = []
    for number, one, source in placed:
        prepared = prepare_object(one, source, cameras, light=scene.light, index=number - 1, cache=cache)
        if prepared.notes is not None:
            report.append(f"Where object {number} comes from: {prepared.notes}")
        if prepared.source_lighting is None:
            report.append(unknown_light(number))
        objects.append(_lit_object(prepared, scene))
    return _assembled(scene, objects, cameras.spread(options.fitted_views), options=options, baked=baked, report=report)


def unknown_light(number: int) -> str:
    """The sentence on an object whose old light is not known."""
    return f"The light that object {number} had is not known: it keeps its mean brightness."


def _lit_object(prepared: PreparedObject, scene: PreparedScene) -> _LitObject:
    """The object with its shading by the scene's light, ambient light included."""
    normals, opacities = prepared.normals, prepared.gaussians.opacities
    visibility = scene_visibility(scene.maps, raised(prepared.gaussians, normals.vectors), normals.vectors)
    # the ambient light was captured at the place itself, where blockers are part of the panorama; so in the source
    shares = torch.where(torch.as_tensor(scene.samples.is_source), visibility, torch.ones(()))
    shares = prepared.self_visibility * shares
    received = irradiance(scene.samples, normals.vectors, sample_visibility=shares)
    source = prepared.source_lighting
    if source is None:
        return _LitObject(prepared, visibility, received, unknown_origin_ratio(received, opacities), None)
    settings = KNOWN_LIGHTS if scene.estimate is None and source.estimate is None else ShadeSettings()
    shade = shade_ratio(received, source.irradiance, opacities, settings=settings)
    if not bool(source.materials.glossy.any()):
        return _LitObject(prepared, visibility, received, shade, None)
    scale = light_scale(received, source.irradiance, opacities, settings=settings)
    reflected = reflected_light(scene.light, scene.samples, shares).scaled(scale)
    gloss = gloss_bands(prepared.gaussians, normals.vectors, source.materials, reflected, shade=shade)
    return _LitObject(prepared, visibility, received, shade, gloss)


def _assembled(
    scene: PreparedScene,
    objects: list[_LitObject],
    cameras: Cameras,
    *,
    options: RelightOptions,
    baked: Gaussians,
    report: list[str],
) -> Relit:
    """The layers of all Gaussians, in the order of the baked composite; pieces where their whole was."""
    budget = max(int(options.most_added * baked.count), _LEAST_BUDGET) if options.most_added > 0 else 0
    scene_count = scene.scene.count
    pressed = baked.select(torch.arange(scene_count))
    receivers, ratio = _on_scene(scene, pressed, objects, cameras, budget=budget)
    rest = torch.ones(scene_count, dtype=torch.bool)
    rest[receivers.origin] = False
    rest_index = rest.nonzero()[:, 0]
    on_objects = [_on_object(i, objects, _shadow_power(scene)) for i in range(len(objects))]
    replaced = [torch.full((o.prepared.gaussians.count,), o.prepared.source_lighting is not None) for o in objects]
    object_rows = torch.arange(scene_count, baked.count)
    gaussians = concatenate([baked.select(rest_index), receivers.gaussians, baked.select(object_rows)])
    count = gaussians.count - len(object_rows)
    ones, zeros = torch.ones(len(rest_index), 3), torch.zeros(len(rest_index), 3)
    origin = torch.cat([rest_index, receivers.origin, object_rows])
    order = origin.argsort(stable=True)
    return Relit(
        gaussians=gaussians.select(order),
        is_object=order >= count,
        origin=origin[order],
        shade=torch.cat([torch.ones(count, 3), *[one.shade for one in objects]])[order],
        shadow=torch.cat([ones, ratio.shadow, *[r.shadow for r in on_objects]])[order],
        bounce=torch.cat([zeros, ratio.bounce, *[r.bounce for r in on_objects]])[order],
        slope=torch.cat([zeros, ratio.slope, *[r.slope for r in on_objects]])[order],
        gloss=_glosses(objects, gaussians)[order],
        bands_replaced=torch.cat([torch.zeros(count, dtype=torch.bool), *replaced])[order],
        objects=tuple(one.prepared.gaussians for one in objects),
        light=scene.light,
        report=tuple(report),
        estimate=scene.estimate,
        received=tuple(one.received for one in objects),
        prepared=tuple(one.prepared for one in objects),
    )


def _on_scene(
    scene: PreparedScene, pressed: Gaussians, objects: list[_LitObject], cameras: Cameras, *, budget: int
) -> tuple[Receivers, SceneRatio]:
    """The receivers that some object reaches, split where needed, and the product of all objects' ratios on them.

    `pressed` is the scene as it is drawn, flat around the objects' feet; the ratios are fitted to what `cameras` see.
    """
    points, rims = scene.receivers.means, RIM * scene.receivers.scales.max(1).values
    reached = torch.zeros(len(points), dtype=torch.bool)
    for one in objects:
        sphere, farthest = one.prepared.sphere, scene.maps.region.radius
        reached |= reachable(points, sphere, scene.samples, farthest=farthest, rims=rims)
    receivers = Receivers(
        gaussians=pressed.select(scene.receiver_indices[reached]),
        normals=scene.normals.vectors[reached],
        sample_visibility=scene.sample_visibility[reached],
        surface=scene.surface[reached],
        origin=scene.receiver_indices[reached],
    )
    total: SceneRatio | None = None
    ambient_sums: list[Float[Tensor, "3 m 3"]] = []
    for one in objects:
        receivers, parents, ratio, ambient = shade_receivers(
            receivers, one.prepared.maps, budget=budget // len(objects)
        )
        ambient_sums = [*(sums[:, parents] for sums in ambient_sums), ambient]
        if total is None:
            total = ratio
            continue
        total = SceneRatio(
            shadow=total.shadow[parents] * ratio.shadow,
            bounce=total.bounce[parents] + ratio.bounce,
            slope=total.slope[parents] * ratio.shadow.mean(1, keepdim=True)
            + total.shadow[parents].mean(1, keepdim=True) * ratio.slope,
        )
    assert total is not None

    def ratio_at(points: Tensor, normals: Tensor, receiver: Tensor) -> Tensor:
        through, grey = receivers.sample_visibility[receiver], torch.ones(len(points))
        for one, ambient in zip(objects, ambient_sums, strict=True):
            sums = light_sums(one.prepared.maps, points, normals, sample_visibility=through, sources=True)
            found = ratio_from_sums(sums + ambient[:, receiver])
            grey = grey * (found.shadow + found.bounce).mean(1)
        return grey

    rest = torch.ones(pressed.count, dtype=torch.bool)
    rest[receivers.origin] = False
    fitted = fit_to_views(receivers, total, pressed.select(rest), cameras, ratio_at=ratio_at)
    return receivers, fitted.strengthened(_shadow_power(scene))


def _shadow_power(scene: PreparedScene) -> float:
    return 1.0 if scene.estimate is None else SHADOW_POWER


def _glosses(objects: list[_LitObject], gaussians: Gaussians) -> Float[Tensor, "m k 3"]:
    """The gloss layer of all m Gaussians, the objects' last; of degree 3 where something is glossy."""
    if all(one.gloss is None for one in objects):
        return torch.zeros_like(gaussians.sh)
    out = torch.zeros(gaussians.count, coefficient_count(MAX_DEGREE), 3)
    start = gaussians.count - sum(one.prepared.gaussians.count for one in objects)
    for one in objects:
        if one.gloss is not None:
            out[start : start + len(one.gloss)] = one.gloss
        start += one.prepared.gaussians.count
    return out


def _on_object(index: int, objects: list[_LitObject], power: float) -> SceneRatio:
    """Shadow and bounce of all other objects on one; shadows to a power."""
    one = objects[index]
    gaussians, normals = one.prepared.gaussians, one.prepared.normals.vectors
    shadow, bounce = torch.ones(gaussians.count, 3), torch.zeros(gaussians.count, 3)
    for other in objects:
        if other is not one:
            maps, visibility = other.prepared.maps, one.sample_visibility
            ratio = scene_ratio(maps, gaussians.means, normals, sample_visibility=visibility)
            shadow, bounce = shadow * ratio.shadow, bounce + ratio.bounce
    return SceneRatio(shadow=shadow, bounce=bounce, slope=torch.zeros_like(shadow)).strengthened(power)
