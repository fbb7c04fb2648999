"""Training of the light's correction: it learns what can be learned, says how sure it is, and ships what loads."""

import json

import pytest
import torch

from splatgraft.cli import main
from splatgraft.relighting.light.learned.ensemble import read_ensemble
from splatgraft.relighting.light.place_description import MAPS, NUMBERS, PlaceDescription
from splatgraft.training.light_examples import CellLight, LightExample, write_examples
from splatgraft.training.light_training import (
    IrradianceErrors,
    LightData,
    LightTrainingOptions,
    ratio_shares,
    train_light,
)


def places(count, lights=2, *, noise=0.1, seed=0, learnable=True):
    """Places whose estimate is too dark by what one of their numbers says, in stops, but for chance."""
    generator = torch.Generator().manual_seed(seed)
    found = []
    for scene in range(count):
        for light in range(lights):
            maps = 0.1 * torch.randn(len(MAPS), 12, 24, generator=generator)
            numbers = torch.randn(len(NUMBERS), generator=generator)
            radiance = torch.rand(12, 24, 3, generator=generator) + 0.5
            irradiance = torch.full((12, 24, 3), math_pi_mean(radiance))
            stops = 0.8 * learnable * numbers[2] + noise * torch.randn((), generator=generator)
            truth = CellLight(radiance * 2**stops, irradiance * 2**stops)
            name = f"{scene:03d}/{'old' if light % 2 else 'new'}"
            found.append(LightExample(name, PlaceDescription(maps, numbers), truth, CellLight(radiance, irradiance)))
    return found


def math_pi_mean(radiance):
    """Irradiance of an even sky."""
    return float(torch.pi * radiance.mean())


OPTIONS = LightTrainingOptions(steps=120, folds=2, batch=12)


@pytest.fixture(scope="module")
def trained():
    """A short training, and the lines that it said."""
    lines = []
    result = train_light(places(40), OPTIONS, say=lines.append, progress=lambda *_: None)
    return result, lines


def test_scenes_left_out_are_corrected(trained):
    result, lines = trained
    assert float(result.after.level.abs().mean()) < 0.5 * float(result.before.level.abs().mean())
    assert len(lines) == OPTIONS.folds + 1
    assert result.ensemble.applied > 0.5


def test_what_cannot_be_learned_is_not_applied_and_the_uncertainty_is_that_of_scenes_left_out():
    """The truth differs by chance alone, which networks learn by heart."""
    examples = places(16, noise=1.0, learnable=False)
    found = train_light(examples, OPTIONS, say=lambda _: None, progress=lambda *_: None)
    assert found.ensemble.applied <= 0.25
    calibrated = found.log_sd[:, 0].exp2() * found.ensemble.sd_factors[0]
    assert float((found.after.level / calibrated).square().mean().sqrt()) == pytest.approx(1.0, abs=0.02)


def test_the_uncertainty_is_that_of_scenes_left_out(trained):
    result, _ = trained
    claimed = result.log_sd[:, 0].exp2()
    ratio = float((result.after.level / claimed).square().mean().sqrt())
    assert 0.6 < ratio < 1.7


def test_training_again_gives_the_same(trained):
    again = train_light(places(40), OPTIONS, say=lambda _: None, progress=lambda *_: None)
    assert torch.equal(again.after.level, trained[0].after.level)


def test_errors_are_split_into_level_change_and_tint():
    truth = torch.zeros(1, 12, 24, 3)
    level = IrradianceErrors.of(truth + 0.5, truth)
    assert float(level.level[0]) == pytest.approx(0.5)
    assert float(level.change[0]) == pytest.approx(0, abs=1e-6)
    assert float(level.total[0]) == pytest.approx(0.5)
    warm = IrradianceErrors.of(truth + torch.tensor([0.3, 0.0, -0.3]), truth)
    assert warm.tint[0].tolist() == pytest.approx([0.3, 0.0, -0.3], abs=0.03)
    assert abs(float(warm.level[0])) < 0.03


def test_a_turned_example_is_the_same_example_turned():
    data = LightData.of(places(3))
    turned = data.turned(5, mirrored=True)
    for one, other, axis in zip(
        (data.inputs, data.radiance, data.truth), (turned.inputs, turned.radiance, turned.truth), (3, 2, 2), strict=True
    ):
        assert torch.equal(one.roll(5, axis).flip(axis), other)


def test_too_few_scenes_are_refused():
    with pytest.raises(ValueError, match="examples: expected those of at least 3 scenes, found 2"):
        train_light(places(2), LightTrainingOptions(steps=1), say=lambda _: None, progress=lambda *_: None)


def test_the_command_trains_and_its_weights_load(tmp_path, capsys):
    write_examples(tmp_path / "examples.npz", places(12))
    words = ["train", "light", str(tmp_path), "--out", str(tmp_path / "out")]
    assert main([*words, "--steps", "60", "--batch", "8", "--folds", "2"]) == 0
    assert len(read_ensemble(tmp_path / "out" / "light.safetensors").networks) == 2
    found = json.loads((tmp_path / "out" / "held_out.json").read_text())
    assert found["new places, corrected"]["irradiance"] < found["new places, uncorrected"]["irradiance"]
    capsys.readouterr()
    assert main(["train", "light", str(tmp_path / "out"), "--out", str(tmp_path / "again")]) == 2
    assert "expected .npz files as `splatgraft synth lights` writes, found none" in capsys.readouterr().err


def test_shares_are_the_slopes_of_the_true_ratios_on_the_found_ones():
    generator = torch.Generator().manual_seed(0)
    stops, tints = torch.randn(60, 1, 1, 1, generator=generator), 0.3 * torch.randn(60, 1, 1, 1, generator=generator)
    warm = torch.tensor([1.0, 0.0, -1.0])
    found = (stops + tints * warm).expand(60, 12, 24, 3)
    truth = (2 + 0.5 * stops + 0.25 * tints * warm).expand(60, 12, 24, 3)
    shares = ratio_shares(found, truth, places(30))
    assert shares.level == pytest.approx(0.5, abs=0.03)
    assert shares.tint == pytest.approx(0.25, abs=0.03)
    opposite = ratio_shares(-found, truth, places(30))
    assert (opposite.level, opposite.tint) == (0.0, 0.0)


def test_lights_of_one_place_count_as_one_place_for_the_shares():
    examples = places(2, lights=4)
    levels = torch.tensor([0.0, 1.0] * 2 + [0.0, 3.0] * 2)
    truth = torch.tensor([0.0, 1.0] * 2 + [0.0, 0.0] * 2)
    one = [values[:, None, None, None].expand(8, 12, 24, 3) for values in (levels, truth)]
    alone = ratio_shares(one[0][[0, 1, 4, 5]], one[1][[0, 1, 4, 5]], [examples[i] for i in (0, 1, 4, 5)])
    assert ratio_shares(*one, examples).level == pytest.approx(alone.level, abs=1e-5)
