"""Measure what each mechanism of the light transfer gains: switch it off alone, or replace it by the plain thing.

    python benchmarks/ablation.py SCENES [SCENES ...] --work FOLDER [...] --out FILE [--rows NAME ...]

`splatgraft paper exam` renders the scenes. Everything is estimated; the held-out views are measured. A value is the
difference to the full transfer, so a lower PSNR or a higher shadow error shows that the mechanism helps. The table
gives its mean over scenes, the standard error of that mean, and the number of scenes that are better and worse.

Results are saved after every row of a scene, and the same command continues after a stop. After a change of the
transfer, start with a new file.

A row reuses those values of the full transfer that do not depend on the stage that it changes (`STAGES`). CPU seconds
are compared with the full transfer that reuses the same values, which must give its result again in every bit.
"""

import json
import math
import statistics
import time
import traceback
from argparse import Namespace
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, fields, replace
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import Any
from unittest import mock

import torch
from exam_scenes import scene_arguments, scenes_in
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.relighting import LayerWeights, Light, Relit, relight
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.light.estimate import _ambient_of, estimate_light
from splatgraft.relighting.light.evidence import ShadingEvidence, _nothing, _smooth_lobe
from splatgraft.relighting.light.known_sun import known_sun
from splatgraft.relighting.light.panorama import DIRECTIONS, Surroundings, place_surroundings
from splatgraft.relighting.light.radiance_model import (
    LightEvidence,
    RadianceProblem,
    RadianceSettings,
    radiance_problem,
)
from splatgraft.relighting.light.radiance_search import RadianceEstimate
from splatgraft.relighting.light.samples import LightSamples
from splatgraft.relighting.light.sun import Sun, find_sun
from splatgraft.relighting.materials import ReflectedLight, estimate_materials, reflected_light
from splatgraft.relighting.shading import ShadeSettings, shade_ratio
from splatgraft.relighting.shadows.occlusion import Occlusion, occluded_irradiance, occlusion_from_maps
from splatgraft.relighting.shadows.scene_ratio import (
    SceneShadowMaps,
    object_shadow_maps,
    scene_shadow_maps,
    self_visibility,
)
from splatgraft.relighting.shadows.shadow_maps import DepthMaps
from splatgraft.rendering import Render, render
from splatgraft_paper.exam.measure import measure_row
from splatgraft_paper.exam.scenes import ExamScene

FULL = "full"

_EVIDENCE = tuple(
    f"relighting.light.estimate.{name}"
    for name in ("find_shading_evidence", "find_highlights", "surroundings_at", "place_surroundings")
)
_RADIANCE, _SUN = ("relighting.light.estimate.search_radiance",), ("relighting.light.estimate.find_sun",)
_LIGHT = ("relighting.scene_light.estimate_light", "relighting.prepared_object.estimate_light")
_PLACE, _OBJECT = (
    (*_LIGHT, "relighting.transfer.find_scene_light"),
    tuple(f"relighting.transfer.{name}" for name in ("capture_object", "prepare_object")),
)
_SHADOWS = ("relighting.transfer.cast_shadows",)

STAGES: Mapping[str, tuple[str, ...]] = {
    "scene": (),
    "evidence": _SUN,
    "sun": _EVIDENCE + _RADIANCE,
    "radiance": _EVIDENCE + _SUN,
    "sources": _EVIDENCE + _SUN + _RADIANCE,
    "place": _LIGHT,
    "object": _PLACE,
    "shadows": _PLACE + _OBJECT,
    "layers": _PLACE + _OBJECT + _SHADOWS,
}
"""Stages of the transfer, each with the calls that do not depend on it, by their names within `splatgraft`.

If a row changes a stage, these calls give the values of the full transfer."""


@dataclass(frozen=True)
class Row:
    """The transfer without one mechanism."""

    stage: str
    """First of the `STAGES` that the row changes."""
    without: str
    """The mechanism, and what replaces it."""
    patches: Mapping[str, object]
    """Replacements of functions and constants, by their names within `splatgraft`."""


# replacements; each has the parameters of the function that it replaces


def kept_target(target: Gaussians, objects: Sequence[Gaussians]) -> Gaussians:
    return target


def no_height(gaussians: Gaussians, normals: Tensor) -> Tensor:
    return torch.zeros(gaussians.count)


def centers(gaussians: Gaussians, normals: Tensor) -> Tensor:
    return gaussians.means


def plain_depth(self: CapturedScene, camera: Cameras) -> Render:
    return render(self.gaussians, camera, outputs=frozenset({"color", "depth"}))


def one_group(brightness: Tensor, normals: Tensor) -> Tensor:
    return torch.zeros(len(brightness), dtype=torch.int64)


def past_no_scene(maps: SceneShadowMaps, points: Tensor, normals: Tensor, **_heights: Tensor) -> Tensor:
    sources = 0 if maps.source_maps is None else len(maps.source_maps.first)
    return torch.ones(len(points), sources + len(maps.ambient_maps.first))


def past_no_object(gaussians: Gaussians, sphere: object, normals: Tensor, samples: LightSamples) -> Tensor:
    return torch.ones(gaussians.count, len(samples))


def past_object(
    gaussians: Gaussians, sphere: BoundingSphere, normals: Tensor, samples: LightSamples, *, sources_pass: bool
) -> Tensor:
    """Return the visibility past the object, but 1 for the sources' samples, or for those of the ambient light."""
    passing = torch.tensor(samples.is_source) == sources_pass
    return torch.where(passing, 1, self_visibility(gaussians, sphere, normals, samples))


def with_samples(function: Callable[..., Any], at: int, **values: float) -> Callable[..., Any]:
    """Set fields of the light samples, which are the argument at position `at`, to one value for all samples."""

    def call(*args: Any, **more: Any) -> Any:
        samples = args[at]
        changes = {
            name: (value,) * len(samples) if name == "blockers_within" else torch.full((len(samples),), value)
            for name, value in values.items()
        }
        return function(*args[:at], replace(samples, **changes), *args[at + 1 :], **more)

    return call


SummedLight = tuple[Tensor, Tensor, Tensor]
"""Irradiance on the receivers: without the object, with it, and the part that the object reflects."""


def occluded(
    change: Callable[[SummedLight, LightSamples], SummedLight],
    occlusion: Occlusion,
    samples: LightSamples,
    *args,
    **more,
) -> SummedLight:
    """Change the sums of light around the object."""
    return change(occluded_irradiance(occlusion, samples, *args, **more), samples)


def without_bounce(sums: SummedLight, samples: LightSamples) -> SummedLight:
    return sums[0], sums[1], torch.zeros_like(sums[2])


def without_ambient_shadow(sums: SummedLight, samples: LightSamples) -> SummedLight:
    return sums if samples.is_source[0] else (sums[0], sums[0], sums[2])


def without_source_shadow(sums: SummedLight, samples: LightSamples) -> SummedLight:
    return (sums[0], sums[0], sums[2]) if samples.is_source[0] else sums


def hard_shadows(occlusion: Occlusion, samples: LightSamples, *args: Any, **more: Any) -> SummedLight:
    """Compute the sums of light with sources of a twentieth of a degree."""
    hard = replace(samples, softness=torch.full_like(samples.softness, 1e-3)) if samples.is_source[0] else samples
    return occluded_irradiance(occlusion, hard, *args, **more)


def evenly_colored(maps: DepthMaps, front: Tensor, back: Tensor) -> Occlusion:
    """Build an object's pyramids with its mean colour on all sides."""
    mean = maps.color.sum((0, 2, 3)) / maps.alpha.sum()
    color = maps.alpha[:, None] * mean[:, None, None]
    return occlusion_from_maps(replace(maps, color=color), front, back)


def no_change(scene: Gaussians, change: Tensor, center: Tensor, *, nearest: float) -> Tensor:
    return torch.zeros(9, 3)


def matt(gaussians: Gaussians, normals: Tensor, views: object, light: ReflectedLight):
    return estimate_materials(gaussians, normals, (), light)


def unblocked_reflections(light: Light, samples: LightSamples, visibility: Tensor) -> ReflectedLight:
    return reflected_light(light, samples, torch.ones_like(visibility))


_shaded, _transport, _radiance = Relit.shaded, ShadingEvidence.transport, RadianceEstimate.radiance


def with_captured_bands(self: Relit, weights: LayerWeights = LayerWeights()) -> Gaussians:
    return _shaded(self, replace(weights, gloss=0.0))


def without_slope(self: Relit, weights: LayerWeights = LayerWeights()) -> Gaussians:
    return _shaded(replace(self, slope=torch.zeros_like(self.slope)), weights)


def one_gain(target: Tensor, source: Tensor, opacities: Tensor, *, settings: ShadeSettings) -> Tensor:
    ratio = shade_ratio(target, source, opacities, settings=settings)
    weights = (opacities / opacities.sum())[:, None]
    return (weights * ratio.log()).sum(0, keepdim=True).exp().expand_as(ratio)


def distant_emitters(self: ShadingEvidence, distances: Tensor | None = None) -> Tensor:
    return _transport(self)


def tinted_unseen(self: RadianceEstimate, evidence: LightEvidence) -> Float[Tensor, "k 3"]:
    """Give the light that no camera recorded the mean colour of the recorded light."""
    seen = evidence.around.radiance
    return seen + (_radiance(self, evidence) - seen) * seen.mean(0) / seen.mean().clamp_min(1e-9)


def without_clipped_direction(*args: Any) -> Surroundings:
    return replace(place_surroundings(*args), clipped_direction=DIRECTIONS)


def unclipped_receivers(found: LightEvidence) -> RadianceProblem:
    problem = radiance_problem(found)
    return replace(problem, is_white=torch.zeros_like(problem.is_white))


def even_ambient(rest: Tensor) -> Tensor:
    ambient = _ambient_of(rest)
    ambient[1:] = 0
    return ambient


def without_object(captured: CapturedScene, place: Any, *, object_gaussians: Gaussians) -> Any:
    return estimate_light(captured, place)


def changed_sun(captured: CapturedScene, region: Any, *, outdoors: bool, **changes: Any) -> Sun | None:
    sun = find_sun(captured, region, outdoors=outdoors)
    return None if sun is None else replace(sun, **changes)


def sun_on_one_surface(captured: CapturedScene, region: Any, *, outdoors: bool) -> Sun | None:
    return find_sun(captured, region)


def no_sun_by_shading(captured: CapturedScene, main: Any, sky: Any, *, outdoors: bool, is_unseen: bool) -> Any:
    return known_sun(captured, main, sky, outdoors=False, is_unseen=is_unseen)


def density(**changes: float) -> dict[str, object]:
    """Change parameters of the density of the light."""
    return {
        "relighting.light.estimate.radiance_problem": partial(radiance_problem, settings=RadianceSettings(**changes))
    }


def shading(**changes: float) -> dict[str, object]:
    """Change limits and shares of the shading."""
    return {"relighting.layers.ShadeSettings": partial(ShadeSettings, **changes)}


def summed_light(function: Callable[..., SummedLight]) -> dict[str, object]:
    """Replace the sums of light around the object."""
    return {"relighting.shadows.scene_ratio.occluded_irradiance": function}


_MANY = 1e6  # standard deviations, factors and degrees of freedom that are as good as infinite

ROWS: Mapping[str, Row] = {
    # contact with the support
    "contact": Row(
        "shadows",
        "contact flattening",
        {"compositing.composite.flatten_contact_layers": kept_target},
    ),
    "wide-gaussians": Row(
        "layers",
        "splitting of wide Gaussians around the object",
        {"relighting.layers.split_wide_around": lambda gaussians, is_object, objects: (gaussians, is_object)},
    ),
    # shadow and bounce on the scene
    "view-fit": Row(
        "shadows",
        "fit of the shadow to views",
        {"relighting.cast_shadows.fit_to_views": lambda ratio, *_: ratio},
    ),
    "view-fit-slope": Row("shadows", "slopes in that fit", {"relighting.shadows.view_fit._MAX_SLOPE": 0.0}),
    "splitting": Row(
        "shadows",
        "splitting of receivers at shadow edges",
        {"relighting.transfer.RelightOptions.budget": lambda self, count: 0},
    ),
    "slope": Row("layers", "all view dependence of shadows", {"relighting.layers.Relit.shaded": without_slope}),
    "power": Row("shadows", "power 1.3 of shadows without a sun", {"relighting.cast_shadows.SHADOW_POWER": 1.0}),
    "source-shadow": Row("shadows", "shadow of the sources", summed_light(partial(occluded, without_source_shadow))),
    "ambient-shadow": Row(
        "shadows", "shadow of the ambient light", summed_light(partial(occluded, without_ambient_shadow))
    ),
    "penumbra": Row("shadows", "penumbrae; hard shadows of the sources", summed_light(hard_shadows)),
    "bounce": Row("shadows", "bounce of the object", summed_light(partial(occluded, without_bounce))),
    "bounce-color": Row(
        "object",
        "bounce in the colour of the unlit side; the mean colour",
        {"relighting.shadows.scene_ratio.occlusion_from_maps": evenly_colored},
    ),
    "bounce-limit": Row("object", "limit of the albedo", {"relighting.prepared_object._MAX_ALBEDO": _MANY}),
    "darkest": Row(
        "shadows",
        "lower limit of shadows",
        {f"relighting.shadows.{name}.DARKEST": 1e-3 for name in ("scene_ratio", "view_fit", "surface_views")},
    ),
    "small-changes": Row("shadows", "removal of small changes", {"relighting.shadows.scene_ratio._MIN_CHANGE": 1e-9}),
    # shadows of the scene
    "scene-on-object": Row(
        "shadows", "shadow of the scene on the object", {"relighting.cast_shadows.scene_visibility": past_no_scene}
    ),
    "scene-on-scene": Row(
        "place",
        "shadow of the scene on receivers, which objects do not darken again",
        {"relighting.scene_light.scene_visibility": past_no_scene},
    ),
    "layer-height": Row(
        "place", "receivers lit above the layer's top; at centres", {"relighting.scene_light.layer_height": no_height}
    ),
    "layer-middle": Row(
        "place", "surface in the layer's middle; at centres", {"relighting.scene_light.layer_middle": centers}
    ),
    "thinned": Row(
        "place",
        "thinning of the scene's occluders",
        {"relighting.shadows.scene_ratio.thinned": lambda gaussians, *, width: gaussians},
    ),
    # samples of the light
    "blockers": Row(
        "place",
        "farthest distance of blockers",
        {"relighting.scene_light.scene_shadow_maps": with_samples(scene_shadow_maps, 2, blockers_within=math.inf)},
    ),
    "uncertainty": Row(
        "place", "softening of sources by their uncertainty", {"relighting.light.light._UNCERTAINTY_BLUR": 0.0}
    ),
    "lamp-distance": Row(
        "object",
        "distance of lamps",
        {"relighting.prepared_object.object_shadow_maps": with_samples(object_shadow_maps, 2, distances=math.inf)},
    ),
    # normals
    "depth-normals": Row(
        "object",
        "normals from depth; the neighbours' alone",
        {"relighting.prepared_object.fuse_normals": lambda gaussians, views, neighbours, *, radius: neighbours},
    ),
    "neighbour-normals": Row(
        "object", "the neighbours' normals beside those from depth", {"relighting.object_views._NEIGHBOURS": 0.0}
    ),
    "mixture-normals": Row(
        "scene", "normals of mixtures of neighbours; the shortest axis", {"relighting.normals._NEIGHBOURS": 1}
    ),
    "smooth-normals": Row(
        "scene",
        "average of normals over neighbours",
        {"relighting.normals._smoothed": lambda normals, neighbours: normals},
    ),
    "nearness": Row(
        "scene",
        "depth of a scene's views from mean nearness; mean depth",
        {"relighting.captured_scene.CapturedScene._drawn": plain_depth},
    ),
    "raised": Row("object", "visibility at the visible side; at centres", {"relighting.normals._RAISED": 0.0}),
    # the object under its lights
    "old-light": Row(
        "object", "division by the old light", {"relighting.transfer.find_source_light": lambda gaussians, source: None}
    ),
    "shading": Row("layers", "shading; one gain per channel", {"relighting.layers.shade_ratio": one_gain}),
    "self-occlusion": Row(
        "object", "occlusion of the object by itself", {"relighting.prepared_object.self_visibility": past_no_object}
    ),
    "self-shadow": Row(
        "object",
        "occlusion of the sources alone by itself",
        {"relighting.prepared_object.self_visibility": partial(past_object, sources_pass=True)},
    ),
    "self-ambient": Row(
        "object",
        "occlusion of the ambient light alone by itself",
        {"relighting.prepared_object.self_visibility": partial(past_object, sources_pass=False)},
    ),
    "self-third": Row(
        "object", "a third of the ambient light passes it", {"relighting.shadows.scene_ratio._SELF_AMBIENT": 0.0}
    ),
    "shadowed-surroundings": Row(
        "layers",
        "shadows and bounce in the ambient light of the object",
        {"relighting.layers.radiance_change": no_change},
    ),
    "soft-cosine": Row(
        "place",
        "mean cosine over a source; that of its middle",
        {"relighting.shading.soft_cosine": lambda cosine, softness: cosine.clamp_min(0)},
    ),
    "level-share": Row("layers", "damping of the level; all of it", shading(level_share=1.0)),
    "level": Row("layers", "level; none of it", shading(level_share=0.0)),
    "tint-share": Row("layers", "damping of the tint; all of it", shading(tint_share=1.0)),
    "tint": Row("layers", "tint; none of it", shading(tint_share=0.0)),
    "floor": Row("layers", "light added to both irradiances", shading(floor=0.0)),
    # gloss
    "gloss": Row("object", "gloss; a matt object", {"relighting.prepared_object.estimate_materials": matt}),
    "bands": Row(
        "layers",
        "dropping of the captured bands and gloss",
        {"relighting.layers.Relit.shaded": with_captured_bands},
    ),
    "gloss-clusters": Row("object", "six materials; one", {"relighting.materials._CLUSTERS": 1}),
    "gloss-evidence": Row(
        "object", "shrinking of lobes with little evidence", {"relighting.materials._EVIDENCE": 1e-9}
    ),
    "gloss-width": Row("object", "width of lobes; one of five", {"relighting.materials._CONCENTRATIONS": (6.0,)}),
    "gloss-fresnel": Row(
        "object",
        "growth of reflectance at flat views",
        {"relighting.materials._schlick": lambda cosine, facing: torch.ones_like(cosine)},
    ),
    "gloss-matt": Row("object", "smallest matt share", {"relighting.materials._MIN_MATT": 1e-3}),
    "gloss-occlusion": Row(
        "object",
        "occlusion of reflected light",
        {f"relighting.{name}.reflected_light": unblocked_reflections for name in ("prepared_object", "layers")},
    ),
    # evidence for the light
    "highlights": Row(
        "evidence",
        "highlights as evidence",
        {"relighting.light.estimate.find_highlights": lambda captured, *, region: None},
    ),
    "highlight-groups": Row(
        "evidence", "materials of highlights; one", {"relighting.light.evidence.group_materials": one_group}
    ),
    "rough-lobe": Row(
        "evidence", "rough beside smooth lobes of highlights", {"relighting.light.evidence._LOBES": (_smooth_lobe,)}
    ),
    "surfaces": Row(
        "evidence",
        "shading of surfaces as evidence",
        {"relighting.light.estimate.find_shading_evidence": lambda captured, *, region: _nothing(region)},
    ),
    "materials": Row("evidence", "materials of surfaces; one", {"relighting.light.evidence._MATERIALS": 1}),
    "material-places": Row(
        "evidence", "place in these materials; colour alone", {"relighting.light.evidence._POSITION_UNIT": _MANY}
    ),
    "surface-shadows": Row(
        "evidence",
        "shadows on surfaces as evidence",
        {
            "relighting.light.evidence.visibility": lambda maps, points, normals, *, bias: torch.ones(
                len(points), len(maps.first)
            )
        },
    ),
    "few-occluders": Row("evidence", "thinning of occluders", {"relighting.light.evidence._MAX_OCCLUDERS": 10**9}),
    "emitter-distance": Row(
        "radiance",
        "distance of emitters",
        {"relighting.light.evidence.ShadingEvidence.transport": distant_emitters},
    ),
    "old-object": Row(
        "scene",
        "the object as evidence for its old light",
        {"relighting.prepared_object.estimate_light": without_object},
    ),
    # surroundings
    "clipped": Row("evidence", "white pixels may be brighter", {"relighting.light.panorama.CLIPPED": 2.0}),
    "clipped-sources": Row(
        "radiance", "clipped patches may be sources", {"relighting.light.radiance_model._MAX_PATCHES": 0}
    ),
    "clipped-direction": Row(
        "evidence",
        "directions of clipped patches; those of bins",
        {"relighting.light.estimate.place_surroundings": without_clipped_direction},
    ),
    "clipped-surfaces": Row(
        "radiance",
        "clipped surfaces may be brighter",
        {"relighting.light.estimate.radiance_problem": unclipped_receivers},
    ),
    "photographed": Row(
        "evidence",
        "directions outside of all photos are unseen",
        {"relighting.light.panorama._photographed": lambda points, cameras: torch.ones(len(points), dtype=torch.bool)},
    ),
    "unseen-white": Row(
        "sources",
        "white light from unseen directions; the mean colour",
        {"relighting.light.radiance_search.RadianceEstimate.radiance": tinted_unseen},
    ),
    "near-panorama": Row("evidence", "nearest Gaussians left out", {"relighting.light.panorama.NEAREST": 0.0}),
    "wide-panorama": Row("evidence", "wide Gaussians left out", {"relighting.light.panorama._WIDEST": math.inf}),
    "far": Row("evidence", "distant surroundings for surfaces", {"relighting.light.estimate._FAR": 0.06}),
    # density of the light
    "student": Row("radiance", "heavy tails of the surfaces' errors", density(nu=_MANY)),
    "near-surfaces": Row("radiance", "weight of near surfaces", density(near=_MANY)),
    "effective": Row("radiance", "dependence of neighbours' errors", density(effective=1000.0)),
    "albedo": Row("radiance", "prior of albedos", density(albedo_sd=_MANY)),
    "albedo-outdoors": Row(
        "radiance", "darker materials out of doors", density(albedo_outdoors=RadianceSettings().albedo)
    ),
    "material-count": Row("radiance", "limit of independent albedos", density(materials=_MANY)),
    "sky": Row("radiance", "prior of the unseen level", density(sky_sd=_MANY)),
    "unseen-tails": Row("radiance", "heavy tails of unseen directions", density(unseen_nu=_MANY)),
    "lamps": Row(
        "radiance", "lamps among the directions", {"relighting.light.radiance_search._with_lamps": lambda *_: []}
    ),
    "average": Row(
        "radiance",
        "average over maxima; the best",
        {"relighting.light.radiance_search._distinct": lambda problem, maxima: maxima[:1]},
    ),
    "lamp-spread": Row(
        "radiance", "spread of unseen lamps", {"relighting.light.radiance_search._SPREAD": math.radians(1)}
    ),
    # the light from its radiance
    "peaks": Row(
        "sources",
        "sources at peaks; ambient light alone, and the sun",
        {"relighting.light.estimate._split_peaks": lambda radiance, evidence, *, within: ((), radiance)},
    ),
    "even-ambient": Row(
        "sources", "direction of ambient light", {"relighting.light.estimate._ambient_of": even_ambient}
    ),
    "sun": Row(
        "sun",
        "the sun from shadows",
        {"relighting.light.estimate.find_sun": lambda captured, region, *, outdoors: None},
    ),
    "sun-outdoors": Row(
        "sun",
        "the brightest unseen source out of doors is the sun",
        {"relighting.light.estimate.known_sun": no_sun_by_shading},
    ),
    "sun-ground": Row(
        "sun",
        "shadows on a second surface and in a wider region, out of doors",
        {"relighting.light.estimate.find_sun": sun_on_one_surface},
    ),
    "sun-height": Row(
        "sun", "an error of the sun's height by a clear sky", {"relighting.light.sky._HEIGHT_SD_DEG": 0.1}
    ),
    "sun-sky": Row(
        "sun", "a clear sky shows sun and sky", {"relighting.light.estimate.clear_sky_evidence": lambda captured: None}
    ),
    "sun-sky-radiance": Row(
        "sun",
        "the light of a clear sky from the sky that is seen; only the sun's direction",
        {"relighting.light.sky.SkyEvidence.sky_with": lambda evidence, sun: None},
    ),
    "sun-unseen-shade": Row(
        "sun",
        "no sun in the shade of things that were not captured",
        {"relighting.light.known_sun.OpenGround.is_shaded": lambda ground, place: False},
    ),
    "sun-strength": Row(
        "sun",
        "the sun's strength from shadow edges; that of the sources",
        {"relighting.light.estimate.find_sun": partial(changed_sun, ratio=None)},
    ),
    "sun-radius": Row(
        "sun",
        "the sun's radius from shadow edges; one degree",
        {"relighting.light.estimate.find_sun": partial(changed_sun, radius_deg=1.0)},
    ),
    "sun-ambient": Row(
        "sun",
        "ambient occlusion beside the sun's shadows",
        {"relighting.light.sun.Surface.ambient": lambda self, occluders: torch.ones(self.texels().shape[:2])},
    ),
    "sun-shaders": Row(
        "sun",
        "unseen things may shade texels and tiles",
        {"relighting.light.sun._SHADED_TEXEL": 1e-6, "relighting.light.sun._SHADED_TILE": 1e-6},
    ),
}
"""Rows by name: the first stage that is changed, what is switched off, and how."""


@contextmanager
def patched(patches: Mapping[str, object]) -> Iterator[None]:
    """Replace functions and constants of `splatgraft`; a name that does not exist raises AttributeError."""
    with ExitStack() as stack:
        for name, replacement in patches.items():
            stack.enter_context(mock.patch(f"splatgraft.{name}", replacement))
        yield


def transferred(scene: ExamScene, patches: Mapping[str, object]) -> tuple[Gaussians, float]:
    """Relight the object and apply the layers; return the scene to draw and the CPU seconds."""
    with patched(patches):
        start = time.process_time()
        result = relight(scene.composite, scene.cameras, sources=[scene.source]).bake()[0]
        return result, time.process_time() - start


class Baseline:
    """The full transfer of one scene with the values of its stages."""

    def __init__(self, scene: ExamScene) -> None:
        """Run the full transfer."""
        self.scene, self._kept, self._seconds = scene, dict[str, list[object]](), dict[str, float]()
        calls = {call for calls in STAGES.values() for call in calls}
        self.result, _ = transferred(scene, {call: self._keeping(call) for call in calls})
        if missing := calls - set(self._kept):
            raise ValueError(f"{scene.name}: expected a light at both places; not called: {', '.join(sorted(missing))}")

    def _keeping(self, call: str) -> Callable[..., object]:
        original = resolve_name(f"splatgraft.{call}")

        def run(*args: Any, **more: Any) -> object:
            value = original(*args, **more)
            self._kept.setdefault(call, []).append(value)
            return value

        return run

    def reuse(self, stage: str) -> dict[str, object]:
        """Return patches that give the values of the full transfer to all that does not depend on a stage."""
        return {call: mock.Mock(side_effect=self._kept[call]) for call in STAGES[stage]}

    def seconds(self, stage: str) -> float:
        """Return the CPU seconds of the full transfer if it reuses these values, and test that it gives its result."""
        if stage not in self._seconds:
            again, self._seconds[stage] = transferred(self.scene, self.reuse(stage))
            if not same(again, self.result):
                raise ValueError(f"{self.scene.name}: expected the stage {stage!r} to give the same result again")
        return self._seconds[stage]


def same(one: Gaussians, other: Gaussians) -> bool:
    """Return whether two scenes are equal in every bit."""
    pairs = [(getattr(one, f.name), getattr(other, f.name)) for f in fields(one)]
    return all(a.shape == b.shape and torch.equal(a, b) for a, b in pairs)


@dataclass(frozen=True)
class Measured:
    """One row of one scene."""

    values: Mapping[str, float | None]
    """Values of `METRICS`; None if not defined."""
    changed: bool
    """Whether the row differs from the full transfer in any bit."""
    seconds: float
    """CPU seconds from the row's stage on."""
    more_seconds: float = 0.0
    """Difference to the same stages of the full transfer."""


def measure(row: Row, baseline: Baseline, full: Measured) -> Measured:
    """Run the transfer without one mechanism and measure it."""
    reused = baseline.reuse(row.stage)
    if overlap := set(reused) & set(row.patches):
        raise ValueError(f"expected a stage that calls {', '.join(sorted(overlap))}, found {row.stage!r}")
    before = baseline.seconds(row.stage)
    result, seconds = transferred(baseline.scene, {**reused, **row.patches})
    changed = not same(result, baseline.result)
    values = measure_row(result, baseline.scene.views) if changed else full.values
    return Measured(values, changed, seconds, seconds - before)


def measure_full(baseline: Baseline) -> Measured:
    """Measure the full transfer."""
    return Measured(measure_row(baseline.result, baseline.scene.views), False, baseline.seconds("scene"))


Results = dict[str, dict[str, Measured]]
"""Rows by scene."""


def read_results(path: Path) -> Results:
    """Read the results that are there."""
    if not path.is_file():
        return {}
    found = json.loads(path.read_text(encoding="utf-8"))
    return {scene: {row: Measured(**values) for row, values in rows.items()} for scene, rows in found.items()}


def write_results(path: Path, results: Results) -> None:
    """Write all results; a stop leaves the old or the new file."""
    record = {scene: {row: asdict(found) for row, found in rows.items()} for scene, rows in results.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    part.write_text(json.dumps(record, indent=1), encoding="utf-8")
    part.replace(path)


_TITLES = {"object": "object, dB", "shadow": "shadow error", "whole": "whole image, dB"}
_DIGITS = {"object": 2, "shadow": 4, "whole": 2}
_SMALLER_IS_BETTER = ("shadow",)


def table(results: Results, names: Sequence[str]) -> str:
    """Format all rows as a table in Markdown."""
    titles = [f"{title} (better / worse)" for title in _TITLES.values()]
    lines = [["row", "without", *titles, "scenes changed", "CPU s"]]
    lines.append(["---", "---", *["---:"] * (len(titles) + 2)])
    full = [rows[FULL] for rows in results.values() if FULL in rows]
    absolute = []
    for metric in _TITLES:
        known = [value for one in full if (value := one.values[metric]) is not None]
        absolute.append(f"{statistics.mean(known):.{_DIGITS[metric]}f}" if known else "-")
    lines.append([FULL, "", *absolute, str(len(full)), f"{_mean([one.seconds for one in full]):.1f}"])
    for name in names:
        pairs = [(rows[name], rows[FULL]) for rows in results.values() if name in rows and FULL in rows]
        if not pairs:
            continue
        changed = sum(one.changed for one, _ in pairs)
        cells = [_difference(metric, pairs) for metric in _TITLES] if changed else ["no effect"] * len(_TITLES)
        seconds = f"{_mean([one.more_seconds for one, _ in pairs]):+.1f}"
        lines.append([name, ROWS[name].without, *cells, f"{changed} of {len(pairs)}", seconds])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _difference(metric: str, pairs: Sequence[tuple[Measured, Measured]]) -> str:
    """Format the mean difference to the full transfer, its standard error, and the scenes that get better and worse."""
    values = [(one.values[metric], full.values[metric]) for one, full in pairs]
    differences = [value - before for value, before in values if value is not None and before is not None]
    if not differences:
        return "-"
    sign, digits = -1 if metric in _SMALLER_IS_BETTER else 1, _DIGITS[metric]
    better, worse = (sum(side * sign * d > 0 for d in differences) for side in (1, -1))
    error = statistics.stdev(differences) / math.sqrt(len(differences)) if len(differences) > 1 else math.nan
    return f"{_mean(differences):+.{digits}f} ± {error:.{digits}f} ({better} / {worse})"


def _mean(values: Sequence[float]) -> float:
    return statistics.mean(values) if values else math.nan


def chosen_rows(patterns: Sequence[str]) -> list[str]:
    """Return the names of the rows that match a pattern."""
    for pattern in patterns:
        if not any(fnmatch(name, pattern) for name in ROWS):
            raise SystemExit(f"--rows: expected names or patterns among {', '.join(ROWS)}; found {pattern}")
    return [name for name in ROWS if any(fnmatch(name, pattern) for pattern in patterns)]


def measure_scenes(options: Namespace, names: Sequence[str]) -> tuple[Results, list[str]]:
    """Measure the rows that are missing, and save after each; return also the names of those that failed."""
    results, failed = read_results(options.out), list[str]()
    for name, read in scenes_in(options):
        rows = results.setdefault(name, {})
        left = [row for row in names if row not in rows]
        if not left and FULL in rows:
            continue
        baseline = Baseline(read())
        full = measure_full(baseline)
        if FULL in rows and rows[FULL].values != full.values:
            raise ValueError(
                f"{options.out}: expected results of this transfer with as many threads, found others in {name}: "
                "start a new file"
            )
        rows[FULL] = rows.get(FULL, full)
        for row in left:
            try:
                rows[row] = found = measure(ROWS[row], baseline, full)
            except Exception:  # the other rows of a run of hours are still measured
                traceback.print_exc()
                failed.append(f"{name} {row}")
                continue
            write_results(options.out, results)
            print(f"{name} {row}: {'changed' if found.changed else 'no effect'}, {found.seconds:.1f} s", flush=True)
        write_results(options.out, results)
    return results, failed


def main() -> None:
    """Measure and print."""
    parser = scene_arguments(__doc__)
    parser.add_argument("--out", type=Path, required=True, help="all values, as JSON")
    parser.add_argument("--rows", nargs="+", default=["*"], help="names of rows, or patterns such as 'sun*'")
    options = parser.parse_args()
    names = chosen_rows(options.rows)
    results, failed = measure_scenes(options, names)
    print(table(results, names))
    if failed:
        raise SystemExit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
