"""Shading of objects: normals, nearest neighbours, gloss of materials, gains, pieces of split Gaussians."""

import math
from dataclasses import replace

import pytest
import torch
from shapes import UP, blobs, random_scene, ring, surfels

from splatgraft.compositing.composite import Composite, PlacedObject
from splatgraft.core import spherical_harmonics
from splatgraft.core.bounds import BoundingSphere, bounding_sphere
from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.directions import even_directions
from splatgraft.core.gaussians import Gaussians, empty
from splatgraft.core.images import linear_from_srgb, srgb_from_linear
from splatgraft.core.similarity import Similarity
from splatgraft.core.spherical_harmonics import basis, colors, dc_from_rgb
from splatgraft.core.splitting import split_along
from splatgraft.relighting import RelightOptions, SourceScene, relight
from splatgraft.relighting.light.light import Light, LightSource, fit_ambient
from splatgraft.relighting.light.samples import sample_light
from splatgraft.relighting.materials import ReflectedLight, estimate_materials, gloss_bands, reflected_light
from splatgraft.relighting.nearest_neighbours import nearest_neighbours
from splatgraft.relighting.normals import estimate_normals
from splatgraft.relighting.object_views import fuse_normals, object_views
from splatgraft.relighting.shading import KNOWN_SURFACES, apply_gain, shade_ratio
from splatgraft.rendering import render

ORIGIN = BoundingSphere(torch.zeros(3), 0.5)


def noisy_ball(noise=0.01, count=1500):
    """Centres scattered in depth by 2% of the radius, as those of a short reconstruction are."""
    around = even_directions(count)
    depth = 0.5 + noise * torch.randn(count, 1, generator=torch.Generator().manual_seed(0))
    return blobs(depth * around, 0.03), around


def all_around(distance=2.5, size=96):
    poses = look_at(distance * even_directions(16), torch.zeros(3), torch.tensor([0.3, 0.1, 1.0]))
    return pinhole(poses, 100.0, width=size, height=size)


def angles_deg(one, other):
    return (one * other).sum(1).clamp(-1, 1).acos().rad2deg()


def box(half=0.3, count=16) -> tuple[Gaussians, torch.Tensor]:
    x = torch.linspace(-half, half, count)
    grid = torch.stack(torch.meshgrid(x, x, indexing="ij"), -1).reshape(-1, 2)
    points, normals = [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            face = torch.zeros(len(grid), 3)
            face[:, [a for a in range(3) if a != axis]] = grid
            face[:, axis] = sign * half
            points.append(face)
            normals.append(torch.eye(3)[axis].mul(sign).expand(len(grid), 3))
    return blobs(torch.cat(points), 0.6 * 2 * half / count), torch.cat(normals)


def test_a_smooth_surface_is_within_the_bound():
    ball, truth = noisy_ball()
    neighbours = estimate_normals(ball, all_around())
    fused = fuse_normals(ball, object_views(ball, ORIGIN, all_around()), neighbours)
    assert angles_deg(fused.vectors, truth).median() < 4  # the bound for objects, degrees
    assert (angles_deg(fused.vectors, truth) < 90).all()


def test_depth_keeps_edges_that_neighbours_round_off():
    body, truth = box()
    neighbours = estimate_normals(body, all_around())
    views = object_views(body, bounding_sphere(body), all_around())
    fused = fuse_normals(body, views, neighbours)
    # one Gaussian from the edge: the nearest 16 lie on both faces
    near = (body.means.abs().sort(1).values[:, 1] > 0.24) & (body.means.abs().sort(1).values[:, 1] < 0.29)
    before, after = (float(angles_deg(n.vectors, truth)[near].mean()) for n in (neighbours, fused))
    assert after < 0.8 * before


def test_both_sides_of_a_thin_plate_face_outward():
    x = torch.linspace(-0.4, 0.4, 25)
    grid = torch.stack(torch.meshgrid(x, x, indexing="ij"), -1).reshape(-1, 2)
    side = torch.tensor([0.03]).expand(len(grid), 1)
    plate = blobs(torch.cat([torch.cat([grid, side], 1), torch.cat([grid, -side], 1)]), 0.015)
    truth = torch.cat([side.sign(), -side.sign()]) * torch.tensor([[0.0, 0.0, 1.0]])
    neighbours = estimate_normals(plate, all_around())
    fused = fuse_normals(plate, object_views(plate, bounding_sphere(plate), all_around()), neighbours)
    inner = (plate.means[:, :2].abs() < 0.3).all(1)
    assert angles_deg(fused.vectors, truth)[inner].median() < 10  # the blobs' own bumps are a few degrees
    assert (angles_deg(fused.vectors, truth)[inner] < 90).float().mean() > 0.98


def test_without_views_the_estimate_by_neighbours_stays():
    ball, _ = noisy_ball()
    away = all_around()
    away.world_from_camera[:, :3, 3] *= -1  # every camera looks away from the ball
    views = object_views(ball, ORIGIN, away)
    assert views == ()
    neighbours = estimate_normals(ball, all_around())
    fused = fuse_normals(ball, views, neighbours)
    assert torch.allclose(fused.vectors, neighbours.vectors, atol=1e-6)
    assert torch.equal(fused.confidence, neighbours.confidence)


@pytest.mark.parametrize("n", [0, 1, 9, 700])
def test_neighbours_are_the_nearest(n):
    generator = torch.Generator().manual_seed(n)
    # dense clusters, strays far away and repeated points, as captures have them
    points = torch.randn(n, 3, generator=generator) ** 5
    points[n // 2 :] *= 1e-3
    points[: n // 5] = points[n // 5 : 2 * (n // 5)]
    found = nearest_neighbours(points, count=16)
    assert found.shape == (n, min(16, n))
    away = (points[:, None] - points[None]).norm(dim=-1)
    expected = away.sort(1).values[:, :16]
    # float32: two parts in 1e7 of the coordinates, up to 1e3
    assert torch.allclose(away.gather(1, found.long()).sort(1).values, expected, atol=1e-4)
    assert all(len(set(row)) == len(row) for row in found.tolist())


def test_normals_of_a_ball_point_outwards():
    around = even_directions(3000)
    ball = surfels(0.3 * around, around, width=0.01, srgb=torch.full((3000, 3), 0.5))
    found = estimate_normals(ball, ring())
    above = around[:, 2] > -0.2  # the cameras do not see the underside
    # neighbours lie within 3 degrees on the ball
    assert ((found.vectors * around).sum(1)[above] > math.cos(math.radians(5))).float().mean() > 0.99
    assert found.confidence[above].mean() > 0.7


def test_split_pieces_look_like_the_whole():
    one = surfels(torch.tensor([[0.0, 0.0, 0.0]]), UP[None], width=0.3, srgb=(0.8, 0.4, 0.2))
    camera = pinhole(look_at(torch.tensor([[0.0, 0.3, 4.0]]), torch.zeros(3), UP), 160.0, width=96, height=96)
    for opacity in (0.1, 0.5, 0.9):
        whole = Gaussians(one.means, one.log_scales, one.quaternions, torch.logit(torch.tensor([opacity])), one.sh)
        pieces, origin = split_along(whole, torch.tensor([0]))
        assert torch.equal(origin, torch.zeros(5, dtype=torch.long))
        a, b = render(whole, camera), render(pieces, camera)
        # the table errs by up to 0.038 at opacity 0.9; each of five pieces is cut where it falls under 1/255
        assert (a.alpha - b.alpha).abs().max() < 0.038 + 5 / 255
        inside = a.alpha > 0.05
        assert ((a.alpha - b.alpha)[inside] ** 2).mean().sqrt() < 0.02
        assert torch.equal(pieces.sh, whole.sh.repeat(5, 1, 1))


COUNT = 1500
AROUND = even_directions(COUNT)
GRAY = torch.tensor([0.2, 0.15, 0.1])


def lamp(x, y, z) -> Light:
    length = math.sqrt(x * x + y * y + z * z)
    source = LightSource((x / length, y / length, z / length), (2.0, 2.0, 2.0), angular_radius_deg=10.0)
    return Light(sources=(source,), ambient=fit_ambient(torch.full((3,), 0.3)))


def at_ball(light: Light) -> ReflectedLight:
    samples = sample_light(light)
    return reflected_light(light, samples, torch.ones(COUNT, len(samples)))


def glossy_ball(light: Light, reflectance, *, concentration=6.0, dielectric=False) -> Gaussians:
    """Return a ball with a lobe as bands of degree 3; directions behind the surface show the same as those in front."""
    views = even_directions(400)
    cosine = (views @ AROUND.T).T.abs()
    in_front = views - ((views @ AROUND.T).T + cosine)[..., None] * AROUND[:, None]
    lobe = at_ball(light).radiance(in_front + 2 * cosine[..., None] * AROUND[:, None], concentration)
    lobe = lobe * torch.tensor(reflectance)
    if dielectric:
        lobe = lobe * (0.04 + 0.96 * (1 - cosine.clamp(0, 1)) ** 5)[..., None]
    target = srgb_from_linear(GRAY + lobe) - 0.5
    sh = torch.einsum("vk,nvc->nkc", basis(views, 3), target) * (4 * math.pi / len(views))
    width = 1.2 * 0.3 * math.sqrt(4 * math.pi / COUNT) / 2
    return replace(surfels(0.3 * AROUND, AROUND, width=width), opacity_logits=torch.full((COUNT,), 4.0), sh=sh)


def materials_of(body: Gaussians, light: Light):
    cameras = all_around(distance=2.0, size=64)
    views = object_views(body, bounding_sphere(body), cameras)
    return estimate_materials(body, AROUND, views, at_ball(light))


@pytest.mark.parametrize("concentration", [3.0, 6.0])
def test_a_lobe_is_found_again(concentration):
    light = lamp(1, 0, 1)
    found = materials_of(glossy_ball(light, (0.3, 0.2, 0.1), concentration=concentration), light)
    # bands of degree 3 hold most of such lobes; belief, pixels and blur each reduce them a little
    assert torch.allclose(found.reflectance.median(0).values, torch.tensor([0.3, 0.2, 0.1]), rtol=0.35)
    assert float(found.concentration.median()) in (concentration / 2, concentration, 2 * concentration)
    assert not found.dielectric.float().mean() > 0.5
    assert float((found.matt - GRAY).abs().median()) < 0.25 * float(GRAY.mean())


def test_matt_things_stay_matt():
    light = lamp(1, 0, 1)
    for body in (
        glossy_ball(light, (0.0, 0.0, 0.0)),
        replace(glossy_ball(light, (0.3, 0.3, 0.3)), sh=dc_from_rgb(torch.full((COUNT, 1, 3), 0.4))),
    ):
        found = materials_of(body, light)
        assert float(found.share.max()) < 0.02
        layer = gloss_bands(body, AROUND, found, at_ball(lamp(-1, 0, 1)), shade=torch.ones(COUNT, 3))
        assert float(layer.abs().max()) < 0.05


def test_noise_that_the_light_does_not_explain_is_no_gloss():
    light, body = lamp(1, 0, 1), glossy_ball(lamp(1, 0, 1), (0.0, 0.0, 0.0))
    bands = 0.1 * torch.randn(COUNT, 15, 3, generator=torch.Generator().manual_seed(0))
    noisy = replace(body, sh=torch.cat([body.sh[:, :1], bands], 1))
    assert float(materials_of(noisy, light).share.mean()) < 0.05


def test_without_a_view_nothing_is_glossy():
    light = lamp(1, 0, 1)
    found = estimate_materials(glossy_ball(light, (0.3, 0.3, 0.3)), AROUND, (), at_ball(light))
    assert not bool(found.glossy.any())


def test_a_highlight_moves_to_the_new_light():
    old, new = lamp(1, 0, 1), lamp(-1, 0, 1)
    body, truth = glossy_ball(old, (0.3, 0.2, 0.1)), glossy_ball(new, (0.3, 0.2, 0.1))
    found = materials_of(body, old)
    layer = gloss_bands(body, AROUND, found, at_ball(new), shade=torch.ones(COUNT, 3))
    moved = torch.cat([body.sh[:, :1], torch.zeros(COUNT, 15, 3)], 1) + layer
    for eye in (torch.tensor([1.0, 0.0, 0.5]), torch.tensor([-1.0, 0.0, 0.5])):
        view = -torch.nn.functional.normalize(eye, dim=0).expand(COUNT, 3)
        front = (AROUND * -view).sum(1) > 0.3

        def error(sh, view=view, front=front):
            off = linear_from_srgb(colors(sh, view)) - linear_from_srgb(colors(truth.sh, view))
            return float((off[front] ** 2).mean())

        # the lobe is known up to belief and blur: a quarter of its amplitude, a sixteenth of the squared error
        assert error(moved) < 0.15 * error(body.sh)


@pytest.mark.parametrize("reflectance", [0.5, 0.0])
def test_the_report_names_a_mirror(reflectance):
    # bands of degree 3 hold the mirror image of such a sky exactly, so that the sharpest lobe fits best
    sky = fit_ambient(torch.full((3,), 0.6))
    sky[2] += 0.8
    sky[6] += 0.4
    light = Light(sources=(), ambient=sky)
    body = glossy_ball(light, (reflectance,) * 3, concentration=1000.0)
    cameras = all_around(distance=2.0, size=64)
    far = surfels(20 * even_directions(500), -even_directions(500), width=0.1)
    placed = PlacedObject(body, Similarity(1.0, torch.eye(3), torch.zeros(3)))
    composite = Composite(far, (placed,), torch.zeros(far.count, dtype=torch.bool))
    source = SourceScene(empty(), cameras, light=light, normals=AROUND)
    report = relight(
        composite, cameras, sources=(source,), light=lamp(1, 0, 1), options=RelightOptions(fitted_views=0)
    ).report
    assert any("is a mirror, whose reflections are only blurred" in note.text for note in report) == (reflectance > 0)


def random_gaussians():
    scene = random_scene(40, 3, seed=0)
    return replace(scene, sh=scene.sh / 8)  # deviations of 0.05


def test_a_known_surface_takes_the_whole_level_of_the_light():
    received = (2.4 * torch.tensor([0.5, 1.0, 2.0])[:, None]).expand(3, 3)
    shade = shade_ratio(received, torch.ones(3, 3), torch.ones(3), settings=KNOWN_SURFACES)
    assert torch.allclose(shade, received, rtol=1e-4)


def test_a_gain_of_1_changes_no_bit():
    object_ = random_gaussians()
    assert torch.equal(apply_gain(object_, torch.ones(3)).sh, object_.sh)


def test_gain_multiplies_linear_light_of_the_mean_colour():
    object_, gain = random_gaussians(), torch.tensor([1.4, 0.8, 0.5])
    before = linear_from_srgb(spherical_harmonics.rgb_from_dc(object_.sh[:, 0]))
    after = linear_from_srgb(spherical_harmonics.rgb_from_dc(apply_gain(object_, gain).sh[:, 0]))
    assert torch.allclose(after, before * gain, atol=1e-5)  # float32 powers there and back


def test_higher_bands_follow_to_first_order():
    object_, gain = random_gaussians(), torch.tensor([1.4, 0.8, 0.5])
    directions = torch.nn.functional.normalize(torch.randn(40, 3, generator=torch.Generator().manual_seed(1)), dim=-1)
    exact = srgb_from_linear(linear_from_srgb(spherical_harmonics.colors(object_.sh, directions)) * gain)
    found = spherical_harmonics.colors(apply_gain(object_, gain).sh, directions)
    # deviations are about 0.05 * 1.1 = 0.06 rms, 0.2 at most; the curve's second derivative is under 1 for these gains
    assert (found - exact).abs().max() < 0.5 * 0.2**2
    assert (found - exact).abs().mean() < 0.5 * 0.06**2
