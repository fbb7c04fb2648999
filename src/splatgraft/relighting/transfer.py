"""The physical light transfer, whole: two lights, then an object's shading, shadow, bounce and gloss in layers.

Values in, values out: knows nothing about files or views.
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
from splatgraft.relighting.layers import Relit, unchanged
from splatgraft.relighting.light.light import Light
from splatgraft.relighting.prepared_object import PreparedObject, SourceScene, prepare_object
from splatgraft.relighting.prepared_scene import PreparedScene, prepare_scene
from splatgraft.relighting.shading.irradiance import irradiance, shade_ratio, unknown_origin_ratio
from splatgraft.relighting.shading.normals import raised
from splatgraft.relighting.shading.reflection import gloss_layer
from splatgraft.relighting.shadows.light_sampling import sample_light
from splatgraft.relighting.shadows.occlusion import LightSamples
from splatgraft.relighting.shadows.receivers import RIM, Receivers, shade_receivers
from splatgraft.relighting.shadows.scene_ratio import SceneRatio, reachable, scene_ratio, scene_visibility
from splatgraft.runtime.memo import Memo

_ENOUGH = 40_000  # pieces hold the edges of one shadow on a surface of many layers


@dataclass(frozen=True)
class RelightOptions:
    """What may be asked of a transfer."""

    reach: float = 8.0
    """Shadows are followed this many object radii far."""
    most_added: float = 0.3
    """At most this share of the composite's Gaussians is added by splitting, or 40,000 where that is more; 0: none."""


@dataclass(frozen=True)
class _LitObject:
    """One object on the stage."""

    body: PreparedObject
    arrives: Float[Tensor, "n k"]
    """Share of every bundle that the scene lets through to it."""


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
        cache: Intermediate results, which later calls with the same objects at other places use again.

    Returns:
        The composite with its change of light in layers. Where no light can be estimated the layers change nothing
        and `report` gives the reason.

    Raises:
        ValueError: `sources` is neither empty nor one per object.
    """
    if len(sources) not in (0, len(composite.objects)):
        raise ValueError(f"relight: expected {len(composite.objects)} source scenes, found {len(sources)}")
    baked, is_object = composite.merged()
    placed = [(p, s) for p, s in zip_longest(composite.objects, sources) if p.gaussians.count]
    if not placed:
        return unchanged(baked, is_object, objects=(), report=("No object is placed: nothing to light.",))
    cache = cache or Memo()
    scene = cache.get("scene", (composite.target, composite.erased), lambda: composite.target.select(~composite.erased))
    balls = [bounding_sphere(p.in_target()) for p, _ in placed]
    stage, problem = prepare_scene(scene, cameras, balls=balls, reach=options.reach, light=light, cache=cache)
    if stage is None:
        objects = tuple(p.in_target() for p, _ in placed)
        return unchanged(baked, is_object, objects=objects, report=(f"{problem} The object is pasted as it is.",))
    beams = sample_light(stage.light)
    report = [stage.light.describe(estimate_up(cameras)) + (", as given." if light is not None else ".")]
    actors, shades = [], []
    for i, (one, source) in enumerate(placed):
        body = prepare_object(one, source, cameras, light=stage.light, index=i, cache=cache)
        if body.story is not None:
            report.append(f"Where object {i + 1} comes from: {body.story}")
        if body.before is None:
            report.append(f"The light that object {i + 1} had is not known: it keeps its mean brightness.")
        facing = body.normals.vectors
        actor = _LitObject(body, scene_visibility(stage.maps, raised(body.gaussians, facing), facing))
        actors.append(actor)
        shades.append(_shade(actor, beams, stage.light))
    return _assembled(stage, actors, shades, beams, options=options, baked=baked, report=report)


def _shade(actor: _LitObject, beams: LightSamples, light: Light) -> Float[Tensor, "n 3"]:
    body = actor.body
    # ambient light was looked at from the place itself: what blocks it is in the panorama already, as at the old place
    arrives = torch.where(torch.as_tensor(beams.is_source), actor.arrives, torch.ones(()))
    now = irradiance(beams, body.normals.vectors, arrives=body.own * arrives)
    if body.then is None or body.before is None:
        return unknown_origin_ratio(now, body.normals, body.gaussians.opacities)
    seen = 0.5 * (light.coverage + body.before.coverage)
    return shade_ratio(now, body.then, body.normals, body.gaussians.opacities, seen=seen)


def _assembled(  # noqa: PLR0913
    stage: PreparedScene,
    actors: list[_LitObject],
    shades: list[Float[Tensor, "n 3"]],
    beams: LightSamples,
    *,
    options: RelightOptions,
    baked: Gaussians,
    report: list[str],
) -> Relit:
    """Objects on the scene, objects on each other, and all layers in one list."""
    budget = max(int(options.most_added * baked.count), _ENOUGH) if options.most_added > 0 else 0
    lit, ratio = _on_scene(stage, actors, beams, budget=budget, degree=baked.sh_degree)
    scene_count = stage.scene.count
    rest = torch.ones(scene_count, dtype=torch.bool)
    rest[lit.origin] = False
    rest_index = rest.nonzero()[:, 0]
    on_objects = [_on_object(i, actors) for i in range(len(actors))]
    glosses = [_gloss(a, s, stage, baked.sh_degree) for a, s in zip(actors, shades, strict=True)]
    object_rows = torch.arange(scene_count, baked.count)
    gaussians = concatenate([baked.select(rest_index), lit.gaussians, baked.select(object_rows)])
    count = gaussians.count - len(object_rows)
    ones, zeros = torch.ones(len(rest_index), 3), torch.zeros(len(rest_index), 3)
    origin = torch.cat([rest_index, lit.origin, object_rows])
    # the order of the baked composite, pieces where their whole was
    order = origin.argsort(stable=True)
    return Relit(
        gaussians=gaussians.select(order),
        is_object=order >= count,
        origin=origin[order],
        shade=torch.cat([torch.ones(count, 3), *shades])[order],
        shadow=torch.cat([ones, ratio.shadow, *[r.shadow for r in on_objects]])[order],
        bounce=torch.cat([zeros, ratio.bounce, *[r.bounce for r in on_objects]])[order],
        slope=torch.cat([zeros, ratio.slope, *[r.slope for r in on_objects]])[order],
        gloss=torch.cat([torch.zeros_like(gaussians.sh[:count]), *glosses])[order],
        objects=tuple(actor.body.gaussians for actor in actors),
        light=stage.light,
        report=tuple(report),
    )


def _on_scene(
    stage: PreparedScene, actors: list[_LitObject], beams: LightSamples, *, budget: int, degree: int
) -> tuple[Receivers, SceneRatio]:
    """The members that some object reaches, split where needed, and the product of all objects' ratios on them."""
    points, rims = stage.around.means, RIM * stage.around.scales.max(1).values
    reached = torch.zeros(len(points), dtype=torch.bool)
    for actor in actors:
        reached |= reachable(points, actor.body.ball, beams, farthest=stage.maps.region.radius, rims=rims)
    receivers = Receivers(
        gaussians=stage.around.select(reached).with_sh_degree(degree),
        normals=stage.normals.vectors[reached],
        arrives=stage.arrives[reached],
        trust=torch.ones(int(reached.sum())),
        origin=stage.members[reached],
    )
    found: SceneRatio | None = None
    for actor in actors:
        receivers, parents, ratio = shade_receivers(receivers, actor.body.maps, budget=budget // len(actors))
        if found is None:
            found = ratio
            continue
        found = SceneRatio(
            shadow=found.shadow[parents] * ratio.shadow,
            bounce=found.bounce[parents] + ratio.bounce,
            slope=found.slope[parents] * ratio.shadow.mean(1, keepdim=True)
            + found.shadow[parents].mean(1, keepdim=True) * ratio.slope,
        )
    assert found is not None
    return receivers, found


def _gloss(actor: _LitObject, shade: Float[Tensor, "n 3"], stage: PreparedScene, degree: int) -> Float[Tensor, "n k 3"]:
    body = actor.body
    gaussians = body.gaussians.with_sh_degree(degree)
    if body.before is None:
        return torch.zeros_like(gaussians.sh)
    return gloss_layer(gaussians, body.normals, body.before, stage.light, ratio=shade)


def _on_object(index: int, actors: list[_LitObject]) -> SceneRatio:
    """What all other objects take from and give to one."""
    actor = actors[index]
    shadow = torch.ones(actor.body.gaussians.count, 3)
    bounce = torch.zeros(actor.body.gaussians.count, 3)
    for other in actors:
        if other is not actor:
            points, facing = actor.body.gaussians.means, actor.body.normals.vectors
            ratio = scene_ratio(other.body.maps, points, facing, arrives=actor.arrives)
            shadow, bounce = shadow * ratio.shadow, bounce + ratio.bounce
    return SceneRatio(shadow=shadow, bounce=bounce, slope=torch.zeros_like(shadow))
