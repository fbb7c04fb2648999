"""Meshes in captured light: known albedo, normals, gloss and emission, in closed form."""

import math
from dataclasses import replace

import pytest
import torch
from shapes import ball, ring, surfels

from splatgraft.compositing.composite import Composite, PlacedObject
from splatgraft.core.directions import even_directions
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import linear_from_srgb
from splatgraft.core.similarity import Similarity
from splatgraft.core.spherical_harmonics import colors
from splatgraft.relighting import Light, LightSource, RelightOptions, Relit, SourceScene, relight
from splatgraft.relighting.light.light import fit_ambient
from splatgraft.relighting.materials import ReflectedLight, known_materials
from splatgraft.relighting.transfer import TransferValues

WHOLE = RelightOptions(most_added=0.0, fitted_views=0)
SUN = (0.36, 0.48, 0.8)
QUARTER = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def floor() -> Gaussians:
    x = torch.linspace(-2, 2, 40)
    grid = torch.stack(torch.meshgrid(x, x, indexing="ij"), -1).reshape(-1, 2)
    up = torch.tensor([[0.0, 0.0, 1.0]]).repeat(len(grid), 1)
    return surfels(torch.cat([grid, torch.zeros(len(grid), 1)], 1), up, width=0.06)


def lit(thing: Gaussians, light: Light, *, rotation=None, source: SourceScene | None = None, height=1.5) -> Relit:
    turn = torch.eye(3) if rotation is None else rotation
    target = floor()
    placed = PlacedObject(thing, Similarity(1.0, turn, torch.tensor([0.0, 0.0, height])))
    composite = Composite(target, (placed,), torch.zeros(target.count, dtype=torch.bool))
    return relight(composite, ring(), sources=[source], light=light, options=WHOLE)


def sky(radiance: float, *sources: LightSource) -> Light:
    return Light(sources, fit_ambient(torch.full((3,), radiance)))


def shown(relit: Relit, towards: torch.Tensor) -> torch.Tensor:
    """Return the linear colours of the object's Gaussians, seen from one direction far away."""
    thing = relit.shaded().select(relit.is_object)
    return linear_from_srgb(colors(thing.sh, -towards.expand(thing.count, 3)))


def test_a_matt_ball_has_albedo_times_irradiance_over_pi():
    sun = LightSource(SUN, (3.0, 3.0, 3.0), angular_radius_deg=0.3)
    thing = ball(0.4)
    relit = lit(thing, sky(0.2, sun))
    found = shown(relit, torch.tensor([0.0, 0.0, 1.0]))[:, 0]
    cosine = thing.normals @ torch.tensor(SUN)
    # the ball is convex, and nothing else is near
    expected = 0.4 / math.pi * (0.2 * math.pi + 3 * cosine.clamp_min(0))
    towards_sun = cosine > 0.3  # beyond, a shadow map's bias matters
    # 4% of the light are reflected by a wide lobe instead, which adds a twentieth of the light at most: 4% over .4 / 2
    assert float((found / expected)[towards_sun].log2().abs().max()) < 0.15
    assert float((found / expected)[towards_sun].mean()) == pytest.approx(1, abs=0.06)


@pytest.mark.parametrize("kind", [{"metallic": 1.0}, {"metallic": 0.0}])
@pytest.mark.parametrize("roughness", [0.2, 0.5, 0.9])
def test_a_white_ball_in_a_white_sky_is_white(kind, roughness):
    # the furnace test: a surface that absorbs nothing cannot be told from an even sky, from no view
    relit = lit(ball(1.0, roughness=roughness, **kind), sky(0.5))
    towards = torch.tensor([0.6, 0.0, 0.8])
    facing = ball().normals @ towards > 0.3
    found = shown(relit, towards)[facing]
    # single lobes lose or gain energy: matt and Fresnel parts do not exactly add up to one
    assert float(found.mean()) == pytest.approx(0.5, rel=0.06)
    assert float(found.max()) < 0.65


def test_metal_mirrors_the_sun_and_dark_lacquer_shows_only_its_highlight():
    sun = LightSource(SUN, (0.5, 0.5, 0.5), angular_radius_deg=0.3)
    towards = torch.tensor(SUN)
    normals = ball().normals
    middle, aside = normals @ towards > 0.97, (normals @ towards - 0.6).abs() < 0.1
    for thing in (ball(0.9, metallic=1.0, roughness=0.5), ball(0.0, roughness=0.5)):
        found = shown(lit(thing, sky(0.02, sun)), towards)[:, 0]
        assert float(found[middle].mean()) > 3 * float(found[aside].mean())


@pytest.mark.parametrize("roughness", [0.45, 0.6])
def test_metal_reflects_the_sun_far_from_its_highlight_as_ggx_does(roughness):
    towards, light = torch.tensor([0.6, 0.0, 0.8]), torch.tensor(SUN)
    thing = ball(0.5, metallic=1.0, roughness=roughness)
    relit = lit(thing, sky(1e-3, LightSource(SUN, (0.5, 0.5, 0.5), angular_radius_deg=0.3)))
    found = shown(relit, towards)[:, 0]
    # Walter et al. 2007, Eqs. 20 and 33 to 34, written with tangents
    half = torch.nn.functional.normalize(towards + light, dim=0)
    cosines = [thing.normals @ direction for direction in (towards, light, half)]
    facing, incident, middle = (cosine.clamp_min(1e-3) for cosine in cosines)
    square = roughness**4
    density = square / (math.pi * middle**4 * (square + 1 / middle**2 - 1) ** 2)
    masking = [2 / (1 + (1 + square * (1 / x**2 - 1)).sqrt()) for x in (facing, incident)]
    expected = 0.5 * 0.5 * density * masking[0] * masking[1] / (4 * facing)
    angle = middle.clamp(max=1).acos().rad2deg()
    both = (facing > 0.3) & (incident > 0.3)
    # reflections after the first add up to a tenth; bands of degree 3 flatten the peak
    for low, high in ((20, 35), (35, 50)):
        ring = both & (angle > low) & (angle < high)
        assert float(found[ring].mean() / expected[ring].mean()) == pytest.approx(1.0, abs=0.25)


@pytest.mark.parametrize("roughness", [0.3, 0.6, 0.9])
def test_white_metal_under_lamps_all_around_is_white(roughness):
    count = 3000
    lamps = ReflectedLight(
        directions=even_directions(count),
        irradiance=torch.full((count, 3), 4 * math.pi / count),
        softness=torch.zeros(count),
        visibility=torch.ones(1, count),
        ambient=torch.zeros(9, 3),
    )
    white = known_materials(ball(1.0, metallic=1.0, roughness=roughness, count=1))
    views = torch.tensor([[[0.0, 0.0, -1.0], [0.6, 0.0, -0.8]]])
    found = lamps.microfacet_radiance(views, torch.tensor([[0.0, 0.0, 1.0]]), white)
    # without further reflections .99, .82 and .42; their fit is within a sixth
    assert found == pytest.approx(1.0, abs=0.17)


def test_the_relief_of_a_normal_map_shades_itself_and_takes_no_light_from_below():
    thing, sun, tilt = ball(0.4), torch.tensor(SUN), math.radians(45)
    aside = torch.nn.functional.normalize(torch.linalg.cross(thing.normals, torch.tensor([[0.3, -0.8, 0.5]])), dim=1)
    bent = replace(thing, normals=math.cos(tilt) * thing.normals + math.sin(tilt) * aside)
    found = lit(bent, sky(0.0, LightSource(SUN, (3.0, 3.0, 3.0), angular_radius_deg=0.3))).received[0][:, 0]
    plane, relief = thing.normals @ sun, bent.normals @ sun
    # Smith's masking of GGX with alpha^2 = tan^2 / 8, as in Estevez et al.
    masked = 2 / (1 + (1 + 0.125 * (1 / plane**2 - 1)).sqrt())
    in_front = (plane > 0.15) & (relief > 0.3)
    assert float((found / (3 * relief * masked))[in_front].sub(1).abs().quantile(0.9)) < 0.02
    below = (plane < 0) & (relief > 0.2)
    assert int(below.sum()) > 20
    assert float(found[below].max()) < 0.05


def test_an_object_reflects_its_shadow_on_the_surface_below_it():
    sun = LightSource((0.0, 0.0, 1.0), (3.0, 3.0, 3.0), angular_radius_deg=0.3)
    low, high = (lit(ball(0.4), sky(0.3, sun), height=height) for height in (0.45, 12.0))
    downward, upward = (ball(0.4).normals[:, 2] * side > 0.5 for side in (-1, 1))
    assert float(low.received[0][downward].mean()) < 0.9 * float(high.received[0][downward].mean())
    assert torch.allclose(low.received[0][upward], high.received[0][upward], rtol=0.05)


def test_a_mesh_without_surroundings_has_the_given_light():
    thing = ball(0.4)
    placed = PlacedObject(thing, Similarity(1.0, torch.eye(3), torch.zeros(3)))
    nothing = floor().select(torch.zeros(0, dtype=torch.int64))
    relit = relight(Composite(nothing, (placed,), torch.zeros(0, dtype=torch.bool)), ring(), light=sky(0.5))
    assert torch.allclose(relit.received[0], torch.tensor(0.5 * math.pi), rtol=0.1)  # 32 samples


def test_emission_adds_to_reflected_light():
    dark = shown(lit(ball(0.3), sky(0.2)), torch.tensor([0.0, 0.0, 1.0]))
    glowing = shown(lit(ball(0.3, emission=0.25), sky(0.2)), torch.tensor([0.0, 0.0, 1.0]))
    assert float((glowing - dark).mean()) == pytest.approx(0.25, abs=0.01)  # projection on bands


def test_a_turned_mesh_keeps_its_light_and_turns_its_normals():
    sun = LightSource(SUN, (2.0, 2.0, 2.0))
    straight, turned = (lit(ball(), sky(0.2, sun), rotation=rotation) for rotation in (None, QUARTER))
    place = straight.prepared[0].normals.vectors, turned.prepared[0].normals.vectors
    torch.testing.assert_close(place[1], place[0] @ QUARTER.T)
    nearest = torch.cdist(place[1], place[0]).argmin(1)
    one, other = (relit.shade[relit.is_object][:, 0] for relit in (straight, turned))
    assert float((other - one[nearest]).abs().median()) < 0.02 * float(one.mean())  # neighbours are 4 degrees apart


def test_a_source_scene_does_not_change_a_known_surface():
    light = sky(0.2, LightSource(SUN, (2.0, 2.0, 2.0)))
    plain = lit(ball(), light)
    with_source = lit(ball(), light, source=SourceScene(floor(), ring()))
    assert torch.equal(plain.shade, with_source.shade)
    assert any("mesh" in note.text for note in plain.report)
    assert not any("unknown" in note.text for note in plain.report)


def test_mesh_and_captured_object_stand_side_by_side():
    target, known = floor(), ball(0.4)
    captured = surfels(0.3 * even_directions(800), even_directions(800), width=0.03, srgb=0.5)
    moves = [Similarity(1.0, torch.eye(3), torch.tensor([x, 0.0, 0.3])) for x in (-0.5, 0.5)]
    objects = (PlacedObject(known, moves[0]), PlacedObject(captured, moves[1]))
    composite = Composite(target, objects, torch.zeros(target.count, dtype=torch.bool))
    relit = relight(composite, ring(), light=sky(0.2, LightSource(SUN, (2.0, 2.0, 2.0))), options=WHOLE)
    assert relit.prepared[0].source_lighting is not None
    assert relit.prepared[1].source_lighting is None
    # the captured one keeps its mean brightness, the mesh does not
    shade = relit.shade[relit.is_object]
    assert float(shade[known.count :].log().mean()) == pytest.approx(0, abs=0.01)


def test_a_mesh_of_a_file_keeps_its_known_light_in_later_transfers():
    target, placed = floor(), PlacedObject(ball(0.4), Similarity(1.0, torch.eye(3), torch.tensor([0.0, 0.0, 0.3])))
    composite = Composite(target, (placed,), torch.zeros(target.count, dtype=torch.bool))
    values, light = TransferValues(lambda: None), sky(0.2, LightSource(SUN, (2.0, 2.0, 2.0)))
    for _ in range(2):
        relit = values.relight(composite, ring(), sources=[None], light=light, options=WHOLE, exact=False)
        assert relit.prepared[0].source_lighting is not None
