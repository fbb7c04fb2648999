"""Reflections of the old light become those of the new light; matt surfaces stay matt."""

import math

import torch

from splatgraft.core.directions import even_directions
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.spherical_harmonics import basis
from splatgraft.relighting.light.light import Light, LightSource, fit_ambient
from splatgraft.relighting.shading.normals import Normals
from splatgraft.relighting.shading.reflection import gloss_layer


def lamp(x, y, z) -> Light:
    length = math.sqrt(x * x + y * y + z * z)
    source = LightSource(direction=(x / length, y / length, z / length), irradiance=(2.0, 2.0, 2.0))
    return Light(sources=(source,), ambient=fit_ambient(torch.full((3,), 0.3)))


def plate(bands) -> tuple[Gaussians, Normals]:
    n = len(bands)
    up = torch.tensor([[0.0, 0.0, 1.0]]).repeat(n, 1)
    gaussians = Gaussians(
        means=torch.zeros(n, 3),
        log_scales=torch.full((n, 3), -3.0),
        quaternions=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        opacity_logits=torch.zeros(n),
        sh=bands,
    )
    return gaussians, Normals(vectors=up, confidence=torch.ones(n), seen=torch.ones(n, dtype=torch.bool))


def reflection(light: Light, share: float):
    """Bands of a plate that faces up and mirrors `share` of a light's lobe, by projection over all directions."""
    views = even_directions(2000)
    mirrored = views * torch.tensor([1.0, 1.0, -1.0])
    lobe = (mirrored @ torch.tensor(light.sources[0].direction)).clamp_min(0)
    values = share * lobe * (views[:, 2] < 0)
    bands = (basis(views, 3) * values[:, None]).sum(0) * 4 * math.pi / 2000
    return bands[None, :, None].repeat(1, 1, 3)


def brightest_view(sh):
    views = even_directions(2000)
    views = views[views[:, 2] < -0.3]
    return views[(basis(views, 3)[:, 1:] @ sh[0, 1:].mean(-1)).argmax()]


def test_a_matt_plate_stays_matt():
    gaussians, normals = plate(torch.zeros(1, 16, 3))
    layer = gloss_layer(gaussians, normals, lamp(1, 0, 1), lamp(-1, 0, 1), ratio=torch.ones(1, 3))
    assert torch.equal(layer, torch.zeros_like(layer))


def test_one_light_for_both_changes_nothing():
    gaussians, normals = plate(reflection(lamp(1, 0, 1), 0.2))
    layer = gloss_layer(gaussians, normals, lamp(1, 0, 1), lamp(1, 0, 1), ratio=torch.ones(1, 3))
    assert layer.abs().max() < 1e-6


def test_a_reflection_moves_towards_the_new_light():
    gaussians, normals = plate(reflection(lamp(1, 0, 1), 0.2))
    layer = gloss_layer(gaussians, normals, lamp(1, 0, 1), lamp(-1, 0, 1), ratio=torch.ones(1, 3))
    # light from +x is mirrored to a camera at -x, which looks along +x; the new one the other way round
    assert brightest_view(gaussians.sh)[0] > 0
    views = torch.nn.functional.normalize(torch.tensor([[1.0, 0.0, -1.0], [-1.0, 0.0, -1.0]]), dim=1)
    old, new = basis(views, 3)[:, 1:] @ layer[0, 1:].mean(-1)
    assert new > 0 > old
