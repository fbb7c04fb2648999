"""The light at a place: its panorama, evidence of shading and highlights, estimates in scenes of known light."""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from shapes import UP, clock_at, lamplit_scene, ring, sunlit_scene, surfels

from splatgraft.cli import main
from splatgraft.compositing.composite import PlacedObject
from splatgraft.core import spherical_harmonics
from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.capture_orientation import estimate_up, focus_point
from splatgraft.core.directions import even_directions, fit_sh, tangents
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.images import LUMINANCE, linear_from_srgb, srgb_from_linear
from splatgraft.core.similarity import Similarity
from splatgraft.core.spherical_harmonics import dc_from_rgb, rgb_from_dc
from splatgraft.formats import read_cameras, read_gaussians
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.light.description import describe_light
from splatgraft.relighting.light.estimate import EstimatedLight, _is_denied, _source, estimate_light
from splatgraft.relighting.light.evidence import ShadingEvidence, find_highlights
from splatgraft.relighting.light.known_sun import BY_CLOCK, clear_ratio, sun_towards
from splatgraft.relighting.light.light import Light, LightSource, fit_ambient, light_confidence
from splatgraft.relighting.light.panorama import (
    DIRECTIONS,
    Surroundings,
    cube_cameras,
    cube_directions,
    nearest_directions,
    radiance_change,
    render_panorama,
    shares_of,
    surroundings_at,
)
from splatgraft.relighting.light.radiance_model import LightEvidence, RadianceSettings, radiance_problem
from splatgraft.relighting.light.radiance_search import RadianceEstimate
from splatgraft.relighting.light.sun import (
    _DIRECTIONS,
    SET_BY_HAND,
    Sun,
    _ShadowEvidence,
    direction_through,
    find_sun,
    prior_near,
    set_sun,
    sun_near,
    with_sun,
)


def shell(colors, directions, *, radius=2.0, spread=0.12):
    n = len(directions)
    return Gaussians(
        means=directions * radius,
        log_scales=torch.full((n, 3), math.log(spread)),
        quaternions=torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        opacity_logits=torch.full((n,), 8.0),
        sh=dc_from_rgb(colors)[:, None],
    )


def test_solid_angles_sum_to_the_sphere_and_directions_are_balanced():
    directions, area = cube_directions(16)
    assert float(area.sum()) == pytest.approx(4 * math.pi, rel=1e-5)  # float32 sum of 1536 terms
    assert (directions * area[..., None]).sum((0, 1, 2)).abs().max() < 1e-4
    second = torch.einsum("fhwi,fhwj,fhw->ij", directions, directions, area)
    # midpoint rule with 16 pixels per 90 degrees: error of order (1/8)^2 / 12 of 4 pi / 3
    assert (second - torch.eye(3) * 4 * math.pi / 3).abs().max() < 0.02


def test_directions_are_those_of_the_cameras():
    directions, _ = cube_directions(8)
    cameras = cube_cameras(torch.tensor([1.0, 2, 3]), 8)
    points = cameras.centers[:, None, None] + 5 * directions
    rotation, shift = cameras.camera_from_world[:, :3, :3], cameras.camera_from_world[:, :3, 3]
    in_camera = torch.einsum("fij,fhwj->fhwi", rotation, points) + shift[:, None, None]
    pixels = in_camera[..., :2] / in_camera[..., 2:] * 4 + 4
    x = torch.arange(8) + 0.5
    # float32 of coordinates of order 10
    assert (pixels[..., 0] - x).abs().max() < 1e-4
    assert (pixels[..., 1] - x[:, None]).abs().max() < 1e-4
    assert (torch.linalg.det(cameras.world_from_camera[:, :3, :3]) - 1).abs().max() < 1e-6


def test_light_is_seen_in_its_direction_in_linear_light():
    directions = even_directions(3000)
    colors = torch.where(directions[:, 2:] > 0, torch.tensor([0.9, 0.6, 0.3]), torch.tensor([0.2, 0.2, 0.2]))
    scene = shell(colors, directions)
    seen = render_panorama(scene, torch.zeros(3), size=32)
    assert seen.coverage > 0.99
    above = seen.radiance[seen.directions[..., 2] > 0.3]
    # away from the border only equal colours are blended; alpha near 1 leaves 8 bits of float noise
    assert (above - linear_from_srgb(torch.tensor([0.9, 0.6, 0.3]))).abs().max() < 2e-3


def test_the_change_of_the_light_around_is_the_difference_of_two_panoramas():
    directions = even_directions(3000)
    gray, nothing = torch.full((3000, 3), 0.7), torch.zeros(3)
    change = torch.where(directions[:, 2:] < -0.2, torch.tensor([-0.6, -0.3, 0.2]), nothing)
    scene = shell(gray, directions)
    changed = shell(srgb_from_linear(linear_from_srgb(gray) * (1 + change)), directions)
    before, after = (render_panorama(one, nothing, size=32) for one in (scene, changed))
    difference = (after.radiance - before.radiance).reshape(-1, 3)
    expected = fit_sh(before.directions.reshape(-1, 3), difference, before.solid_angles.flatten())
    found = radiance_change(scene, change, nothing, nearest=0.0)
    # alpha is below 1, and colours are blended before and after the conversion to linear light
    assert (found - expected).abs().max() < 0.03 * expected.abs().max()


def test_coverage_is_the_captured_share():
    directions = even_directions(3000)
    half = directions[directions[:, 2] > 0]
    seen = render_panorama(shell(torch.full((len(half), 3), 0.5), half), torch.zeros(3), size=32)
    # the rim of Gaussians of 0.12 / 2 rad reaches about two of them below the border: at most 6% of the sphere
    assert 0.48 < seen.coverage < 0.57


def test_near_things_are_left_out():
    directions = even_directions(3000)
    near = shell(torch.zeros(300, 3), even_directions(300), radius=0.3, spread=0.05)
    far = shell(torch.full((3000, 3), 0.7), directions)
    seen = render_panorama(concatenate([near, far]), torch.zeros(3), size=16, nearest=0.5)
    serialized = render_panorama(far, torch.zeros(3), size=16, nearest=0.5)
    assert torch.equal(seen.radiance, serialized.radiance)


def test_wide_gaussians_close_by_are_not_smeared_over_the_horizon():
    # a sky, and under the point a table of discs as wide as their distance
    sky = shell(torch.full((3000, 3), 0.7), even_directions(3000), radius=6.0, spread=0.36)
    x = torch.linspace(-0.6, 0.6, 5)
    grid = torch.stack(torch.meshgrid(x, x, indexing="ij"), -1).reshape(-1, 2)
    table = Gaussians(
        means=torch.cat([grid, torch.full((25, 1), -0.25)], 1),
        log_scales=torch.tensor([0.2, 0.2, 0.01]).log().repeat(25, 1),
        quaternions=torch.tensor([1.0, 0, 0, 0]).repeat(25, 1),
        opacity_logits=torch.full((25,), 4.0),
        sh=dc_from_rgb(torch.tensor([0.9, 0.1, 0.1])).repeat(25, 1)[:, None],
    )
    seen = render_panorama(concatenate([sky, table]), torch.zeros(3), size=32, nearest=0.1)
    level = seen.directions[..., 2].abs() < 0.1
    found = seen.radiance[level]
    assert (found[:, 0] - found[:, 1]).abs().max() < 0.02


REGION = BoundingSphere(torch.zeros(3), 1.0)
ABOVE = even_directions(6400)[even_directions(6400) @ UP > 0.035]


def high_views():
    turn = torch.arange(24) / 24 * 2 * math.pi
    eyes = torch.stack([2.5 * turn.cos(), 2.5 * turn.sin(), 1.6 + 0.8 * (3 * turn).sin()], 1)
    return pinhole(look_at(eyes, torch.zeros(3), UP), 100.0, width=128, height=96)


def polished(looks, sun):
    """Return a lobe of cos^16 around the mirrored sun, for unit directions from a camera down to the plane."""
    return ((looks * torch.tensor([1.0, 1.0, -1.0])) @ sun).clamp_min(0) ** 16


def rough(looks, sun):
    """Return the reflection of a rough dielectric: GGX of alpha .5 with Smith's masking of both sides and Fresnel."""
    alpha, view = 0.5, -looks
    half = torch.nn.functional.normalize(view + sun, dim=1)
    spread = alpha**2 / (math.pi * (half[:, 2] ** 2 * (alpha**2 - 1) + 1) ** 2)

    def shadow(cosine):  # height-correlated, as in Heitz 2014
        return 0.5 * (torch.sqrt(1 + alpha**2 * (1 / cosine**2 - 1)) - 1)

    masking = 1 / (1 + shadow(view[:, 2]) + shadow(sun[2]))
    fresnel = 0.04 + 0.96 * (1 - (half * view).sum(1)) ** 5
    return spread * masking * fresnel / (4 * view[:, 2])


def table(sun, gloss, reflected=polished):
    """A plane with a diffuse gray and a reflection of `sun` in harmonics of degree 3."""
    generator = torch.Generator().manual_seed(0)
    points = torch.cat([(torch.rand(3000, 2, generator=generator) - 0.5) * 2, torch.zeros(3000, 1)], 1)
    looks = even_directions(600)
    looks = looks[looks[:, 2] < -0.1]  # from a camera down to the plane
    gray = srgb_from_linear(0.2 + gloss * reflected(looks, sun))
    sh = torch.linalg.lstsq(spherical_harmonics.basis(looks, 3), (gray - 0.5)[:, None]).solution
    flat = surfels(points, UP.repeat(len(points), 1), width=0.04)
    return replace(flat, sh=sh[None].repeat(len(points), 1, 3))


def towards(height_deg, azimuth):
    height = math.radians(height_deg)
    return torch.tensor([math.cos(height) * math.cos(azimuth), math.cos(height) * math.sin(azimuth), math.sin(height)])


def evidence_of(scene):
    evidence = find_highlights(CapturedScene(scene, high_views()), region=REGION)
    assert evidence is not None
    return evidence


def explained_by_each(evidence):
    k = len(DIRECTIONS)
    return evidence.explained_with_more(torch.zeros(k), torch.arange(k), torch.ones(k))


@pytest.mark.parametrize("azimuth", [0.3, 4.5])
def test_highlights_on_a_bare_table_give_the_direction(azimuth):
    sun = towards(38, azimuth)
    evidence = evidence_of(table(sun, gloss=0.4))
    single = torch.eye(len(DIRECTIONS))
    explained = explained_by_each(evidence)
    best = DIRECTIONS[explained.argmax()]
    # directions lie 11 degrees apart; harmonics of degree 3 shift the peak of the lobe by up to 6
    assert math.degrees(math.acos(float(best @ sun))) < 12
    assert float(explained.max()) > 0.5
    assert float(explained[7]) == pytest.approx(evidence.explained(single[7]), abs=1e-4)
    # the share with an added light equals the share computed anew
    index = torch.arange(0, len(single), 20)
    both = 2 * single[explained.argmax()] + 3 * single[index]
    more = evidence.explained_with_more(2 * single[explained.argmax()], index, 3 * torch.ones(len(index)))
    assert torch.allclose(more, torch.tensor([evidence.explained(light) for light in both]), atol=1e-4)


def test_a_rough_table_gives_the_height_of_a_sun_though_it_is_brightest_at_flat_views():
    """A lobe about the mirrored direction alone finds the sun 14 degrees too low."""
    sun = towards(50, 1.0)
    best = DIRECTIONS[explained_by_each(evidence_of(table(sun, gloss=0.6, reflected=rough))).argmax()]
    assert math.degrees(math.acos(float(best @ sun))) < 12


def test_each_material_has_its_own_gloss():
    """A common gloss would explain only half of the highlights, because the matt half has none."""
    sun = towards(38, 1.0)
    glossy = table(sun, 0.4).select(torch.arange(1500))
    matt = table(sun, 0.0).select(torch.arange(1500, 3000))
    less_red = matt.sh.clone()
    less_red[:, 0, 0] -= 0.15 / 0.2820948
    matt = replace(matt, sh=less_red)
    whole = explained_by_each(evidence_of(table(sun, 0.4))).max()
    assert float(explained_by_each(evidence_of(concatenate([glossy, matt]))).max()) > 0.9 * float(whole)


def test_matt_tables_and_flat_colours_have_no_highlights():
    scene = table(UP, gloss=0.0)
    evidence = find_highlights(CapturedScene(scene, high_views()), region=REGION)
    # only the rounding of float32 remains, 1e-5
    assert evidence is None or evidence.variance < 1e-10
    assert find_highlights(CapturedScene(scene.with_sh_degree(0), high_views()), region=REGION) is None


COUNT = len(DIRECTIONS)


def receivers(points: torch.Tensor, visibility: torch.Tensor | None = None) -> ShadingEvidence:
    """Return gray, level surfaces."""
    n = len(points)
    return ShadingEvidence(
        region=BoundingSphere(torch.zeros(3), 1.0),
        points=points,
        normals=UP.repeat(n, 1),
        visibility=torch.ones(n, COUNT) if visibility is None else visibility,
        colors=torch.full((n, 3), 0.2),
        weights=torch.full((n,), 1 / n),
        material=torch.zeros(n, dtype=torch.int64),
    )


def surroundings(clipped: torch.Tensor) -> Surroundings:
    """Distant gray surroundings, all seen, with clipped directions."""
    radiance = torch.where(clipped > 0, 1.0, 0.3)[:, None].repeat(1, 3)
    return Surroundings(radiance, torch.ones(COUNT), clipped, DIRECTIONS, torch.full((COUNT,), 1e4))


def test_a_light_twice_as_far_as_the_region_is_wide_shines_from_where_it_stands():
    towards = torch.tensor([math.cos(math.radians(40)), 0.0, math.sin(math.radians(40))])
    k = int(nearest_directions(towards[None]))
    distances = torch.full((COUNT,), math.inf)
    distances[k] = 2.0
    points = torch.tensor([[0.0, 0.0, 0.0], [0.8, 0.0, 0.0], [-0.8, 0.0, 0.0]])
    found = receivers(points).transport(distances)[:, k]
    # a small patch that faces the middle: both cosines over the square of the distance
    light = 2 * DIRECTIONS[k].double()
    away = light - points.double()
    apart = away.norm(dim=1)
    expected = away[:, 2] * (away @ DIRECTIONS[k].double()) / apart**4
    # rows are scaled to sum to 1, and one of 320 directions changes that by a percent
    assert (found / found[0]).tolist() == pytest.approx((expected / expected[0]).tolist(), rel=0.02)
    assert float(found[1] / found[0]) > 1.5


def test_surroundings_at_infinity_are_seen_alike_from_everywhere():
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(20, 3, generator=generator) - 0.5
    evidence = receivers(points, torch.rand(20, COUNT, generator=generator))
    far = evidence.transport(torch.full((COUNT,), math.inf))
    # infinity counts as 10,000 units: float32 of directions
    assert torch.allclose(far, evidence.transport(), atol=1e-5)
    assert torch.allclose(receivers(points).transport().sum(1), torch.ones(20))


def test_a_window_above_its_reflection_on_a_table_may_be_a_source():
    azimuth = torch.atan2(DIRECTIONS[:, 1], DIRECTIONS[:, 0]).abs()
    height = torch.rad2deg(torch.asin(DIRECTIONS[:, 2]))
    window = (azimuth < 0.4) & (height > -5) & (height < 20)
    reflection = (azimuth < 0.4) & (height < -5) & (height > -60)
    around = surroundings((window | reflection).float())
    surfaces = receivers(torch.rand(300, 3, generator=torch.Generator().manual_seed(0)) - 0.5)
    problem = radiance_problem(LightEvidence(surfaces, None, around, around, UP))
    (patch,) = problem.patches
    members = problem.clipped[patch]
    assert set(window.nonzero()[:, 0].tolist()) <= set(members.tolist())
    assert float(height[members].min()) > -8.1


def views(levels=(0.0,)):
    """Twelve cameras on one circle for each level of their focus."""
    eyes = ring().centers
    poses = torch.cat([look_at(eyes, torch.tensor([0.0, 0.0, level]), UP) for level in levels])
    return pinhole(poses, 100.0, width=128, height=96)


SUN = torch.nn.functional.normalize(torch.tensor([0.5, -0.6, 0.5]), dim=0)


@cache
def under_sun() -> CapturedScene:
    """The balls on their floor under `SUN`, which gives three times the sky's light; captured once for all tests."""
    return CapturedScene(sunlit_scene(SUN, 3.0), views())


@cache
def under_sky() -> CapturedScene:
    """The same in red and without the sun."""
    gray = sunlit_scene(SUN, 0.0)
    red = rgb_from_dc(gray.sh[:, 0]) * torch.tensor([1.0, 0.4, 0.4])
    return CapturedScene(replace(gray, sh=dc_from_rgb(red)[:, None]), views())


@cache
def estimate_of(captured: CapturedScene) -> EstimatedLight:
    found = estimate_light(captured, BoundingSphere(torch.tensor([0.0, 0.0, 0.3]), 0.3))
    assert isinstance(found, EstimatedLight)
    return found


def main_direction(light):
    """Normal of the plane with the largest irradiance."""
    normals = even_directions(2000)
    return normals[light.irradiance(normals).sum(1).argmax()]


@pytest.mark.parametrize("sun", [SUN, *(pytest.param(towards(46, at), marks=pytest.mark.long) for at in (0.0, 2.1))])
def test_shadows_give_the_direction_of_a_sun_that_no_camera_saw(sun):
    light = estimate_of(under_sun() if sun is SUN else CapturedScene(sunlit_scene(sun, 3.0), views())).light
    # edges of shadows are off by at most three texels, and a ball is about fifteen texels high
    assert degrees_apart(torch.tensor(light.sources[0].direction), sun) < 3
    assert math.isinf(light.sources[0].distance)
    # the shadows show 3 cos of the sky's light; the estimate is too low: Gaussians mix lit and shaded floor at edges
    on_floor = light.irradiance(UP[None]).mean()
    share = sum(light.sources[0].irradiance) / 3 * light.sources[0].direction[2] / on_floor
    assert float(share) == pytest.approx(3 * float(sun[2]) / (1 + 3 * float(sun[2])), abs=0.1)


def degrees_apart(one, other):
    return math.degrees(math.acos(min(1.0, float(one @ other))))


def painted(scene, gray):
    """Return the floor of a scene times a gray of its x and y."""
    on_floor = scene.means[:, 2] < 0.02
    color = linear_from_srgb(rgb_from_dc(scene.sh[:, 0])) * torch.where(on_floor, gray(scene.means), 1)[:, None]
    return replace(scene, sh=dc_from_rgb(srgb_from_linear(color))[:, None])


def sun_of(scene):
    return find_sun(CapturedScene(scene, views()), BoundingSphere(torch.tensor([0.0, 0.0, 0.3]), 2.4))


def test_a_shade_that_is_far_bluer_than_sunlit_ground_shows_the_sun():
    scene = under_sun().gaussians
    linear = linear_from_srgb(rgb_from_dc(scene.sh[:, 0]))
    # the shade becomes bluer than on photos of a lawn
    graded = 0.3 * (linear / 0.3) ** torch.tensor([2.2, 1.6, 0.3])
    found = sun_of(replace(scene, sh=dc_from_rgb(srgb_from_linear(graded))[:, None]))
    assert found is not None
    assert degrees_apart(found.direction, SUN) < 3
    # the grading makes the sun's red over blue 8 times too large
    assert found.ratio is not None
    assert float(found.ratio[0] / found.ratio[2]) < 3.5


def test_a_sun_through_a_point_and_its_shadow_has_the_strength_that_the_shadow_s_edge_shows():
    scene, tops = under_sun().gaussians, torch.tensor([[1.0, 0.2, 0.5], [-0.6, 0.9, 0.5]])
    # the casters are marked slightly off
    off = torch.tensor([0.02, -0.01, 0.0])
    points = [tuple(at.tolist()) for top in tops for at in (top + off, top - SUN * top[2] / SUN[2])]
    found = set_sun(points, CapturedScene(scene, views()))
    assert degrees_apart(found.direction, SUN) < 3
    assert found.name == SET_BY_HAND
    assert found.ratio is not None
    assert found.ratio.tolist() == pytest.approx([3 * float(SUN[2])] * 3, rel=0.25)
    light = with_sun(Light((), fit_ambient(torch.ones(3))), found)
    # the sun and the rest share the irradiance on the floor as measured
    assert light.irradiance(UP[None])[0].tolist() == pytest.approx([math.pi] * 3, rel=0.02)
    assert light.sources[0].direction == pytest.approx(tuple(found.direction.tolist()))
    with pytest.raises(ValueError, match="then its shadow below it"):
        set_sun(points[::-1], CapturedScene(scene, views()))
    with pytest.raises(ValueError, match="expected pairs"):
        set_sun(points[:3], CapturedScene(scene, views()))
    # far from all surfaces there is no edge: the points give only the direction
    away = [(20.0 + x, y, z) for x, y, z in points]
    unseen = set_sun(away, CapturedScene(scene, views()))
    assert unseen.ratio is None
    assert degrees_apart(unseen.direction, direction_through(points, UP)[0]) < 0.1
    # a lamp beside it, which is as uncertain, gives way with its strength: 3 of 4 parts of the light on the floor
    lamp = LightSource((0.0, 0.0, 1.0), (9.42, 9.42, 9.42), distance=5.0)
    given_way = with_sun(Light((lamp,), fit_ambient(torch.ones(3))), unseen)
    assert len(given_way.sources) == 1
    on_floor = given_way.irradiance(UP[None])[0]
    assert on_floor.tolist() == pytest.approx([4 * math.pi] * 3, rel=0.02)
    by_sun = torch.tensor(given_way.sources[0].irradiance) * given_way.sources[0].direction[2]
    assert (by_sun / on_floor).tolist() == pytest.approx([0.75] * 3, rel=0.02)


# 15 degrees are the standard error that clicks are taken to have
@pytest.mark.parametrize(
    "off_deg", [pytest.param(5.0, marks=pytest.mark.long), 10.0, pytest.param(15.0, marks=pytest.mark.long)]
)
@pytest.mark.parametrize(
    "around", [0, pytest.param(3, marks=pytest.mark.long), pytest.param(slice(None), marks=pytest.mark.long)]
)
def test_points_that_are_degrees_off_give_the_sun_of_the_shadow_beside_them(off_deg, around):
    captured, top = under_sun(), torch.tensor([1.0, 0.2, 0.5])
    shadow = top - SUN * top[2] / SUN[2]
    right, down = tangents(SUN)
    for angle in torch.arange(8)[around].reshape(-1) * (math.pi / 4):
        away = math.tan(math.radians(off_deg)) * (angle.cos() * right + angle.sin() * down)
        caster = shadow + torch.nn.functional.normalize(SUN + away, dim=0) * (top - shadow).norm()
        found = set_sun([(*caster.tolist(),), (*shadow.tolist(),)], captured)
        assert degrees_apart(found.direction, SUN) < 3
        assert found.ratio is not None
        assert found.ratio.tolist() == pytest.approx([3 * float(SUN[2])] * 3, rel=0.25)


@pytest.mark.parametrize("off_deg", [12.0, pytest.param(90.0, marks=pytest.mark.long)])
def test_clear_shadows_overrule_a_clock_that_lies(off_deg):
    right, angle = tangents(SUN)[0], math.radians(off_deg)
    clock = clock_at(math.cos(angle) * SUN + math.sin(angle) * right)
    found = estimate_of(replace(under_sun(), clock=clock))
    assert found.sun is not None
    assert degrees_apart(found.sun.direction, SUN) < 3


@pytest.mark.parametrize(
    ("place", "radius"), [((1.5, -1.5, 0.05), 0.02), pytest.param((-1.8, -1.6, 0.05), 0.06, marks=pytest.mark.long)]
)
def test_shadows_far_from_a_small_object_show_the_sun(place, radius):
    small = BoundingSphere(torch.tensor(place), radius)
    found = estimate_light(under_sun(), small)
    assert isinstance(found, EstimatedLight)
    assert found.sun is not None
    assert degrees_apart(found.sun.direction, SUN) < 3


def test_outdoors_shadows_on_the_ground_around_a_table_show_the_sun():
    radius, height = 0.8, 0.7
    turned = torch.nn.functional.normalize(even_directions(3000)[:, :2], dim=1)
    top = torch.cat([radius * torch.linspace(0, 1, 3000).sqrt()[:, None] * turned, torch.full((3000, 1), height)], 1)
    table = surfels(top, UP.repeat(3000, 1), srgb=0.5, width=0.03)

    def shadow(at):
        through = at + (height - at[:, 2:]) / SUN[2] * SUN
        return torch.where(through[:, :2].norm(dim=1) < radius, 1 / (1 + 3 * float(SUN[2])), 1.0)

    scene = concatenate([painted(under_sun().gaussians, shadow), table])
    captured = CapturedScene(scene, ring(height=2.2, radius=1.4, focal=120.0))
    region = BoundingSphere(torch.tensor([0.0, 0.0, height]), 0.9)
    assert find_sun(captured, region) is None  # nothing stands on the table
    found = find_sun(captured, region, outdoors=True)
    assert found is not None
    assert degrees_apart(found.direction, SUN) < 3


@pytest.mark.long
@pytest.mark.parametrize("lamp", [(2.0, -2.0, 3.0), (-1.0, 2.5, 5.0)])
def test_a_near_lamp_is_where_its_shadows_meet(lamp):
    place = torch.tensor([0.0, 0.0, 0.3])
    towards = torch.tensor(lamp) - place
    scene = lamplit_scene(torch.tensor(lamp), 2.0)
    found = find_sun(CapturedScene(scene, views()), BoundingSphere(place, 2.4))
    assert found is not None
    # as a sun it is 17 and 9 degrees off
    assert degrees_apart(found.direction, torch.nn.functional.normalize(towards, dim=0)) < 3
    assert 0.5 < found.distance / float(towards.norm()) < 2
    source = estimate_of(under_sun()).with_sun(found, scene).light.sources[0]
    assert source.name == "lamp"
    assert source.blockers_within < source.distance == found.distance


def test_shadows_that_prove_no_sun_move_one_that_exists():
    noise = torch.randn(20000, generator=torch.Generator().manual_seed(3))
    scene = painted(under_sun().gaussians, lambda means: noise[: len(means)].exp())
    captured = CapturedScene(scene, views())
    # in the wider region lie the balls and their shadows, on a floor whose texels differ by a factor of e
    region = BoundingSphere(torch.tensor([1.8, 0.0, 0.3]), 0.8)
    shown = _ShadowEvidence.of(captured, region)
    assert shown is not None
    assert shown.best(shown.above(_DIRECTIONS))[1] < 40
    right, down = tangents(SUN)
    for aside in (right, -down):
        estimated = torch.nn.functional.normalize(SUN + math.tan(math.radians(12.0)) * aside, dim=0)
        moved = sun_near(ABOVE, prior_near(estimated[None], 8.0)(ABOVE), captured, region)
        assert degrees_apart(moved.direction, SUN) < 3
        assert moved.error_deg < 4
    # without shadows nothing changes, up to the steps of the directions and the density that is left out
    nowhere = BoundingSphere(torch.tensor([20.0, 0.0, 0.3]), 0.3)
    away = sun_near(ABOVE, prior_near(estimated[None], 8.0)(ABOVE), captured, nowhere)
    assert degrees_apart(away.direction, estimated) < 1
    assert away.error_deg == pytest.approx(8.0, rel=0.1)
    assert away.ratio is None


def test_shadows_of_a_sun_that_exists_show_its_strength():
    estimated = torch.nn.functional.normalize(SUN + math.tan(math.radians(12.0)) * tangents(SUN)[0], dim=0)
    found = sun_near(ABOVE, prior_near(estimated[None], 8.0)(ABOVE), under_sun(), BoundingSphere(torch.zeros(3), 0.8))
    assert degrees_apart(found.direction, SUN) < 3
    assert found.ratio is not None
    assert found.ratio.tolist() == pytest.approx([3 * float(SUN[2])] * 3, rel=0.25)


@pytest.mark.parametrize(("near_height", "outdoors"), [(6.0, False), (0.8, True)])
def test_a_room_ends_at_its_walls_and_a_garden_does_not(near_height, outdoors):
    def wall(radius, height):
        turns, z = torch.meshgrid(torch.linspace(0, 2 * math.pi, 200), torch.linspace(0, height, 60), indexing="ij")
        around = torch.stack([turns.cos(), turns.sin(), torch.zeros_like(turns)], -1).reshape(-1, 3)
        return surfels(radius * around + UP * z.reshape(-1, 1), -around, width=0.03 * radius)

    scene = concatenate([wall(3.0, near_height), wall(15.0, 20.0)])
    cameras = ring(height=0.5, radius=2.0, focal=50.0)
    far = surroundings_at(scene, cameras, torch.tensor([0.0, 0.0, 0.3]), nearest=1.0)
    evidence = LightEvidence(receivers(torch.zeros(1, 3)), None, far, far, UP)
    assert evidence.is_outdoors == outdoors
    settings = RadianceSettings()
    assert radiance_problem(evidence).settings.albedo == (settings.albedo_outdoors if outdoors else settings.albedo)
    clipped = replace(far, clipped=torch.ones_like(far.clipped))
    bright, patch = replace(evidence, far=clipped, around=clipped), torch.arange(len(DIRECTIONS)) == 200
    assert float(far.distance[patch]) < 20
    assert _source(patch, torch.ones(1, 3), bright, within=1.0).name == ("bright patch" if outdoors else "window")
    found = estimate_of(under_sun())
    near = LightSource((0.0, 0.6, 0.8), (1.0, 1.0, 1.0), 5.0, distance=4.0)
    found = replace(found, evidence=evidence, mean=replace(found.mean, sources=(near,)))
    named = found.with_sun(Sun(SUN, 0.3, UP, torch.ones(3), 50.0), scene)
    assert named.light.sources[0].name == ("sun" if outdoors else "sun or window")
    # out of doors the sun replaces what looked like a near source; in a room a lamp stays
    assert len(named.light.sources) == (1 if outdoors else 2)


def test_a_sun_keeps_the_brightness_of_the_surface_and_the_light_from_what_was_photographed():
    found = estimate_of(under_sun())
    mean, lit = found.mean, found.with_sun(Sun(SUN, 0.3, UP, torch.full((3,), 3.0), 3.0), under_sun().gaussians).light
    upward, downward = ([float(light.irradiance(normal[None]).mean()) for light in (mean, lit)] for normal in (UP, -UP))
    assert upward[1] == pytest.approx(upward[0], rel=0.03)  # the ambient part is a fit of degree 2
    # three quarters of the light on the surface come from the sun, but the photographed floor shines as before
    assert downward[1] > 0.85 * downward[0]


def test_shading_and_highlights_show_how_strong_a_sun_in_a_known_direction_is():
    unmeasured = Sun(SUN, 1.0, UP, None, 0.0, 5.0, BY_CLOCK)
    bright, hidden = (
        sun_towards(unmeasured, None, radiance_problem(found.evidence), found.evidence, found.rest())
        for found in (estimate_of(under_sun()), estimate_of(under_sky()))
    )
    assert bright is not None
    assert bright.name == BY_CLOCK
    assert torch.allclose(bright.direction, SUN)
    assert bright.error_deg == 5.0
    # 3 times the sine of the height is 1.6. Shading alone leaves a factor open: the estimate's even light holds a part
    assert 0.2 < float(bright.ratio @ LUMINANCE) / (3 * float(SUN[2])) < 4
    # under an even sky the sun is hidden, or at least weak: matt surfaces alone tell little
    assert hidden is None or float(hidden.ratio @ LUMINANCE) < 0.6 * float(bright.ratio @ LUMINANCE)


def strength_of(sun, found):
    """Return a sun's estimated strength."""
    estimated = sun_towards(sun, None, radiance_problem(found.evidence), found.evidence, found.rest())
    return 0.0 if estimated is None else float(estimated.ratio @ LUMINANCE)


def test_the_edge_of_a_shadow_bounds_the_strength_of_a_sun_from_below():
    measured = Sun(SUN, 0.4, UP, torch.tensor([1.2, 1.0, 0.7]), 50.0)
    edge = float(measured.ratio @ LUMINANCE)
    found = estimate_of(under_sky())
    unmeasured = strength_of(replace(measured, ratio=None), found)
    assert unmeasured < 0.3 * edge  # the surfaces show no sun
    assert 0.8 * edge < strength_of(measured, found) < 2 * edge
    estimated = sun_towards(measured, None, radiance_problem(found.evidence), found.evidence, found.rest())
    assert (estimated.ratio / estimated.ratio[1]).tolist() == pytest.approx([1.2, 1.0, 0.7])
    assert estimated.radius_deg == 0.4


def test_a_sun_about_which_nothing_is_known_has_the_median_strength():
    found = estimate_of(under_sky())
    black = replace(found.evidence.surfaces, weights=torch.zeros_like(found.evidence.surfaces.weights))
    nothing = replace(found.evidence, surfaces=black, highlights=None)
    sun = Sun(SUN, 1.0, UP, None, 0.0)
    estimated = sun_towards(sun, None, radiance_problem(nothing), nothing, found.rest())
    clear = float(clear_ratio(float(SUN @ UP)) @ LUMINANCE)
    assert estimated is not None
    # a clear sky is as likely as all weaker suns together
    assert 0.3 * clear < float(estimated.ratio @ LUMINANCE) < 0.9 * clear


def test_a_source_that_surfaces_deny_is_spread_over_unseen_directions():
    x, y, z = SUN.tolist()
    for captured, is_denied in ((under_sun(), False), (under_sky(), True)):
        found = estimate_of(captured)
        even = found.rest().mean() * math.pi
        source = LightSource((x, y, z), (float(even),) * 3, 1.0)
        problem = radiance_problem(found.evidence)
        assert _is_denied(source, problem, found.evidence, found.rest()) == is_denied
    k, seen = len(DIRECTIONS), (DIRECTIONS[:, 2] < 0).float()
    lamp = torch.ones(k, 3)
    at = int((DIRECTIONS @ SUN).argmax())
    lamp[at] = 30.0
    spread = RadianceEstimate(unseen=lamp, clipped=torch.zeros(k, 3), residual=torch.zeros(0)).spread(seen).unseen
    above = DIRECTIONS[:, 2] > 0
    assert float(spread[above].max()) < 4
    assert float(spread[above].sum()) == pytest.approx(float(lamp[above].sum()), rel=0.1)
    assert float(spread[at].mean()) == pytest.approx(float(spread[above].max()), rel=0.2)


def test_a_source_between_directions_is_divided_among_the_three_around_it():
    for direction in even_directions(50):
        shares = shares_of(direction)
        assert int((shares > 0).sum()) <= 3
        assert float(shares.sum()) == pytest.approx(1)
        assert degrees_apart(torch.nn.functional.normalize(shares @ DIRECTIONS, dim=0), direction) < 2
    assert float(shares_of(DIRECTIONS[7])[7]) == pytest.approx(1, abs=1e-4)


@pytest.mark.long
def test_shadows_show_the_sun_on_a_floor_of_two_materials():
    checked = painted(under_sun().gaussians, lambda at: 0.5 + 0.5 * ((at[:, :2] * 1.2).floor().sum(1) % 2))
    found = sun_of(checked)
    assert found is not None
    assert degrees_apart(found.direction, SUN) < 3


@pytest.mark.parametrize(
    "gray",
    [
        pytest.param(lambda at: 1.0 + 0 * at[:, 0], marks=pytest.mark.long),
        lambda at: 0.3 + 0.7 * ((at[:, 0] * 1.5).floor() % 2),
    ],
)
def test_neither_even_light_nor_stripes_make_a_sun(gray):
    assert sun_of(painted(under_sky().gaussians, gray)) is None


@pytest.mark.long
def test_bars_of_sunlight_beside_what_nothing_explains_do_not_turn_the_sun():
    # a window's frame that no camera saw shades a third of the floor
    found = sun_of(painted(under_sun().gaussians, lambda at: torch.where((at[:, 0] + at[:, 1]).abs() < 0.3, 0.4, 1.0)))
    assert found is not None
    assert degrees_apart(found.direction, SUN) < 3


def test_an_even_sky_gives_an_even_light():
    light = estimate_of(under_sky()).light
    up, side = light.irradiance(torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])).mean(1)
    # the ground takes half of the sky from a wall
    assert float(up / side) < 3


def test_what_no_camera_saw_is_white_whatever_the_colour_of_what_stands_around():
    r, g, b = estimate_of(under_sky()).light.irradiance(UP[None])[0].tolist()
    # the floor itself shines a little from below the horizon
    assert max(r, g, b) < 1.1 * min(r, g, b)


def windowed_room(window, radius_deg, white=1.0):
    """Return a shell of radius 20 with a bright disc towards `window`, and a floor that it lights."""
    shell = even_directions(6000)
    bright = shell @ window > math.cos(math.radians(radius_deg))
    rgb = torch.where(bright[:, None], white, 0.4).repeat(1, 3)
    return concatenate([surfels(20 * shell, -shell, width=0.6, srgb=rgb), sunlit_scene(window, strength=3.0)])


@pytest.mark.parametrize(("radius_deg", "white"), [pytest.param(10, 0.99, marks=pytest.mark.long), (14, 1.0)])
def test_a_clipped_window_is_a_source_where_it_was_photographed(radius_deg, white):
    window = torch.nn.functional.normalize(torch.tensor([0.8, 0.3, 0.15]), dim=0)
    main = estimate_of(CapturedScene(windowed_room(window, radius_deg, white), views((0.0, 1.5)))).light.sources[0]
    # half the patch's radius: its edge is ragged by the splats' width, 3 degrees
    assert math.degrees(math.acos(min(1.0, float(torch.tensor(main.direction) @ window)))) < 5
    # brighter than the camera recorded: white over its solid angle is 0.095
    assert main.luminance > 0.2
    assert main.name == "window"  # a room's wall is behind it
    if radius_deg == 14:  # too wide to be a sun behind a window
        assert main.distance == pytest.approx(20, rel=0.05)


def test_what_shadows_alone_show_is_named_by_where_it_may_be():
    light = estimate_of(under_sun()).light
    assert light.sources[0].name == "sun or window"
    assert "sun or window " in describe_light(light, UP)
    # a window is never overhead
    high = Sun(torch.nn.functional.normalize(torch.tensor([0.3, 0.3, 0.6]), dim=0), 1.0, UP, None, 50.0)
    assert estimate_of(under_sun()).with_sun(high, under_sun().gaussians).light.sources[0].name == "sun or lamp"


@pytest.mark.parametrize(("uncertainty_deg", "is_doubted"), [(14.0, False), (17.0, True)])
def test_a_direction_is_called_uncertain_from_15_degrees_on(uncertainty_deg, is_doubted):
    source = LightSource((0.0, 0.0, 1.0), (1.0, 1.0, 1.0), uncertainty_deg=uncertainty_deg)
    light = Light((source,), fit_ambient(torch.tensor([0.2, 0.2, 0.2])))
    assert ("its direction is uncertain" in describe_light(light, UP)) == is_doubted
    # the confidence has a scale of its own, 20 degrees
    sun, rest = source.luminance, math.pi * 0.2
    expected = (rest + sun * math.exp(-((uncertainty_deg / 20) ** 2))) / (rest + sun)
    assert light_confidence(light) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("strength", [pytest.param(0.0, marks=pytest.mark.long), 1.0])
def test_a_white_floor_is_no_source(strength):
    bright = painted(sunlit_scene(UP, strength), lambda at: torch.where(at[:, 0] > 1, 8.0, 0.3))
    place = BoundingSphere(torch.tensor([0.0, 0.0, 0.3]), 0.1)
    found = estimate_light(CapturedScene(bright, views((0.0, 1.5))), place)
    assert isinstance(found, EstimatedLight)
    assert all(source.direction[2] > 0 for source in found.mean.sources)
    # its light still arrives: more on surfaces that face it than on those that face away
    towards, away = found.mean.irradiance(torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])).mean(1)
    assert float(towards) > 1.5 * float(away)


def test_without_surfaces_to_compare_the_light_is_what_was_photographed():
    shell = even_directions(6000)
    gray = surfels(20 * shell, -shell, width=0.6, srgb=torch.full((6000, 3), 0.5))
    light = estimate_of(CapturedScene(gray, views((0.0, 1.5)))).light
    normals = even_directions(50)
    # sRGB 0.5 is 0.214
    assert torch.allclose(light.irradiance(normals), torch.full((50, 3), 0.214 * math.pi), rtol=0.25)


@pytest.mark.long
def test_the_estimate_does_not_depend_on_the_world_axes():
    sun = torch.nn.functional.normalize(torch.tensor([0.6, -0.5, 0.8]), dim=0)
    scene = sunlit_scene(sun, strength=3.0)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(2))).Q
    turn = turn * torch.linalg.det(turn)
    turned_scene = PlacedObject(scene, Similarity(1.0, turn, torch.zeros(3))).in_target()
    cameras = views()
    poses = cameras.world_from_camera.clone()
    poses[:, :3] = turn @ poses[:, :3]
    place = BoundingSphere(turn @ torch.tensor([0.0, 0.0, 0.3]), 0.3)
    found = estimate_light(CapturedScene(turned_scene, replace(cameras, world_from_camera=poses)), place)
    assert isinstance(found, EstimatedLight)
    assert math.degrees(math.acos(min(1.0, float(torch.tensor(found.light.sources[0].direction) @ (turn @ sun))))) < 11


def test_a_harmonic_fit_of_half_the_sphere_recovers_an_even_light():
    around = even_directions(2000)
    ambient = fit_ambient(torch.tensor([0.2, 0.3, 0.4]))
    values = torch.tensor([0.2, 0.3, 0.4]).repeat(2000, 1)
    half = (around[:, 2] < 0).float()
    # the ridge takes a few parts in 1e3 if half is unseen
    assert torch.allclose(fit_sh(around, values, half), ambient, atol=5e-3)


PLACE = BoundingSphere(torch.tensor([0.0, 0.0, 0.3]), 0.3)


def room() -> Gaussians:
    """Return a floor in a gray shell."""
    generator = torch.Generator().manual_seed(0)
    floor = torch.cat([(torch.rand(4000, 2, generator=generator) - 0.5) * 5, torch.zeros(4000, 1)], 1)
    shell = even_directions(4000)
    return concatenate(
        [surfels(floor, UP.repeat(4000, 1), width=0.05, srgb=0.4), surfels(20 * shell, -shell, width=0.7, srgb=0.7)]
    )


@pytest.mark.parametrize(("count", "degree"), [(1, 0), (12, 3)])
def test_few_views_and_no_bands_give_a_finite_light(count, degree):
    light = estimate_light(CapturedScene(room().with_sh_degree(degree), ring(count)), PLACE)
    assert isinstance(light, EstimatedLight)
    found = light.light.irradiance(even_directions(50))
    assert bool(torch.isfinite(found).all())
    # sRGB 0.7 is 0.448; the seen part of the room is that and the floor's 0.133
    assert 0.1 * math.pi < float(found.mean()) < 0.9 * math.pi


@pytest.mark.parametrize(("field", "value"), [("sh", math.nan), ("sh", -1e30), ("means", math.nan), ("means", 1e30)])
def test_values_that_are_not_finite_or_huge_leave_the_light_finite(field, value):
    scene = room()
    changed = getattr(scene, field).clone()
    changed[::97] = value
    light = estimate_light(CapturedScene(replace(scene, **{field: changed}), ring()), PLACE)
    assert isinstance(light, EstimatedLight)
    found = light.light.irradiance(even_directions(50))
    assert bool(torch.isfinite(found).all())
    assert float(found.max()) < 100


@pytest.mark.long
def test_the_light_of_a_room_is_the_same_from_two_runs_of_poses(tmp_path):
    pytest.importorskip("pycolmap")
    # the shipped photos are half as large, so fewer of them get a pose
    photos = Path(__file__).parents[3] / "shared" / "data" / "bananas" / "images"
    if not photos.is_dir():
        pytest.skip(f"no {photos}")
    found = []
    for seed in range(2):
        posed, scene = tmp_path / f"posed{seed}", tmp_path / f"scene{seed}"
        assert main(["capture", str(photos), "--seed", str(seed), "--accept-doubtful", "--out", str(posed)]) == 0
        assert main(["reconstruct", str(posed), "--quality", "draft", "--out", str(scene)]) == 0
        cameras = read_cameras(posed)
        focus = focus_point(cameras)
        away = float((cameras.centers - focus).norm(dim=1).median())
        place = BoundingSphere(focus + 0.2 * away * estimate_up(cameras), 0.1 * away)
        light = estimate_light(CapturedScene(read_gaussians(scene / "scene.ply"), cameras), place)
        assert isinstance(light, EstimatedLight)
        found.append((cameras, light.mean))
    # the worlds of the two runs differ: the rotation between them, from the cameras that both have
    common = [name for name in found[0][0].names if name in found[1][0].names]
    assert len(common) >= 8
    poses = [c.world_from_camera[[c.names.index(name) for name in common], :3, :3].double() for c, _ in found]
    u, _, v = torch.linalg.svd((poses[0] @ poses[1].transpose(1, 2)).sum(0))
    rotation = u @ torch.diag(torch.tensor([1.0, 1.0, float(torch.det(u @ v))]).double()) @ v
    # a weak source may be found in one run and be part of the even light in the other
    normals = even_directions(200)
    turned = (normals.double() @ rotation).float()
    one, other = (light.irradiance(facing).mean(1) for (_, light), facing in zip(found, (normals, turned), strict=True))
    ratio = (one / other).log2()
    assert float((ratio - ratio.mean()).square().mean().sqrt()) < 0.15  # stops
