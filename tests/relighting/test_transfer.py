"""Properties of the whole transfer on a floor with balls, known by symmetry or in closed form."""

import math
from dataclasses import replace
from functools import cache
from unittest.mock import MagicMock

import pytest
import torch
from shapes import ring, surfels

from splatgraft.compositing.composite import Composite, PlacedObject
from splatgraft.core.bounds import bounding_sphere
from splatgraft.core.directions import even_directions, frames_along
from splatgraft.core.gaussians import Gaussians, concatenate, empty
from splatgraft.core.images import LUMINANCE, linear_from_srgb, srgb_from_linear
from splatgraft.core.similarity import Similarity
from splatgraft.core.spherical_harmonics import dc_from_rgb, rgb_from_dc
from splatgraft.relighting import (
    LayerWeights,
    Light,
    LightSource,
    RelightOptions,
    Relit,
    SourceScene,
    light_from_json,
    light_to_json,
    relight,
    transfer,
)
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.cast_shadows import SHADOW_POWER, cast_shadows
from splatgraft.relighting.layers import assemble_layers
from splatgraft.relighting.light.light import fit_ambient
from splatgraft.relighting.prepared_object import capture_object, prepare_object
from splatgraft.relighting.scene_light import SceneLight, find_scene_light
from splatgraft.relighting.shading import ShadeSettings, shade_ratio

SKY = fit_ambient(torch.tensor([0.4, 0.5, 0.6]))
QUARTER = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
WHOLE = RelightOptions(most_added=0.0, fitted_views=0)
"""Options without splitting, so that Gaussians can be compared one by one."""


def floor(half=2.0, count=90) -> Gaussians:
    x = torch.linspace(-half, half, count)
    grid = torch.stack(torch.meshgrid(x, x, indexing="ij"), -1).reshape(-1, 2)
    up = torch.tensor([[0.0, 0.0, 1.0]]).repeat(len(grid), 1)
    return surfels(torch.cat([grid, torch.zeros(len(grid), 1)], 1), up, width=0.6 * 2 * half / count)


def ball(radius=0.3, count=1500, rgb=(0.5, 0.5, 0.5)) -> Gaussians:
    around = even_directions(count)
    return surfels(radius * around, around, width=1.2 * radius * math.sqrt(4 * math.pi / count) / 2, srgb=rgb)


def shell(rgb=(0.5, 0.5, 0.5), count=4000) -> Gaussians:
    around = even_directions(count)
    return surfels(20 * around, -around, width=0.7, srgb=torch.as_tensor(rgb))


@cache
def cameras():
    return ring()


def sun_from(x, y, z, **more) -> Light:
    length = math.sqrt(x * x + y * y + z * z)
    source = LightSource(direction=(x / length, y / length, z / length), irradiance=(3.0, 3.0, 3.0), **more)
    return Light(sources=(source,), ambient=SKY)


def at(*translation, rotation=None) -> Similarity:
    return Similarity(1.0, torch.eye(3) if rotation is None else rotation, torch.tensor(translation))


def placed(*objects, target=None) -> Composite:
    target = floor() if target is None else target
    parts = tuple(PlacedObject(gaussians, place) for gaussians, place in objects)
    return Composite(target=target, objects=parts, erased=torch.zeros(target.count, dtype=torch.bool))


STANDARD = placed((ball(), at(0.0, 0.0, 0.35)))


@cache
def standard(x, y) -> Relit:
    """Return a gray ball over a floor in sunlight at 45 degrees from a side."""
    return relight(STANDARD, cameras(), light=sun_from(x, y, 1), options=WHOLE)


def darkness(relit):
    """Return the linear light lost on the target, and the positions."""
    scene = ~relit.is_object
    return (1 - relit.ratio()[scene]).mean(1), relit.gaussians.means[scene]


def shadow_center(relit):
    lost, means = darkness(relit)
    weight = lost.clamp_min(0)[:, None]
    return ((weight * means).sum(0) / weight.sum())[:2]


def test_light_from_one_side_casts_to_the_other_and_lights_that_side():
    relit = standard(-1, 0)
    # the sun at 45 degrees throws the shadow of a ball at height 0.35 by 0.35, the sky leaves it below the ball
    x, y = shadow_center(relit)
    assert 0.15 < x < 0.35
    assert abs(y) < 0.02
    body = relit.is_object
    side = relit.gaussians.means[body][:, 0]
    brightness = rgb_from_dc(relit.shaded().sh[body, 0]).mean(1)
    assert brightness[side < -0.15].mean() > 1.1 * brightness[side > 0.15].mean()
    # the floor's grid and the set of ambient directions are not symmetric under a quarter turn: half a shadow pixel
    assert torch.allclose(torch.stack([-y, x]), shadow_center(standard(0, -1)), atol=0.03)


def test_shadow_of_a_ball_matches_ray_casting():
    softness = math.radians(3.0)
    light = replace(sun_from(-1, 0, 1, angular_radius_deg=3.0), ambient=fit_ambient(torch.full((3,), 1e-6)))
    composite = placed((ball(count=8000), at(0.0, 0.0, 0.5)), target=floor(half=1.2, count=150))
    relit = relight(composite, cameras(), light=light, options=WHOLE)
    lost = 1 - relit.shadow[~relit.is_object].mean(1)
    points = relit.gaussians.means[~relit.is_object]
    # truth: share of a 3-degree disk of directions whose ray from the point misses the ball
    axis = torch.tensor(light.sources[0].direction)
    right, down, _ = frames_along(axis[None])[0]
    i = torch.arange(200) + 0.5
    r, angle = (i / 200).sqrt() * math.sin(softness), i * 2.39996
    rays = torch.nn.functional.normalize(
        axis + (r * angle.cos())[:, None] * right + (r * angle.sin())[:, None] * down, dim=1
    )
    to_center = torch.tensor([0.0, 0.0, 0.5]) - points
    along = to_center @ rays.T
    hit = (along > 0) & ((to_center**2).sum(1, keepdim=True) - along**2 < 0.3**2)
    truth = hit.float().mean(1).clamp_max(0.96)  # the darkest shadow leaves 0.04
    band = (truth > 0.02) | (lost > 0.02)
    # the bound for soft shadows
    assert ((lost - truth)[band] ** 2).mean().sqrt() < 0.03


def test_a_red_ball_reddens_the_floor_and_no_energy_grows_without_its_bounce():
    relit = relight(
        placed((ball(rgb=(0.9, 0.2, 0.2)), at(0.0, 0.0, 0.32))), cameras(), light=sun_from(1, 0, 1), options=WHOLE
    )
    bounce = relit.bounce[~relit.is_object].sum(0)
    assert bounce[0] > 2 * bounce[1]
    assert relit.shadow.max() <= 1
    assert relit.shadow.min() > 0
    assert relit.bounce.min() >= 0
    assert relit.ratio(LayerWeights(bounce=0.0))[~relit.is_object].max() <= 1


def test_the_bounce_does_not_depend_on_how_bright_the_light_of_the_object_s_capture_was():
    bounces = []
    for brightness in (1.0, 3.0):
        gray = float(srgb_from_linear(torch.tensor(0.1 * brightness)))
        old = replace(sun_from(1, 0, 1), ambient=brightness * SKY)
        old = replace(old, sources=(replace(old.sources[0], irradiance=(3 * brightness,) * 3),))
        composite = placed((ball(rgb=(gray,) * 3), at(0.0, 0.0, 0.35)))
        sources = [SourceScene(floor(), cameras(), light=old)]
        relit = relight(composite, cameras(), sources=sources, light=sun_from(-1, 0, 1), options=WHOLE)
        bounces.append(relit.bounce)
    assert float(bounces[0].max()) > 0.02
    torch.testing.assert_close(*bounces, rtol=1e-2, atol=1e-3)


def test_two_objects_shadow_each_other():
    left, right = (ball(), at(-0.5, 0.0, 0.4)), (ball(), at(0.5, 0.0, 0.4))
    relit = relight(placed(left, right), cameras(), light=sun_from(-1, 0, 0.1), options=WHOLE)
    first, second = relit.shadow[relit.is_object].mean(1).chunk(2)
    # low light from the left: the right one is in the left one's shadow, not the other way round
    assert second.min() < 0.5
    assert first.mean() > second.mean() + 0.05


def test_moving_everything_moves_the_result():
    light = sun_from(-1, 0.3, 1)
    angle = torch.tensor(0.7)
    c, s = float(angle.cos()), float(angle.sin())
    turn = Similarity(1.0, torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), torch.tensor([3.0, -1.0, 0.5]))
    scene = floor()
    before = relight(placed((ball(), at(0.1, 0.0, 0.35)), target=scene), cameras(), light=light, options=WHOLE)
    after = relight(
        placed((ball(), turn @ at(0.1, 0.0, 0.35)), target=turn.gaussians(scene)),
        turn.cameras(cameras()),
        light=light.rotated(turn.rotation),
        options=WHOLE,
    )
    # the ambient directions stay fixed in the world: 32 of them sample the same light in another phase, which moves
    # a ratio by the rms error of one sampling, 0.02, in each of the two
    assert (before.ratio() - after.ratio()).abs().mean() < 0.02


def test_erased_and_far_gaussians_keep_every_bit():
    far = surfels(torch.tensor([[9.0, 9.0, 0.0]]), torch.tensor([[0.0, 0.0, 1.0]]), width=0.05)
    scene = concatenate([floor(), far])
    composite = placed((ball(), at(0.0, 0.0, 0.35)), target=scene)
    erased = torch.zeros(scene.count, dtype=torch.bool)
    erased[:10] = True
    relit = relight(replace(composite, erased=erased), cameras(), light=sun_from(-1, 0, 1), options=WHOLE)
    assert int((~relit.is_object).sum()) == scene.count - 10
    kept = relit.shaded().sh[scene.count - 11]
    assert torch.equal(kept[:1], far.sh[0])
    # a scene of degree 0 gets a first band at shadow edges; elsewhere it is empty
    assert bool((kept[1:] == 0).all())


def test_layers_can_be_taken_out():
    nothing = LayerWeights(shade=0.0, shadow=0.0, bounce=0.0, gloss=0.0)
    assert torch.equal(standard(-1, 0).shaded(nothing).sh, STANDARD.merged()[0].sh)
    assert not torch.equal(standard(-1, 0).shaded().sh, STANDARD.merged()[0].sh)


def test_tint_and_exposure_change_the_object_alone():
    factors = torch.tensor([[1.0, 1.0, 1.0], [0.5, 0.4, 0.2], [1.5, 1.2, 2.0], [0.7, 0.7, 0.7]])
    relit = standard(-1, 0)
    given = factors[torch.arange(relit.gaussians.count) % len(factors)]
    relit = replace(relit, shade=torch.where(relit.is_object[:, None], given, 1))
    usual, objects = relit.ratio(), relit.is_object
    grey = relit.ratio(LayerWeights(tint=0.0))
    assert torch.equal(grey[~objects], usual[~objects])
    # sums of three products in float32
    assert torch.allclose(grey @ LUMINANCE, usual @ LUMINANCE, rtol=1e-5)
    plain = replace(relit, shadow=torch.ones_like(relit.shadow), bounce=torch.zeros_like(relit.bounce))
    spread = plain.ratio(LayerWeights(tint=0.0))[objects]
    assert float((spread.amax(1) / spread.amin(1) - 1).abs().max()) < 1e-5
    # twice the tint: ratios of channels are squared
    once, twice = plain.ratio()[objects], plain.ratio(LayerWeights(tint=2.0))[objects]
    assert torch.allclose(twice[:, 0] / twice[:, 2], (once[:, 0] / once[:, 2]) ** 2, rtol=1e-4)
    brighter = relit.ratio(LayerWeights(exposure=1.0))
    assert torch.equal(brighter[objects], 2 * usual[objects])
    assert torch.equal(brighter[~objects], usual[~objects])
    # the transfer is not computed again: the layers are equal, only their weights differ
    assert torch.equal(relit.shaded(LayerWeights(tint=1.0, exposure=0.0)).sh, relit.shaded().sh)


def test_splitting_keeps_the_count_bounded_and_every_gaussian():
    composite = placed((ball(), at(0.0, 0.0, 0.35)), target=floor(count=30))
    relit = relight(composite, cameras(), light=sun_from(-1, 0, 1), options=replace(WHOLE, most_added=0.5))
    merged, _ = composite.merged()
    # half of the limit of any scene, although half of this scene is fewer
    assert 0 < relit.gaussians.count - merged.count <= 40_000
    assert torch.equal(relit.origin.unique(), torch.arange(merged.count))


def test_values_that_moved_with_the_object_give_what_new_ones_do():
    light, scene, body = sun_from(-1, 0, 1), floor(), ball()

    def spheres(x):
        return [bounding_sphere(at(x, 0.0, 0.35).gaussians(body))]

    first = find_scene_light(CapturedScene(scene, cameras()), spheres(0.0), light=light, reach=WHOLE.reach)
    assert isinstance(first, SceneLight)
    there = first.moved(spheres(0.2))
    assert isinstance(there, SceneLight)
    assert there.maps is first.maps
    assert there.receivers is first.receivers
    assert first.moved(spheres(3.0)) is None
    old, new = (PlacedObject(body, at(x, 0.0, 0.35)) for x in (0.0, 0.2))
    seen_from = old.target_from_object.inverse().cameras(cameras())
    captured = capture_object(body, None, seen_from, source_light=None)
    prepared = prepare_object(old, captured, first.light, number=1)
    moved = prepared.moved(new, there.light)
    assert moved is not None
    assert prepared.moved(replace(new, target_from_object=at(0.2, 0.0, 0.35, rotation=QUARTER)), there.light) is None
    assert prepared.moved(new, sun_from(0, 1, 1)) is None
    brighter = replace(there.light, sources=(replace(there.light.sources[0], irradiance=(9.0, 8.0, 7.0)),))
    kept = prepared.moved(new, brighter)
    assert kept is not None
    assert kept.maps.occlusions[0][1].texels is prepared.maps.occlusions[0][1].texels
    assert torch.equal(kept.maps.occlusions[0][0].irradiance, torch.tensor([[9.0, 8.0, 7.0]]))
    assert prepared.is_for(old, first.light)
    assert not prepared.is_for(new, first.light)
    assert not prepared.is_for(old, brighter)
    composite = Composite(scene, (new,), torch.zeros(scene.count, dtype=torch.bool))
    merged, is_object = composite.merged()
    shadows = cast_shadows(there, [moved], merged.select(~is_object), views=cameras().spread(0), budget=0)
    found = assemble_layers(merged, there, [moved], shadows).ratio()
    wanted = relight(composite, cameras(), light=light, options=WHOLE).ratio()
    # object maps and normals are kept exactly; the scene's maps stay centred at the first place, so that their pixels
    # fall differently on the floor's edge of visibility: a hundredth of the light at most, on average half of that
    assert (found - wanted).abs().mean() < 5e-3


def test_an_object_is_examined_once_and_lit_as_new_wherever_it_stands(monkeypatch):
    examined, examine = [], transfer.capture_object
    monkeypatch.setattr(transfer, "capture_object", lambda *a, **more: examined.append(a[0]) or examine(*a, **more))
    body, source, target = ball(), SourceScene(empty(), cameras(), light=GIVEN), floor(count=40)
    places = (at(0.0, 0.0, 0.35), at(0.0, 0.0, 0.35, rotation=QUARTER), at(0.3, 0.0, 0.35, rotation=QUARTER))
    values, light = transfer.TransferValues(lambda: None), sun_from(-1, 0, 1)
    for place in places:
        composite = placed((body, place), target=target)
        given = {"sources": (source,), "light": light, "options": WHOLE}
        kept = values.relight(composite, cameras(), **given, exact=True)
        assert len(examined) == 1
        new = relight(composite, cameras(), **given)
        examined.pop()
        assert torch.equal(kept.ratio(), new.ratio())
        assert torch.equal(kept.gloss, new.gloss)


def test_even_lights_change_a_share_of_the_tint_and_of_the_level():
    # the ball is as bright as a ball of the expected albedo, 0.3, in the dim light
    composite = placed((ball(rgb=(0.35, 0.35, 0.35)), at(0.0, 0.0, 0.6)), target=shell((0.8, 0.7, 0.6)))
    source = SourceScene(shell((0.6, 0.6, 0.6)), cameras())
    relit = relight(composite, cameras(), sources=(source,), options=WHOLE)
    shade = relit.shade[relit.is_object].log()
    light = (linear_from_srgb(torch.tensor([0.8, 0.7, 0.6])) / linear_from_srgb(torch.tensor([0.6] * 3))).log()
    shares = ShadeSettings()
    expected = shares.tint_share * (light - light.mean()) + shares.level_share * light.mean()
    assert not torch.allclose(expected, torch.zeros(3), atol=0.15)
    # the shells' splats overlap to an alpha below 1 in places, the same in both; 10% for their blending in sRGB
    assert torch.allclose(shade.mean(0), expected, atol=0.1)


def test_shadows_under_an_estimated_light_have_its_power_and_those_under_a_given_one_do_not():
    around = even_directions(4000)
    colors = torch.where(around[:, 2:] > 0.5, torch.tensor(0.9), torch.tensor(0.3)).expand(-1, 3)
    target = concatenate([floor(), replace(shell(), sh=dc_from_rgb(colors[:, None]))])
    composite = placed((ball(), at(0.0, 0.0, 0.35)), target=target)
    found = relight(composite, cameras(), options=WHOLE)
    assert found.light is not None
    assert found.estimate is not None
    given = relight(composite, cameras(), light=found.light, options=WHOLE)
    assert float(darkness(given)[0].max()) > 0.1
    assert torch.allclose(found.shadow, given.shadow**SHADOW_POWER, atol=1e-4)
    # the slope is that of the power: the ratio seen from a side changes as the power of the sum does
    grey = given.shadow.mean(1, keepdim=True)
    assert torch.allclose(found.slope, SHADOW_POWER * grey ** (SHADOW_POWER - 1) * given.slope, atol=1e-4)


def test_shade_takes_the_stated_shares_of_level_and_tint():
    target, source, opacities = torch.tensor([[8.0, 4.0, 2.0]]), torch.ones(1, 3), torch.ones(1)
    for level, tint in ((0.0, 1.0), (0.5, 0.5), (1.0, 0.0)):
        shares = ShadeSettings(level_share=level, tint_share=tint)
        shade = shade_ratio(target, source, opacities, settings=shares)
        # the mean over channels of log 8, 4 and 2 is log 4; the tint is 2, 1 and 1/2
        assert torch.allclose(shade, 4**level * torch.tensor([[2.0, 1.0, 0.5]]) ** tint)


def test_shading_is_full_where_no_surface_is_sure():
    body = ball()
    cloud = replace(body, log_scales=torch.full((body.count, 3), -3.0))  # round Gaussians: flatness shows no normal
    source, shades = SourceScene(empty(), cameras(), light=Light((), SKY)), []
    for one in (cloud, body):
        composite = placed((one, at(0, 0, 0.35)))
        relit = relight(composite, cameras(), sources=(source,), light=sun_from(-1, 0, 1), options=WHOLE)
        side = relit.gaussians.means[relit.is_object] @ torch.tensor([-0.7, 0.0, 0.7])
        shade = relit.shade[relit.is_object].log().mean(1)
        shades.append(float(torch.stack([side - side.mean(), shade - shade.mean()]).cov()[0, 1] / side.var()))
    # both are the same ball: the slope of the shading towards the sun is equal except for the cloud's deeper rim
    assert shades[0] > 0.8 * shades[1]


def test_highlights_of_the_old_light_go_where_it_is_known():
    body = ball()
    bands = 0.1 * torch.randn(body.count, 15, 3, generator=torch.Generator().manual_seed(1))
    shiny = replace(body, sh=torch.cat([body.sh, bands], 1))
    composite, even = placed((shiny, at(0.0, 0.0, 0.5)), target=shell()), Light((), fit_ambient(torch.full((3,), 0.2)))
    for source, kept in ((SourceScene(empty(), cameras(), light=even), False), (None, True)):
        relit = relight(composite, cameras(), sources=(source,), light=even, options=WHOLE)
        left = float(relit.shaded().sh[relit.is_object, 1:].abs().mean())
        # noise resembles some lobe by chance: at most a tenth of it becomes gloss
        assert left > 0.05 if kept else left < 0.1 * float(bands.abs().mean())
        assert torch.equal(relit.shaded(LayerWeights(gloss=0.0, shade=0.0)).sh[relit.is_object], shiny.sh)
        if not kept:
            doubled = relit.shaded(LayerWeights(gloss=2.0)).sh[relit.is_object, 1:]
            assert torch.equal(doubled, 2 * relit.gloss[relit.is_object, 1:])  # no captured band comes back negative


def test_places_without_light_or_object_give_the_plain_composite_and_a_reason():
    nothing = placed((ball(), at(0.0, 0.0, 0.35)), target=empty())
    inside = placed((ball(), at(0.0, 0.0, 0.0)), target=ball(radius=0.09, count=2000))
    night = placed((ball(), at(0.0, 0.0, 0.5)), target=shell((0.0, 0.0, 0.0)))
    no_object = placed((empty(), at(0.0, 0.0, 0.3)))
    for composite, word in ((nothing, "empty"), (inside, "inside"), (night, "no light"), (no_object, "No object")):
        relit = relight(composite, cameras())
        assert word in relit.report[0].text
        assert relit.report[0].in_doubt
        assert relit.light is None
        assert torch.equal(relit.shaded().sh, composite.merged()[0].sh)


def test_under_an_even_sky_an_object_darkens_its_foot_and_one_in_the_air_is_warned_of():
    overcast = Light(sources=(), ambient=SKY)

    def under_the_sky(height: float) -> tuple[Relit, bool]:
        relit = relight(placed((ball(), at(0.0, 0.0, height))), cameras(), light=overcast, options=WHOLE)
        return relit, any("Hardly any shadow" in note.text for note in relit.report)

    relit, warned = under_the_sky(0.3)
    assert not warned
    lost, place = darkness(relit)
    foot = place[:, :2].norm(dim=1) < 0.1
    # a point below a sphere on a plane sees hardly any sky
    assert float(lost[foot].mean()) > 0.5
    assert under_the_sky(1.5)[1]


def test_most_of_a_light_that_hardly_any_photo_shows_is_said_to_be_a_guess():
    assert not standard(-1, 0).report[0].in_doubt
    light = replace(sun_from(-1, 0, 1), coverage=0.2)
    (note, unknown) = relight(STANDARD, cameras(), light=light, options=WHOLE).report
    assert note.in_doubt
    assert "a guess (20%" in note.remedy
    assert "20% of the surroundings were photographed, as given." in note.text
    assert unknown.in_doubt
    assert unknown.text == "The old light of object 1 is unknown: the object keeps its mean brightness."


def test_one_source_per_object_is_required():
    with pytest.raises(ValueError, match="expected 1 source scenes, found 2"):
        relight(STANDARD, cameras(), sources=(None, None))


def test_light_json_round_trip_and_its_messages():
    light = replace(sun_from(1, 2, 3, uncertainty_deg=9.0, name="sun", blockers_within=2.5, distance=3.5), coverage=0.7)
    assert light_from_json(light_to_json(light)).sources[0].distance == 3.5
    assert light_from_json(light_to_json(sun_from(1, 2, 3))).sources[0].distance == math.inf
    text = light_to_json(light)
    assert light_to_json(light_from_json(text)) == text
    for broken, message in (
        ("{", "expected JSON"),
        ("[]", 'expected "format"'),
        (text.replace("splatgraft light 1", "other"), 'expected "format"'),
        (text.replace('"coverage": 0.7', '"coverage": 7'), "coverage: expected 1 number from 0 to 1"),
        (text.replace('"confidence"', '"confidense"'), "confidense"),
        (text.replace('"distance": 3.5', '"distance": 0'), "distance: expected 1 number from 0.0001 to inf, found 0"),
        (text.replace('"distance": 3.5', '"distance": "far"'), "distance: expected 1 number"),
    ):
        with pytest.raises(ValueError, match=r"my\.json") as caught:
            light_from_json(broken, name="my.json")
        assert message in str(caught.value)
        assert "\n" not in str(caught.value)


GIVEN = Light(sources=(LightSource(direction=(0.6, 0.0, 0.8), irradiance=(3.0, 2.5, 2.0), name="sun"),), ambient=SKY)
"""Light at an object's old place."""


def test_what_is_given_of_an_objects_capture_is_turned_with_it_and_believed():
    normals = even_directions(1500).flip(1)
    source = SourceScene(empty(), cameras(), light=GIVEN, normals=normals)
    composite = placed((ball(), at(0.0, 0.0, 1.0, rotation=QUARTER)), target=shell(count=500))
    relit = relight(composite, cameras(), sources=(source,), light=GIVEN, options=WHOLE)
    (found,) = relit.prepared
    assert found.source_lighting is not None
    # a quarter turn about z takes (0.6, 0, 0.8) to (0, 0.6, 0.8); float32
    assert found.source_lighting.light.sources[0].direction == pytest.approx((0.0, 0.6, 0.8), abs=1e-6)
    assert found.source_lighting.light.sources[0].irradiance == GIVEN.sources[0].irradiance
    assert torch.allclose(found.normals.vectors, normals @ QUARTER.T, atol=1e-6)
    assert bool((found.normals.confidence == 1).all())
    assert bool(found.normals.seen.all())
    assert any("as given" in note.text for note in relit.report[1:])
    with pytest.raises(ValueError, match="expected 1500 normals, found 7"):
        relight(composite, cameras(), sources=(replace(source, normals=even_directions(7)),), light=GIVEN)


@pytest.mark.parametrize("factor", [1.0, 0.25])
def test_between_two_given_lights_the_level_changes_in_full(factor):
    composite = placed((ball(), at(0.0, 0.0, 0.0)), target=shell(count=500))
    source = SourceScene(empty(), cameras(), light=GIVEN)
    sources = tuple(replace(s, irradiance=tuple(factor * x for x in s.irradiance)) for s in GIVEN.sources)
    light = Light(sources, factor * GIVEN.ambient)
    relit = relight(composite, cameras(), sources=(source,), light=light, options=WHOLE)
    shade = relit.shade[relit.is_object]
    # both irradiances come from the same samples; float32
    assert torch.allclose(shade, torch.full_like(shade, factor), rtol=1e-3)


def test_copies_of_an_object_share_the_light_at_its_old_place(monkeypatch):
    found = MagicMock(side_effect=transfer.find_source_light)
    monkeypatch.setattr(transfer, "find_source_light", found)
    one, other = ball(0.2, 200), ball(0.3, 200)
    source = SourceScene(empty(), cameras(), light=Light((), SKY))
    objects = [(thing, at(x, 0.0, 0.3)) for thing, x in ((one, -1.0), (other, 0.0), (one, 1.0))]
    relight(placed(*objects), cameras(), sources=[source] * 3, light=Light((), SKY), options=WHOLE)
    assert found.call_count == 2
