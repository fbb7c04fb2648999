"""Shadows on the scene: near lights, sources behind a pane, rough layers of Gaussians, and the limit of the bounce."""

import math

import pytest
import torch
from shapes import ring, surfels

from splatgraft.core.bounds import bounding_sphere
from splatgraft.core.composite import Composite, PlacedObject
from splatgraft.core.directions import even_directions, frames_along
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.images import linear_from_srgb
from splatgraft.core.similarity import Similarity
from splatgraft.relighting import Light, LightSource, RelightOptions, relight
from splatgraft.relighting.light.light import fit_ambient
from splatgraft.relighting.light.samples import sample_light
from splatgraft.relighting.shadows.scene_ratio import object_shadow_maps, scene_ratio
from splatgraft.rendering import render

DARK = fit_ambient(torch.full((3,), 1e-6))
WHOLE = RelightOptions(most_added=0.0, fitted_views=0)
CENTER = torch.tensor([0.0, 0.0, 0.5])
RADIUS = 0.3


def floor(half=1.5, count=200, height=0.0) -> Gaussians:
    """A floor at z = 0 whose Gaussians lie off it by `height`, a standard deviation."""
    x = torch.linspace(-half, half, count)
    grid = torch.stack(torch.meshgrid(x, x, indexing="ij"), -1).reshape(-1, 2)
    z = height * torch.randn(len(grid), 1, generator=torch.Generator().manual_seed(0))
    up = torch.tensor([[0.0, 0.0, 1.0]]).repeat(len(grid), 1)
    return surfels(torch.cat([grid, z], 1), up, width=0.6 * 2 * half / count)


def ball(gray=0.0) -> Gaussians:
    around = even_directions(8000)
    return surfels(RADIUS * around + CENTER, around, width=0.007, srgb=gray)


def cameras(height=1.5):
    return ring(height=height, focal=220.0, size=(256, 192))


def from_above(*, x=0.0, irradiance=3.0, ambient=DARK, **more) -> Light:
    length = math.hypot(x, 1.0)
    source = LightSource(direction=(x / length, 0.0, 1 / length), irradiance=(irradiance,) * 3, **more)
    return Light(sources=(source,), ambient=ambient)


def relit_ball(light, *, target=None, gray=0.0, options=WHOLE, views=None):
    target = floor() if target is None else target
    placed = (PlacedObject(ball(gray), Similarity(1.0, torch.eye(3), torch.zeros(3))),)
    composite = Composite(target, placed, torch.zeros(target.count, dtype=torch.bool))
    return relight(composite, cameras() if views is None else views, light=light, options=options)


def lost_light(relit):
    """Share of light that the target loses, and where."""
    scene = ~relit.is_object
    return 1 - relit.shadow[scene].mean(1), relit.gaussians.means[scene]


@pytest.mark.parametrize("distance", [0.8, 1.5, math.inf])
def test_the_shadow_of_a_ball_is_as_wide_as_rays_from_the_lamp_make_it(distance):
    lost, points = lost_light(relit_ball(from_above(angular_radius_deg=0.5, distance=distance)))
    radius = (float((lost > 0.5).sum()) * (3.0 / 199) ** 2 / math.pi) ** 0.5
    # the cone of rays that touch the ball, where it meets the floor
    sine = RADIUS / distance
    truth = RADIUS if math.isinf(distance) else (distance + 0.5) * sine / math.sqrt(1 - sine**2)
    # a third of the 0.015 between receivers, and 0.5% for splats that stand out of the ball by half of their width
    assert radius == pytest.approx(truth, abs=0.005 + 0.005 * truth)
    away = points[:, :2].norm(dim=1)
    assert float(lost[away < 0.9 * truth].min()) > 0.9
    assert float(lost[away > 1.1 * truth].max()) < 0.1


def test_a_source_is_not_blocked_by_what_the_scene_shows_in_its_place():
    light = from_above(x=1.0, angular_radius_deg=2.0)
    towards = torch.tensor(light.sources[0].direction)
    side = torch.linspace(-0.6, 0.6, 60)
    grid = torch.stack(torch.meshgrid(side, side, indexing="ij"), -1).reshape(-1, 2)
    frame = frames_along(-towards[None])[0]
    pane = CENTER + 2.0 * towards + grid @ frame[:2]
    behind_pane = concatenate([floor(), surfels(pane, -towards.repeat(len(pane), 1), width=0.02, srgb=1.0)])
    lost, _ = lost_light(relit_ball(light, target=behind_pane))
    expected, _ = lost_light(relit_ball(light))
    assert float(expected.max()) > 0.9
    # the pane itself, behind the floor's Gaussians, loses nothing
    assert torch.allclose(lost[: len(expected)], expected, atol=0.05)  # 0.05: the pane reflects ambient light


def test_low_light_leaves_no_acne_on_a_rough_layer():
    # a low sun and as much ambient light: acne would leave only the ambient part, without a shadow to cast
    light = from_above(x=4.0, irradiance=12.0, angular_radius_deg=1.0, ambient=fit_ambient(torch.full((3,), 0.3)))
    smooth, _ = lost_light(relit_ball(light, target=floor(half=3.0, count=300)))
    rough, _ = lost_light(relit_ball(light, target=floor(half=3.0, count=300, height=0.01)))
    umbra = smooth > 0.9 * smooth.max()
    # receivers 0.01 too high or low move the edge of a shadow by 0.04, so some of the umbra's receivers leave it
    assert float(rough[umbra].median()) > 0.95 * float(smooth[umbra].median())


def test_the_bounce_is_no_brighter_than_the_new_light_allows():
    # an object that was overexposed where it comes from
    dim = from_above(irradiance=0.05, ambient=fit_ambient(torch.full((3,), 0.02)))
    relit = relit_ball(dim, gray=1.0)
    # its lower half gets 0.02 pi of light and reflects 0.8 of it into less than half of what the floor sees
    assert 0.0 < float(relit.bounce.max()) < 0.8


def test_shadows_fitted_to_views_stand_where_the_surface_is_seen():
    light = from_above(x=0.7, angular_radius_deg=0.5)
    layer, low = floor(height=0.012), cameras(height=0.5)
    towards = torch.tensor(light.sources[0].direction)
    errors = []
    for views in (0, 8):
        options = RelightOptions(fitted_views=views)
        relit = relit_ball(light, target=layer, options=options, views=low)
        camera = low[[5]]  # not among the 8 that are fitted
        before, after = (
            linear_from_srgb(render(g, camera).color[0].clamp(0, 1)).mean(-1)
            for g in (layer, relit.shaded().select(~relit.is_object))
        )
        v, u = torch.meshgrid(torch.arange(192) + 0.5, torch.arange(256) + 0.5, indexing="ij")
        pose, k = camera.world_from_camera[0], camera.intrinsics[0]
        rays = torch.stack([(u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], torch.ones_like(u)], -1) @ pose[:3, :3].T
        points = pose[:3, 3] - rays * (pose[2, 3] / rays[..., 2:])
        to_center = CENTER - points
        along = to_center @ towards
        truth = torch.where(((to_center**2).sum(-1) - along**2) < RADIUS**2, 0.04, 1.0)
        near = (points[..., :2].norm(dim=-1) < 1.2) & (rays[..., 2] < 0)
        errors.append(float(((after / before.clamp_min(1e-3) - truth)[near] ** 2).mean().sqrt()))
    # what the layer hides and blurs is not all undone: a quarter of the error at least is
    assert errors[1] < 0.75 * errors[0]


def test_the_shadow_is_darkest_at_the_foot():
    sky = Light(sources=(), ambient=fit_ambient(torch.full((3,), 0.5)))
    standing = Similarity(1.0, torch.eye(3), torch.tensor([0.0, 0.0, RADIUS - 0.5]))
    target = floor()
    composite = Composite(target, (PlacedObject(ball(), standing),), torch.zeros(target.count, dtype=torch.bool))
    relit = relight(composite, cameras(), light=sky, options=WHOLE)
    lost, points = lost_light(relit)
    away = points[:, :2].norm(dim=1)
    # a ball above the horizon hides cos (r / d)^2 of an even sky (form factor of a sphere); d^2 = away^2 + r^2
    truth = ((1 + (away / RADIUS) ** 2) ** -1.5).clamp_max(0.96)
    rings = [(away >= low) & (away < low + 0.1) for low in (0.0, 0.1, 0.2, 0.3, 0.4, 0.6)]
    found = [float(lost[ring].mean()) for ring in rings]
    assert found == sorted(found, reverse=True)
    # 0.05: 32 samples of the sky, and a bias of a texel or two under the ball
    assert found == pytest.approx([float(truth[ring].mean()) for ring in rings], abs=0.05)


def test_an_even_sky_leaves_no_light_where_a_ball_touches_the_floor():
    """Closed form: a sphere on a plane takes R^3 / d^3 of the irradiance, d from its centre to the point."""
    light = Light(sources=(), ambient=fit_ambient(torch.full((3,), 1.0)))
    samples = sample_light(light)
    maps = object_shadow_maps(ball(), bounding_sphere(ball()), samples)
    away = RADIUS * torch.tensor([0.1, 0.2, 0.3, 0.5, 1.0])
    turn = torch.arange(24) / 24 * 2 * math.pi
    touching = float(CENTER[2]) - RADIUS
    x, y = away[:, None] * turn.cos(), away[:, None] * turn.sin()
    points = torch.stack([x, y, torch.full_like(x, touching)], -1).reshape(-1, 3)
    up = torch.tensor([[0.0, 0.0, 1.0]]).repeat(len(points), 1)
    ratio = scene_ratio(maps, points, up, sample_visibility=torch.ones(len(points), len(samples)))
    found = ratio.shadow.mean(1).reshape(len(away), -1).mean(1)
    truth = 1 - (1 + (away / RADIUS) ** 2) ** -1.5
    # 32 directions stand for the whole sky, so a cone of 0.35 rad leaves a part of its rim; and `darkest` is left
    torch.testing.assert_close(found, truth, rtol=0, atol=0.05)
