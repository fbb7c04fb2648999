"""Gloss of materials: a rendered lobe is found again and moves to the new light; matt and unseen things stay matt."""

import math
from dataclasses import replace

import pytest
import torch
from shapes import surfels

from splatgraft.core.bounds import bounding_sphere
from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.composite import Composite, PlacedObject
from splatgraft.core.directions import even_directions, frames_along
from splatgraft.core.gaussians import Gaussians, empty
from splatgraft.core.images import linear_from_srgb, srgb_from_linear
from splatgraft.core.rotations import quaternion_from_rotation
from splatgraft.core.similarity import Similarity
from splatgraft.core.spherical_harmonics import basis, colors, dc_from_rgb
from splatgraft.relighting import SourceScene, relight
from splatgraft.relighting.light.light import Light, LightSource, fit_ambient
from splatgraft.relighting.light.samples import sample_light
from splatgraft.relighting.materials import ReflectedLight, estimate_materials, gloss_bands, reflected_light
from splatgraft.relighting.object_views import object_views

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


def ball(light: Light, reflectance, *, concentration=6.0, dielectric=False) -> Gaussians:
    """A ball with a lobe as bands of degree 3; directions behind the surface show what those in front do."""
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
    return Gaussians(
        means=0.3 * AROUND,
        log_scales=torch.tensor([width, width, 0.1 * width]).log().repeat(COUNT, 1),
        quaternions=quaternion_from_rotation(frames_along(-AROUND).transpose(1, 2)),
        opacity_logits=torch.full((COUNT,), 4.0),
        sh=sh,
    )


def materials_of(body: Gaussians, light: Light):
    eyes = 2.0 * even_directions(16)
    cameras = pinhole(look_at(eyes, torch.zeros(3), torch.tensor([0.3, 0.1, 1.0])), 100.0, width=64, height=64)
    views = object_views(body, bounding_sphere(body), cameras)
    return estimate_materials(body, AROUND, views, at_ball(light))


@pytest.mark.parametrize("concentration", [3.0, 6.0])
def test_a_lobe_is_found_again(concentration):
    light = lamp(1, 0, 1)
    found = materials_of(ball(light, (0.3, 0.2, 0.1), concentration=concentration), light)
    # bands of degree 3 hold most of such lobes; belief, pixels and blur each take some of it
    assert torch.allclose(found.reflectance.median(0).values, torch.tensor([0.3, 0.2, 0.1]), rtol=0.35)
    assert float(found.concentration.median()) in (concentration / 2, concentration, 2 * concentration)
    assert not found.dielectric.float().mean() > 0.5
    assert float((found.matt - GRAY).abs().median()) < 0.25 * float(GRAY.mean())


def test_matt_things_stay_matt():
    light = lamp(1, 0, 1)
    for body in (
        ball(light, (0.0, 0.0, 0.0)),
        replace(ball(light, (0.3, 0.3, 0.3)), sh=dc_from_rgb(torch.full((COUNT, 1, 3), 0.4))),
    ):
        found = materials_of(body, light)
        assert float(found.share.max()) < 0.02
        layer = gloss_bands(body, AROUND, found, at_ball(lamp(-1, 0, 1)), shade=torch.ones(COUNT, 3))
        assert float(layer.abs().max()) < 0.05


def test_noise_that_the_light_does_not_explain_is_no_gloss():
    light, body = lamp(1, 0, 1), ball(lamp(1, 0, 1), (0.0, 0.0, 0.0))
    bands = 0.1 * torch.randn(COUNT, 15, 3, generator=torch.Generator().manual_seed(0))
    noisy = replace(body, sh=torch.cat([body.sh[:, :1], bands], 1))
    assert float(materials_of(noisy, light).share.mean()) < 0.05


def test_without_a_view_nothing_is_glossy():
    light = lamp(1, 0, 1)
    found = estimate_materials(ball(light, (0.3, 0.3, 0.3)), AROUND, (), at_ball(light))
    assert not bool(found.glossy.any())


def test_a_highlight_moves_to_the_new_light():
    old, new = lamp(1, 0, 1), lamp(-1, 0, 1)
    body, truth = ball(old, (0.3, 0.2, 0.1)), ball(new, (0.3, 0.2, 0.1))
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
    body = ball(light, (reflectance,) * 3, concentration=1000.0)
    eyes = 2.0 * even_directions(16)
    cameras = pinhole(look_at(eyes, torch.zeros(3), torch.tensor([0.3, 0.1, 1.0])), 100.0, width=64, height=64)
    far = surfels(20 * even_directions(500), -even_directions(500), width=0.1)
    placed = PlacedObject(body, Similarity(1.0, torch.eye(3), torch.zeros(3)))
    composite = Composite(far, (placed,), torch.zeros(far.count, dtype=torch.bool))
    source = SourceScene(empty(), cameras, light=light, normals=AROUND)
    report = relight(composite, cameras, sources=(source,), light=lamp(1, 0, 1)).report
    assert any("is a mirror, whose reflections are only blurred" in note.text for note in report) == (reflectance > 0)
