"""The parts of the recipe `tiny`: pairs in closed form, and a base model of the real classes that FLUX's code loads."""

import numpy as np
import pytest
import torch

pytest.importorskip("diffusers")

from tiny_models import quiet

from splatgraft.harmonization.flux.weights.folder import FluxFolder
from splatgraft_paper.synthesis.spheres import render_spheres
from splatgraft_paper.training.flux_objective import FluxObjective, FluxTraining
from splatgraft_paper.training.tiny_base import TinyBaseOptions, write_tiny_base

pytestmark = [*quiet, pytest.mark.filterwarnings("ignore::UserWarning")]


def test_spheres_differ_by_the_object_and_what_it_does_to_the_light():
    shown = render_spheres(3, width=64, height=48, lights=2)
    assert np.array_equal(shown.target, render_spheres(3, width=64, height=48, lights=2).target)
    soft = (shown.mask > 0) & (shown.mask < 1)
    assert 20 < soft.sum() < 200
    changed = np.abs(shown.target - shown.background).max(-1)
    assert changed[shown.mask == 1].mean() > 0.05
    # a shadow only darkens, and most of the picture has none
    outside = shown.mask == 0
    assert (shown.target[outside] <= shown.background[outside] + 1e-12).all()
    assert 0.005 < (changed[outside] > 0.02).mean() < 0.3
    assert all(np.abs(relit - shown.target).mean() > 0.01 for relit in shown.relit)


def test_the_tiny_base_is_flux_of_three_million_weights(tmp_path):
    pictures = []
    for seed in range(3):
        shown = render_spheres(seed, width=64, height=48, lights=1)
        pictures += [torch.from_numpy(picture).float().permute(2, 0, 1) for picture in (shown.target, shown.background)]
    said, errors = [], []

    def progress(done, total, words):
        errors.append(float(words.rpartition(" ")[2]))

    options = TinyBaseOptions(autoencoder_steps=40, batch=4)
    write_tiny_base(tmp_path / "base", pictures, options, say=said.append, progress=progress)
    assert errors[-1] < errors[0] / 2
    assert FluxFolder.open(tmp_path / "base").inputs == 1
    objective = FluxObjective(FluxTraining(str(tmp_path / "base")), lambda words: None)
    count = sum(p.numel() for p in objective.network.parameters())
    assert 2.5e6 < count < 4.5e6
    latents = objective.encode(torch.stack(pictures))
    assert latents.shape == (6, 16, 12, 16)
    # the shift and scale are those of these very pictures
    assert abs(float(latents.mean())) < 0.01
    assert abs(float(latents.std()) - 1) < 0.01
    with torch.no_grad():
        loss = objective.loss(objective.network, dict.fromkeys(objective.roles, latents), range(6))
    assert bool(loss.isfinite())


def test_the_tiny_autoencoder_learns_colours(tmp_path):
    """With the rate of Adam four times as high it shows every picture gray: 96% of the variance is left, now 22%."""
    colors = torch.rand(64, 3, generator=torch.Generator().manual_seed(0))
    pictures = list(colors[:, :, None, None].expand(-1, -1, 16, 16))
    errors = []

    def progress(done, total, words):
        errors.append(float(words.rpartition(" ")[2]))

    options = TinyBaseOptions(autoencoder_steps=200)
    write_tiny_base(tmp_path / "base", pictures, options, say=lambda words: None, progress=progress)
    assert errors[-1] < 0.4 * float((colors * 2).var(0).mean())
