"""The sun by the brightness of a clear sky, on skies of another model (Preetham et al. 1999)."""

import math
from dataclasses import replace

import pytest
import torch
from shapes import UP, ball, clock_at, ring, sunlit_scene, surfels
from torch import Tensor

from splatgraft.compositing.composite import Composite, PlacedObject
from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.directions import even_directions
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.images import LUMINANCE, linear_from_srgb, srgb_from_linear
from splatgraft.core.similarity import Similarity
from splatgraft.core.spherical_harmonics import dc_from_rgb, rgb_from_dc
from splatgraft.relighting import RelightOptions, relight
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.light.estimate import EstimatedLight, estimate_light
from splatgraft.relighting.light.known_sun import BY_CLOCK, known_sun
from splatgraft.relighting.light.light import LightSource
from splatgraft.relighting.light.sky import SkyEvidence, clear_sky_evidence
from splatgraft.relighting.scene_light import SceneLight, find_scene_light

SUN = torch.tensor([math.cos(math.radians(40)), 0.0, math.sin(math.radians(40))])
ABOVE = even_directions(1600)[even_directions(1600)[:, 2] > 0.05]


def preetham(directions: Tensor, sun: Tensor, turbidity: float) -> Tensor:
    """Relative luminance of a clear sky, Preetham et al. 1999, appendix A.2."""
    t = turbidity
    a, b, c = 0.1787 * t - 1.4630, -0.3554 * t + 0.4275, -0.0227 * t + 5.3251
    d, e = 0.1206 * t - 2.5771, -0.0670 * t + 0.3703
    cosine = directions @ sun
    around = 1 + c * torch.exp(d * cosine.clamp(-1, 1).acos()) + e * cosine.square()
    return (1 + a * torch.exp(b / directions[:, 2].clamp_min(0.02))) * around


GRAY = torch.ones(3)


def dome(luminance: Tensor, directions: Tensor, *, tint: Tensor = GRAY) -> Gaussians:
    """A sphere around the cameras with this linear luminance in each direction, grey ground below the horizon."""
    linear = torch.where(directions[:, 2:] > 0, luminance[:, None] * tint, 0.1).clamp(0, 1)
    return surfels(30 * directions, -directions, srgb=srgb_from_linear(linear), width=0.6)


def captured(luminance: Tensor, directions: Tensor, *, tint: Tensor = GRAY) -> CapturedScene:
    return CapturedScene(dome(luminance, directions, tint=tint), ring(height=1.0, radius=2.0, focal=50.0))


def garden(
    albedo: float, strength: float, *, tint: Tensor = GRAY, shade: Tensor | None = None
) -> tuple[CapturedScene, Tensor]:
    """A hedge around balls on a floor, under a clear sky and a sun; returns the irradiance on level ground, too.

    `strength` is the sun's irradiance on level ground over the sky's, and `tint` its colour. Something unseen shades
    the floor around `shade`.
    """
    directions = even_directions(12000)
    above = directions[:, 2] > 0
    luminance = 0.06 * preetham(directions, SUN, 3.0)
    sky = (luminance * directions[:, 2])[above].sum() * 4 * math.pi / len(directions)
    near = sunlit_scene(SUN, strength / float(SUN[2]))
    lit = linear_from_srgb(rgb_from_dc(near.sh[:, 0])) / 0.15  # over the light of the sky
    lit = 1 + (lit - 1) * tint
    if shade is not None:
        lit[(near.means - shade).norm(dim=1) < 0.8] = 1
    colors = srgb_from_linear((albedo * sky / math.pi * lit).clamp(0, 1))
    near = replace(near, sh=dc_from_rgb(colors)[:, None])
    turn, height = torch.meshgrid(torch.arange(90) / 90 * 2 * math.pi, torch.linspace(0, 1.2, 5), indexing="ij")
    turn, height = turn.flatten(), height.flatten()
    around = torch.stack([turn.cos(), turn.sin(), 0 * turn], 1)
    hedge = surfels(9 * around + height[:, None] * UP, -around, srgb=0.2, width=0.3)
    scene = concatenate([near, hedge, dome(luminance, directions).select(above)])
    return CapturedScene(scene, ring(height=1.5, radius=2.5, focal=50.0)), sky * (1 + strength)


def azimuth_deg(direction: Tensor) -> float:
    return math.degrees(math.atan2(float(direction[1]), float(direction[0])))


@pytest.mark.parametrize("turbidity", [2.0, 4.0])
@pytest.mark.parametrize("turn", [0.0, 130.0])
def test_a_clear_sky_shows_where_the_sun_is_although_trees_hide_a_third_of_it(turbidity, turn):
    cosine, sine = math.cos(math.radians(turn)), math.sin(math.radians(turn))
    sun = torch.tensor([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]]) @ SUN
    directions = even_directions(12000)
    luminance = preetham(directions, sun, turbidity)
    luminance = 0.3 * luminance / luminance[directions[:, 2] > 0].median()
    trees = torch.sin(7 * torch.atan2(directions[:, 1], directions[:, 0]) + 1) > 0.5
    noise = torch.randn(len(directions), generator=torch.Generator().manual_seed(0))
    luminance = torch.where(trees & (directions[:, 2] < 0.3), 0.05 * noise.exp(), luminance)
    evidence = SkyEvidence.of(captured(luminance, directions))
    assert float(evidence.log_likelihoods(ABOVE).max()) > 24  # far above the bar of a clear sky
    log_density = evidence.log_density(ABOVE)
    off = (azimuth_deg(ABOVE[log_density.argmax()]) - azimuth_deg(sun) + 180) % 360 - 180
    assert abs(off) < 10  # two cells
    near = (sun @ ABOVE.T) > math.cos(math.radians(8))
    assert float(log_density.max() - log_density[near].max()) < 2  # the right height is not ruled out


def test_skies_and_walls_whose_brightness_says_nothing_of_a_sun_are_not_clear_skies():
    directions = even_directions(12000)
    noise = torch.randn(len(directions), generator=torch.Generator().manual_seed(1))
    overcast = 0.3 * (1 + 2 * directions[:, 2]) / 3
    even = torch.full((len(directions),), 0.4)
    sides = (4 * torch.atan2(directions[:, 1], directions[:, 0]) / math.pi).floor()
    walls = torch.tensor([0.1, 0.5, 0.05, 0.3, 0.8, 0.15, 0.6, 0.2])[sides.long() % 8]
    for luminance in (overcast, even, walls, 0.2 * noise.exp()):
        assert not SkyEvidence.of(captured(luminance, directions)).is_clear


def test_a_view_without_sky_says_nothing():
    directions = even_directions(12000)
    scene = dome(torch.ones(len(directions)), directions).select(directions[:, 2] < 0)
    evidence = SkyEvidence.of(CapturedScene(scene, ring(height=1.0, radius=2.0, focal=50.0)))
    assert len(evidence.directions) == 0
    assert evidence.log_likelihoods(ABOVE).tolist() == [0.0] * len(ABOVE)


def test_the_sun_is_known_by_the_clock_then_by_the_sky_then_by_the_brightest_source():
    directions = even_directions(12000)
    clear = captured(preetham(directions, SUN, 3.0) * 0.02, directions)
    grey = captured(torch.full((len(directions),), 0.4), directions)
    aside = torch.tensor([0.0, math.cos(0.7), math.sin(0.7)])
    main = LightSource((0.0, math.cos(0.7), math.sin(0.7)), (1.0, 1.0, 1.0), uncertainty_deg=6.0)

    def likeliest(scene: CapturedScene, *, is_unseen: bool = True, outdoors: bool = True) -> Tensor | None:
        sky = clear_sky_evidence(scene) if outdoors else None
        known = known_sun(scene, main, sky, outdoors=outdoors, is_unseen=is_unseen)
        return None if known is None else known.directions[known.log_density.argmax()]

    for is_unseen in (True, False):  # a source that contradicts the sky is not followed
        found = likeliest(clear, is_unseen=is_unseen)
        assert found is not None
        assert abs(azimuth_deg(found)) < 12
    found = likeliest(grey)
    assert found is not None
    assert float(found @ aside) > math.cos(math.radians(4))
    assert likeliest(grey, is_unseen=False) is None
    assert likeliest(clear, outdoors=False) is None
    by_clock = torch.tensor([0.0, 0.6, 0.8])
    timed = CapturedScene(clear.gaussians, clear.cameras, clock_at(by_clock))
    known = known_sun(timed, None, None, outdoors=False, is_unseen=False)
    assert known is not None
    assert known.name == BY_CLOCK
    assert float(known.directions[known.log_density.argmax()] @ by_clock) > math.cos(math.radians(4))
    assert clear_sky_evidence(timed) is not None


def test_the_height_by_the_clock_counts_more_than_that_by_the_sky_and_by_shading():
    directions = even_directions(12000)
    low, high = (torch.tensor([math.cos(h), 0.0, math.sin(h)]) for h in (0.45, 0.95))  # 26 and 54 degrees
    shown = captured(preetham(directions, SUN, 3.0) * 0.02, directions)
    x, y, z = high.tolist()
    main = LightSource((x, y, z), (1.0, 1.0, 1.0), uncertainty_deg=8.0)
    aside = torch.tensor([math.cos(0.2) * float(low[0]), math.sin(0.2) * float(low[0]), float(low[2])])
    clock = clock_at(aside, error_deg=10.0, height_error_deg=1.0)
    timed = CapturedScene(shown.gaussians, shown.cameras, clock)
    known = known_sun(timed, main, clear_sky_evidence(timed), outdoors=True, is_unseen=True)
    assert known is not None
    found = known.directions[known.log_density.argmax()]
    assert math.degrees(math.asin(float(found[2]))) == pytest.approx(math.degrees(0.45), abs=3)
    assert abs(azimuth_deg(found)) < 5  # the clock is 11 degrees off
    # a source that cannot be the sun is not followed
    alone = CapturedScene(shown.gaussians, shown.cameras, clock_at(SUN))
    wrong = replace(main, direction=(0.0, -0.8, 0.6), uncertainty_deg=2.0)
    known = known_sun(alone, wrong, None, outdoors=True, is_unseen=True)
    assert known is not None
    assert float(known.directions[known.log_density.argmax()] @ SUN) > math.cos(math.radians(3))


@pytest.mark.parametrize("turbidity", [2.0, 4.0])
def test_the_strip_of_a_clear_sky_that_the_views_show_tells_how_bright_the_whole_is(turbidity):
    directions = even_directions(12000)
    above = directions[:, 2] > 0
    relative = preetham(directions, SUN, turbidity)
    luminance = 0.3 * relative / relative[above].median()
    blue = torch.tensor([0.7, 1.0, 1.5])
    sky = SkyEvidence.of(captured(luminance, directions, tint=blue)).sky_with(SUN)

    def on_level_ground(radiance: Tensor) -> Tensor:
        return (radiance * directions[:, 2:])[above].sum(0) * 4 * math.pi / len(directions)

    found = on_level_ground(sky.radiance(directions))
    true = on_level_ground(luminance[:, None] * blue)
    assert float((found / true).log2().abs().max()) < 0.5  # stops


def test_a_sky_that_is_clipped_everywhere_is_white():
    directions = even_directions(12000)
    sky = SkyEvidence.of(captured(torch.full((len(directions),), 1.0), directions)).sky_with(SUN)
    assert float(sky.color.min()) > 0.1
    assert torch.allclose(sky.color, sky.color[:1].expand(3))


def test_under_a_clear_sky_the_level_of_the_light_does_not_depend_on_the_colour_of_the_ground():
    place = torch.tensor([0.0, 0.0, 0.3])
    scene, irradiance = garden(0.05, 8.0)
    none = torch.zeros(scene.gaussians.count, dtype=torch.bool)
    relit = relight(
        Composite(scene.gaussians, (PlacedObject(ball(0.5), Similarity(1.0, torch.eye(3), place)),), none),
        scene.cameras,
    )
    assert relit.light is not None
    # a mesh takes the level in full
    on_top = relit.shade[relit.is_object][(ball().normals @ UP) > 0.95] @ LUMINANCE
    white = relit.light.irradiance(UP[None])[0] @ LUMINANCE / math.pi
    assert float(on_top.median() / white) == pytest.approx(1, abs=0.2)
    assert "under a clear sky" in relit.report[0].text
    assert any("0.3 stops" in note.text for note in relit.report)
    brighter, more = garden(0.3, 8.0)
    other = estimate_light(brighter, BoundingSphere(place, 0.3))
    assert isinstance(other, EstimatedLight)
    lights = ((relit.light, irradiance), (other.light, more))
    found = [float((light.irradiance(UP[None])[0] @ LUMINANCE / true).log2()) for light, true in lights]
    assert max(map(abs, found)) < 0.8  # stops; the edges of the shadows show half of the sun's strength or less
    assert abs(found[0] - found[1]) < 0.4


def test_in_the_shade_of_something_unseen_the_sky_is_the_only_light():
    shaded = BoundingSphere(torch.tensor([1.4, 1.4, 0.3]), 0.3)
    scene, irradiance = garden(0.3, 8.0, tint=torch.tensor([1.3, 1.0, 0.55]), shade=shaded.center)
    there = find_scene_light(scene, [shaded], light=None, reach=RelightOptions().reach)
    assert isinstance(there, SceneLight)
    found = there.estimate
    assert found is not None
    assert found.is_shaded
    assert found.sun is None
    light = found.light.irradiance(UP[None])[0] @ LUMINANCE
    assert abs(float((light / (irradiance / 9)).log2())) < 0.5  # stops
    assert not any(math.isinf(source.distance) for source in found.light.sources)
    # where the ground is sunlit, the same estimate has the sun, for which the shadow maps of the shade do not hold
    sunlit = replace(shaded, center=torch.tensor([1.4, 0.3, 0.3]))
    moved = found.at(scene, sunlit)
    assert isinstance(moved, EstimatedLight)
    assert moved.sun is not None
    assert float(moved.light.irradiance(UP[None])[0] @ LUMINANCE) > 4 * float(light)
    assert there.moved([sunlit]) is None
    assert isinstance(there.moved([replace(shaded, center=torch.tensor([1.2, 1.4, 0.3]))]), SceneLight)
