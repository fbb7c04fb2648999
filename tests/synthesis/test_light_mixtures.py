"""Lights mixed from the light of single lamps: what is drawn, and the camera's exposure."""

import random

import pytest
import torch

from splatgraft.synthesis.benchmark import pedestal_scene
from splatgraft.synthesis.light_mixtures import GroupLight, draw_gains, exposed, mix, mixed_light, with_more_lamps
from splatgraft.synthesis.pairs import KINDS, make_scene


def lit_scenes():
    """Scenes of every kind, and a pedestal."""
    for kind in KINDS:
        for seed in range(6):
            yield with_more_lamps(make_scene(kind, 1000 + seed), random.Random(seed))
    yield with_more_lamps(pedestal_scene(5, make_scene("garden", 3).places[0]), random.Random(0))


def test_rooms_and_pedestals_get_lamps_and_a_place_outdoors_one_sun():
    for scene in lit_scenes():
        suns = [lamp for lamp in scene.lamps if lamp.kind == "sun"]
        if scene.kind in ("garden", "terrace", "square"):
            assert len(suns) + (scene.world.kind == "sky") == 1
        else:
            # in the evening a room may have its ceiling's lamp alone
            assert len(scene.lamps) >= (1 if scene.notes.get("mood") == "evening" else 2)
            assert len(suns) <= 1


def test_some_light_is_on_in_every_mixture_and_the_evening_has_no_sun():
    evenings = 0
    for scene in lit_scenes():
        rng = random.Random(7)
        for _ in range(40):
            gains = draw_gains(scene, rng)
            assert gains.shape == (1 + len(scene.lamps), 3)
            assert bool((gains >= 0).all())
            assert float(gains.max()) > 0.02
            is_evening = float(gains[0].max()) < 0.1
            evenings += is_evening
            for lamp, gain in zip(scene.lamps, gains[1:], strict=True):
                if lamp.kind == "sun" and is_evening:
                    assert float(gain.max()) == 0
    assert evenings > 20


def test_the_same_seed_draws_the_same():
    scene = next(lit_scenes())
    assert torch.equal(draw_gains(scene, random.Random(3)), draw_gains(scene, random.Random(3)))


@pytest.mark.parametrize("strength", [0.01, 1.0, 300.0])
def test_exposure_brings_any_strength_to_mid_grey(strength):
    picture = strength * (0.5 + torch.rand(2, 20, 30, 3, generator=torch.Generator().manual_seed(0)))
    levels = []
    for seed in range(60):
        gains = exposed(torch.ones(2, 3), [picture], random.Random(seed))
        levels.append(float((mix(gains, picture) @ torch.tensor([0.2126, 0.7152, 0.0722])).log2().mean()))
    # the geometric mean, up to 0.4 stops by chance
    assert sum(levels) / 60 == pytest.approx(torch.tensor(0.22).log2().item(), abs=0.2)
    assert 0.25 < torch.tensor(levels).std() < 0.6


def test_a_lamp_that_is_off_is_no_sun():
    light = GroupLight(
        torch.ones(2, 4, 8, 3), ({"direction": [0, 0, 1], "irradiance": [3.0, 2.0, 1.0], "group": "sun"},)
    )
    panorama, suns = mixed_light(torch.tensor([[1.0, 1, 1], [0, 0, 0]]), light, ["world", "sun"])
    assert suns == []
    assert torch.equal(panorama, torch.ones(4, 8, 3))
    _, suns = mixed_light(torch.tensor([[1.0, 1, 1], [2, 0.5, 1]]), light, ["world", "sun"])
    assert suns[0]["irradiance"] == pytest.approx([6.0, 1.0, 1.0])
