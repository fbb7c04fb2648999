"""The learned correction of the light: what it may not depend on, its files, and how it changes an estimate."""

import math
from dataclasses import replace

import pytest
import torch
from safetensors.torch import save_file
from shapes import surfels
from test_light_estimate import sunlit_scene, views

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.composite import Composite, PlacedObject
from splatgraft.core.directions import even_directions
from splatgraft.core.similarity import Similarity
from splatgraft.relighting import SourceScene, relight
from splatgraft.relighting.light.estimate import EstimatedLight, fit_light
from splatgraft.relighting.light.learned.ensemble import LightEnsemble, SeenPlaces, read_ensemble, write_ensemble
from splatgraft.relighting.light.learned.learned_light import fit_learned_light, radiance_correction
from splatgraft.relighting.light.learned.network import LightCorrection, LightNetwork, network_inputs
from splatgraft.relighting.light.place_description import (
    MAPS,
    NUMBERS,
    PlaceDescription,
    cell_directions,
    cell_solid_angles,
    describe_place,
    upright_from_world,
)
from splatgraft.relighting.light.radiance_correction import RatioShares

PLACE = BoundingSphere(torch.tensor([0.0, 0.0, 0.3]), 0.3)
SUN = torch.tensor([0.6 * 0.764, 0.6 * 0.645, 0.8])
SHARES = RatioShares(level=0.4, tint=0.25)


@pytest.fixture(scope="module")
def scene():
    """A floor under a sun that no camera saw."""
    return sunlit_scene(SUN, 3.0)


@pytest.fixture(scope="module")
def found(scene):
    """Its estimated light."""
    estimate = fit_light(scene, PLACE, views())
    assert isinstance(estimate, EstimatedLight)
    return estimate


def random_network(seed=0):
    torch.manual_seed(seed)
    network = LightNetwork()
    for parameter in network.parameters():
        parameter.data += 0.2 * torch.randn_like(parameter)
    return network.eval().requires_grad_(False)


def random_place(seed=0):
    generator = torch.Generator().manual_seed(seed)
    return PlaceDescription(
        torch.randn(len(MAPS), 12, 24, generator=generator), torch.randn(len(NUMBERS), generator=generator)
    )


def ensemble_of(network, place):
    others = torch.stack([network_inputs(place) + 0.05 * torch.randn_like(place.maps[:1]) for _ in range(50)])
    return LightEnsemble((network,), SeenPlaces.of(others), SHARES)


def test_a_turn_of_the_place_turns_the_correction():
    network, inputs = random_network(), network_inputs(random_place())[None]
    here, turned = network(inputs), network(inputs.roll(5, 3))
    assert torch.allclose(here.gain.roll(5, 2), turned.gain, atol=1e-5)
    assert torch.allclose(here.lamp.roll(5, 2), turned.lamp, atol=1e-5)
    assert torch.allclose(here.log_sd, turned.log_sd, atol=1e-5)
    assert not torch.allclose(here.gain, turned.gain, atol=1e-3)


def test_another_exposure_changes_nothing(scene):
    place = random_place()
    stops = 1.3
    brighter = place.maps.clone()
    for name in ("red", "green", "blue", "estimated", "estimated unseen", "estimated clipped", "surfaces' brightness"):
        brighter[MAPS.index(name)] += stops
    numbers = place.numbers.clone()
    numbers[NUMBERS.index("log brightness of surfaces")] += stops
    assert torch.allclose(network_inputs(place), network_inputs(PlaceDescription(brighter, numbers)), atol=1e-5)


def test_an_untrained_network_changes_little(found):
    network = LightNetwork().eval()
    correction, _ = ensemble_of(network, describe_place(found)).correct(describe_place(found))
    changed = radiance_correction(correction, found, shares=SHARES, distance=0.0).apply(found.radiance)
    assert 0.7 < float(changed.sum() / found.radiance.sum()) < 1.4


def test_files_hold_the_networks_and_bad_ones_are_one_line(tmp_path):
    network, place = random_network(), random_place()
    ensemble = replace(ensemble_of(network, place), applied=0.5, sd_factors=(2.0, 3.0, 4.0))
    path = tmp_path / "light.safetensors"
    write_ensemble(path, ensemble, {"seed": "0"})
    again = read_ensemble(path)
    assert (again.applied, again.sd_factors) == (0.5, (2.0, 3.0, 4.0))
    half, whole = again.correct(place)[0], replace(again, applied=1.0, sd_factors=(1.0, 1.0, 1.0)).correct(place)[0]
    assert torch.allclose(half.gain, 0.5 * whole.gain, atol=1e-5)
    assert torch.allclose(half.lamp, whole.lamp - 1, atol=1e-4)
    assert torch.allclose((half.log_sd - whole.log_sd).exp2(), torch.tensor([[2.0, 3.0, 4.0]]))
    # half precision
    assert torch.allclose(again.correct(place)[0].gain, ensemble.correct(place)[0].gain, atol=0.02)
    with pytest.raises(ValueError, match=r"none.safetensors: expected weights of the light network, found"):
        read_ensemble(tmp_path / "none.safetensors")
    other = tmp_path / "other.safetensors"
    save_file({"a": torch.zeros(2)}, str(other), {"format": "splatgraft light network 0"})
    with pytest.raises(ValueError, match=r"other.safetensors: expected 'splatgraft light network 3' in its header"):
        read_ensemble(other)
    save_file({"a": torch.zeros(2)}, str(tmp_path / "empty.safetensors"), {"format": "splatgraft light network 3"})
    with pytest.raises(ValueError, match=r"empty.safetensors: expected the tensors of the light network, found"):
        read_ensemble(tmp_path / "empty.safetensors")
    path.write_bytes(path.read_bytes()[:500])
    read_ensemble.cache_clear()
    with pytest.raises(ValueError, match=r"light.safetensors: expected weights of the light network, found"):
        read_ensemble(path)


def test_a_place_unlike_the_training_is_corrected_less_and_less_surely():
    network, place = random_network(), random_place()
    ensemble = ensemble_of(network, place)
    near, distance = ensemble.correct(place)
    assert distance <= 1
    odd = replace(place, maps=place.maps + 3.0)
    far, distance = ensemble.correct(odd)
    assert distance > 2
    plain = network(network_inputs(odd)[None])
    assert float(far.gain.abs().mean()) < 0.3 * float(plain.gain.abs().mean())
    assert bool((far.log_sd > plain.log_sd + 1).all())
    assert torch.allclose(near.gain, network(network_inputs(place)[None]).gain, atol=1e-6)


def test_twice_the_light_is_twice_the_light_and_keeps_its_sun(scene, found):
    double = LightCorrection(torch.ones(1, 12, 24, 3), torch.full((1, 12, 24), -30.0), torch.zeros(1, 3))
    changed = found.corrected(radiance_correction(double, found, shares=SHARES, distance=0.0), scene, PLACE)
    normals = even_directions(60)
    ratio = changed.light.irradiance(normals) / found.light.irradiance(normals)
    assert torch.allclose(ratio, torch.full_like(ratio, 2.0), rtol=0.02)
    assert changed.light.sources[0].direction == pytest.approx(found.light.sources[0].direction, abs=1e-4)
    # and at a place nearby
    moved = changed.at(scene, views(), replace(PLACE, center=PLACE.center + 0.05))
    plain = found.at(scene, views(), replace(PLACE, center=PLACE.center + 0.05))
    assert isinstance(moved, EstimatedLight)
    assert isinstance(plain, EstimatedLight)
    ratio = moved.light.irradiance(normals) / plain.light.irradiance(normals)
    assert torch.allclose(ratio, torch.full_like(ratio, 2.0), rtol=0.02)


def test_a_missed_lamp_lights_what_faces_it(scene, found):
    lamp = torch.full((1, 12, 24), -30.0)
    lamp[0, 4, 7] = (4 * math.pi / cell_solid_angles()[4, 7]).log2()
    nothing = LightCorrection(torch.zeros(1, 12, 24, 3), lamp, torch.zeros(1, 3))
    changed = found.corrected(radiance_correction(nothing, found, shares=SHARES, distance=0.0), scene, PLACE)
    towards = cell_directions()[4, 7] @ upright_from_world(found.evidence.up)
    added = changed.light.irradiance(towards[None]) - found.light.irradiance(towards[None])
    # as much light as all the rest gives from everywhere: 4 pi times the mean radiance
    wanted = 4 * math.pi * found.radiance.mean()
    assert float(added.mean()) == pytest.approx(float(wanted), rel=0.15)
    assert float(changed.light.irradiance(-towards[None]).mean()) < 1.2 * float(
        found.light.irradiance(-towards[None]).mean()
    )


def test_without_networks_the_estimate_stands(scene, found):
    plain = fit_learned_light(scene, PLACE, views(), None)
    assert isinstance(plain, EstimatedLight)
    assert plain.correction is None
    assert torch.equal(plain.light.ambient, found.light.ambient)


def test_a_transfer_takes_networks_for_both_places_and_says_what_they_changed(scene):
    network = LightNetwork().eval().requires_grad_(False)
    for last, biases in ((network.cells[-1], [0.0, 0.0]), (network.whole[-1], [1.04, 0, 0, -9, 0, 0, 0])):
        assert isinstance(last, torch.nn.Conv2d | torch.nn.Linear)
        assert last.bias is not None
        last.weight.zero_()
        last.bias.copy_(torch.tensor(biases))
    place = random_place()
    count = len(network_inputs(place))
    ensemble = LightEnsemble((network,), SeenPlaces(torch.zeros(count), torch.zeros(count, count), 1.0), SHARES)
    around = even_directions(400)
    ball = surfels(PLACE.center + 0.2 * around, around, width=0.02)
    at = Similarity(1.0, torch.eye(3), torch.zeros(3))
    composite = Composite(scene, (PlacedObject(ball, at),), torch.zeros(scene.count, dtype=torch.bool))
    plain = relight(composite, views(), sources=[SourceScene(scene, views())])
    both = relight(composite, views(), sources=[SourceScene(scene, views(), ensemble)], light=ensemble)
    one = relight(composite, views(), sources=[SourceScene(scene, views())], light=ensemble)
    assert any("Networks changed the new place's light by +1.0 stops" in line for line in both.report)
    assert not any("Networks" in line for line in plain.report)
    shades = [float(relit.shade[relit.is_object].log2().mean()) for relit in (plain, both, one)]
    # both places twice as bright: as before; one alone changes the share of the level that is applied
    assert shades[1] == pytest.approx(shades[0], abs=0.03)
    assert shades[2] > shades[0] + 0.2


def test_of_the_ratio_of_two_corrected_lights_the_share_is_applied_that_training_found(scene):
    around = even_directions(400)
    ball = surfels(PLACE.center + 0.2 * around, around, width=0.02)
    at = Similarity(1.0, torch.eye(3), torch.zeros(3))
    composite = Composite(scene, (PlacedObject(ball, at),), torch.zeros(scene.count, dtype=torch.bool))
    darker = sunlit_scene(SUN, 1.0)
    nothing = LightNetwork().eval().requires_grad_(False)
    for last in (nothing.cells[-1], nothing.whole[-1]):
        assert isinstance(last, torch.nn.Conv2d | torch.nn.Linear)
        assert last.bias is not None
        last.weight.zero_()
        last.bias.zero_()
    count = len(network_inputs(random_place()))

    def level(share: float, mean: float = 0.0) -> float:
        """Mean logarithm of the shading, in stops."""
        seen = SeenPlaces(torch.full((count,), mean), torch.eye(count), 10.0)
        ensemble = LightEnsemble((nothing,), seen, RatioShares(share, 0.0))
        relit = relight(composite, views(), sources=[SourceScene(darker, views(), ensemble)], light=ensemble)
        return float(relit.shade[relit.is_object].log2().mean())

    none, half, whole = level(0.0), level(0.5), level(1.0)
    assert whole - none > 0.3
    assert half - none == pytest.approx(0.5 * (whole - none), abs=0.05)
    # places unlike those of the training: the share of an estimate without networks
    far = level(1.0, mean=1000.0)
    assert far == pytest.approx(none + SHARES.level * (whole - none), abs=0.05)
