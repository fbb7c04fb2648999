"""The recipe `tiny`: its pairs in closed form, its base model of the real classes, and the whole way to a view."""

from dataclasses import replace

import pytest
import torch

pytest.importorskip("diffusers")

from tiny_models import quiet
from tiny_training import silent

from splatgraft.cli import main
from splatgraft.core.image_metrics import psnr
from splatgraft.harmonization import FluxOptions, HarmonizerContext, make_harmonizer
from splatgraft.harmonization.flux.loading import FluxFolder
from splatgraft.harmonization.interface import HarmonizerInputs
from splatgraft_paper.training.flux import FluxObjective, FluxTrainingOptions
from splatgraft_paper.training.pairs import open_relit
from splatgraft_paper.training.spheres import render_spheres
from splatgraft_paper.training.tiny_base import TinyBaseOptions, write_tiny_base

pytestmark = [*quiet, pytest.mark.filterwarnings("ignore::UserWarning")]


def test_spheres_differ_by_the_object_and_what_it_does_to_the_light():
    shown = render_spheres(3, width=64, height=48, lights=2)
    assert torch.equal(shown.target, render_spheres(3, width=64, height=48, lights=2).target)
    soft = (shown.mask > 0) & (shown.mask < 1)
    assert 20 < soft.sum() < 200
    changed = (shown.target - shown.background).abs().amax(-1)
    assert changed[shown.mask == 1].mean() > 0.05
    # a shadow only darkens, and the larger part of the picture has no shadow
    outside = shown.mask == 0
    assert (shown.target[outside] <= shown.background[outside] + 1e-6).all()  # float32
    assert 0.005 < (changed[outside] > 0.02).float().mean() < 0.3
    assert all((relit - shown.target).abs().mean() > 0.01 for relit in shown.relit)


def test_the_tiny_base_is_flux_of_three_million_weights(tmp_path):
    pictures = []
    for seed in range(3):
        shown = render_spheres(seed, width=64, height=48, lights=1)
        pictures += [picture.permute(2, 0, 1) for picture in (shown.target, shown.background)]
    said, errors = [], []

    def progress(done, total, words):
        errors.append(float(words.rpartition(" ")[2]))

    options = TinyBaseOptions(autoencoder_steps=40, batch=4)
    write_tiny_base(tmp_path / "base", pictures, options, say=said.append, progress=progress)
    assert errors[-1] < errors[0] / 2
    assert not FluxFolder.open(tmp_path / "base").is_harmonizer
    objective = FluxObjective(tmp_path / "base", FluxTrainingOptions(), lambda words: None)
    count = sum(p.numel() for p in objective.network.parameters())
    assert 2.5e6 < count < 4.5e6
    latents = objective.autoencoder.encode(torch.stack(pictures))
    assert latents.shape == (6, 16, 12, 16)
    # shift and scale are computed from these pictures
    assert abs(float(latents.mean())) < 0.01
    assert abs(float(latents.std()) - 1) < 0.01
    with torch.no_grad():
        loss = objective.loss(objective.network, dict.fromkeys(objective.roles, latents), range(6))
    assert bool(loss.isfinite())


@pytest.mark.long
def test_the_tiny_autoencoder_learns_colours(tmp_path):
    """Colours are reproduced: 22% of the variance is left. At four times the rate of Adam all are gray, 96%."""
    colors = torch.rand(64, 3, generator=torch.Generator().manual_seed(0))
    pictures = list(colors[:, :, None, None].expand(-1, -1, 16, 16))
    errors = []

    def progress(done, total, words):
        errors.append(float(words.rpartition(" ")[2]))

    options = TinyBaseOptions(autoencoder_steps=200)
    write_tiny_base(tmp_path / "base", pictures, options, say=lambda words: None, progress=progress)
    assert errors[-1] < 0.4 * float((colors * 2).var(0).mean())


BASE = TinyBaseOptions(heads=3, double_blocks=1, single_blocks=2, autoencoder_widths=(32, 32), autoencoder_steps=3000)
LOOP = ["--size", "32x32", "--steps", "2000", "--rate", "2e-3", "--ema", "0.99", "--validate-every", "1000"]


def pairs(folder, scenes, seed):
    words = ["--scenes", str(scenes), "--size", "32x32", "--seed", str(seed)]
    assert main(["paper", "synth", "spheres", str(folder), *words]) == 0
    return open_relit(folder).pairs


def harmonised(folder, training, base, loop):
    """Return a harmoniser that the recipe trained on pairs."""
    pictures = []
    for files in training[::3]:
        pair = files.read()
        pictures += [pair.picture(role).permute(2, 0, 1) for role in ("target", "composite", "mask")]
    write_tiny_base(folder / "base", pictures, base, say=silent, progress=silent)
    words = ["--recipe", "tiny", "--base", str(folder / "base"), "--generated", str(folder / "pairs"), *loop]
    assert main(["paper", "train", "flux", str(folder / "out"), *words]) == 0
    options = FluxOptions(weights=str(folder / "out" / "model"), precision="float32")
    return make_harmonizer(options, HarmonizerContext())


def view_of(pair):
    return HarmonizerInputs(pair.composite, pair.background, pair.mask, torch.zeros_like(pair.mask), pair.composite)


def test_the_road_from_pairs_to_a_harmonised_view_is_whole(tmp_path):
    training = pairs(tmp_path / "pairs", 8, 0)
    base = replace(BASE, autoencoder_steps=5)
    harmonizer = harmonised(tmp_path, training, base, ["--size", "32x32", "--steps", "2", "--validation-pairs", "2"])
    image = harmonizer.harmonize(view_of(training[0].read()))
    assert image.shape == (32, 32, 3)
    assert bool(image.isfinite().all())


@pytest.mark.long
def test_the_trained_harmoniser_brings_unseen_scenes_nearer_to_the_truth(tmp_path):
    """The recipe at a quarter of its pixels, with a base model of 1.1 million weights: minutes of one core."""
    harmonizer = harmonised(tmp_path, pairs(tmp_path / "pairs", 300, 0), BASE, LOOP)
    gains = []
    for files in pairs(tmp_path / "unseen", 16, 1)[::3]:
        pair = files.read()
        result = harmonizer.harmonize(view_of(pair))
        # composite and truth differ by the object's light and its shadow
        wrong = (pair.composite - pair.target).abs().amax(-1) > 0.05
        regions = (None, pair.mask > 0.5, wrong)
        gains.append(
            [float(psnr(result, pair.target, part) - psnr(pair.composite, pair.target, part)) for part in regions]
        )
    whole, inside, wrong = torch.tensor(gains).mean(0).tolist()
    print(f"gain: whole picture {whole:.2f} dB, object {inside:.2f} dB, where the composite is wrong {wrong:.2f} dB")
    # the run that this was written with: +2.1, +1.7 and +5.5 dB (the recipe itself +4.1, +2.4 and +7.9); an untrained
    # model is worse than its input, and one that copies it gains nothing
    assert whole > 1
    assert inside > 0.3
    assert wrong > 3
