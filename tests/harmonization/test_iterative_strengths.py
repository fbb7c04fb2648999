"""Iterative updates with FLUX: what reaches the network at each noise level of both schedules (paper, ablations)."""

from dataclasses import replace

import pytest
import torch

pytest.importorskip("diffusers")

from tiny_models import CHANNELS, flux_folder, quiet, tiny_autoencoder

from splatgraft.consolidation import geometric_schedule, linear_schedule
from splatgraft.harmonization import (
    FluxOptions,
    HarmonizerContext,
    HarmonizerInputs,
    NoisyStartHarmonizer,
    make_harmonizer,
)
from splatgraft.harmonization.flux.network import Autoencoder, velocity
from splatgraft.harmonization.flux.sampling import noise, schnell_levels

pytestmark = list(quiet)


def view(h=32, w=48):
    g = torch.Generator().manual_seed(0)
    composite, prior, background = (torch.rand(h, w, 3, generator=g) for _ in range(3))
    mask = torch.zeros(h, w)
    mask[8:16, 12:24] = 1
    flat = torch.zeros(h, w, 3)
    return HarmonizerInputs(composite, background, mask, torch.ones(h, w), flat, prior)


@pytest.fixture
def folder(tmp_path):
    return flux_folder(tmp_path / "image-mask", CHANNELS * 12)


def loaded(folder, strengths, **other):
    return make_harmonizer(FluxOptions(weights=str(folder), **other), HarmonizerContext(strengths=strengths))


@pytest.mark.parametrize("schedule", [linear_schedule, geometric_schedule])
def test_each_level_of_a_schedule_reaches_the_network_with_the_noise_that_belongs_to_it(folder, monkeypatch, schedule):
    strengths, seen = schedule(), []
    harmonizer = loaded(folder, strengths)
    assert isinstance(harmonizer, NoisyStartHarmonizer)

    def watched(transformer, latents, level, prompt):
        seen.append((latents.clone(), float(level[0]), int(transformer.time_text_embed(level * 1000, None)[0])))
        return velocity(transformer, latents, level, prompt)

    monkeypatch.setattr("splatgraft.harmonization.flux.harmonizer.velocity", watched)
    shown, encoder = view(), Autoencoder(tiny_autoencoder())
    prior, composite = (encoder.encode(image.permute(2, 0, 1)[None]) for image in (shown.prior, shown.composite))
    eps = noise(tuple(prior.shape[1:]), 0)[None]
    for strength in strengths:
        seen.clear()
        harmonizer.harmonize_from([shown], strength)
        # the paper's t: z_t = (1 - t) z_0 + t eps, in float32
        wanted = (1 - strength) * prior + strength * eps
        assert torch.allclose(seen[0][0][:, :CHANNELS], wanted, atol=1e-5)
        assert [level for _, level, _ in seen] == pytest.approx([strength * (1 - i / 4) for i in range(4)])
        table = harmonizer.network.transformer.time_text_embed.levels / 1000
        for latents, level, row in seen:
            # the composite is the condition at every level, and the level's own row of the table is used
            assert torch.allclose(latents[:, CHANNELS : 2 * CHANNELS], composite, atol=1e-5)
            assert float(table[row]) == pytest.approx(level)


def test_all_noise_is_the_ordinary_harmonisation_and_does_not_see_the_prior(folder):
    harmonizer, shown = loaded(folder, linear_schedule()), view()
    whole = harmonizer.harmonize_from([shown], 1.0)[0].image
    assert torch.equal(whole, loaded(folder, (1.0,)).harmonize(shown).image)
    other = replace(shown, prior=1 - shown.prior)
    assert torch.equal(harmonizer.harmonize_from([other], 1.0)[0].image, whole)
    assert not torch.equal(
        harmonizer.harmonize_from([other], 0.1)[0].image, harmonizer.harmonize_from([shown], 0.1)[0].image
    )


def test_a_level_that_was_not_prepared_is_one_line(folder):
    with pytest.raises(ValueError, match=r"harmonizer flux: expected to start at a noise level of 1, found 0\.5"):
        loaded(folder, (1.0,)).harmonize_from([view()], 0.5)
    with pytest.raises(ValueError, match=r"strength: expected a noise level above 0 and at most 1, found 0\.0"):
        schnell_levels(4, start=0.0)


@pytest.mark.long
def test_the_benchmark_s_updates_hand_each_strength_of_their_schedule_to_the_network(folder, tmp_path, monkeypatch):
    from splatgraft.core.cameras import Cameras
    from splatgraft.core.gaussians import Gaussians
    from splatgraft.formats import write_cameras, write_gaussians
    from splatgraft.formats.gaussian_flags import write_flags
    from splatgraft.project.step import perform
    from splatgraft.runtime.console import Console
    from splatgraft_paper.benchmark.methods import UpdateIteratively

    g = torch.Generator().manual_seed(0)
    n = 40
    scene = Gaussians(
        means=torch.rand(n, 3, generator=g) - 0.5 + torch.tensor([0.0, 0, 3]),
        log_scales=torch.full((n, 3), -2.0),
        quaternions=torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        opacity_logits=torch.full((n,), 2.0),
        sh=torch.rand(n, 1, 3, generator=g),
    )
    (tmp_path / "composite").mkdir()
    write_gaussians(tmp_path / "composite" / "scene.ply", scene)
    write_flags(tmp_path / "composite" / "is_object.npy", torch.arange(n) < 20)
    cameras = Cameras(
        world_from_camera=torch.eye(4).repeat(2, 1, 1),
        intrinsics=torch.tensor([[30.0, 0, 16], [0, 30, 16], [0, 0, 1]]).repeat(2, 1, 1),
        sizes=torch.tensor([[32, 32], [32, 32]]),
        names=("images/a.png", "images/b.png"),
    )
    write_cameras(tmp_path / "cameras.json", cameras)
    levels = []

    def watched(transformer, latents, level, prompt):
        levels.append(float(level[0]))
        return velocity(transformer, latents, level, prompt)

    monkeypatch.setattr("splatgraft.harmonization.flux.harmonizer.velocity", watched)
    step = UpdateIteratively(
        tmp_path / "composite", tmp_path / "composite" / "scene.ply", tmp_path / "cameras.json", tmp_path / "result",
        harmonizer="flux", loss="l1-dssim", schedule="geometric", model=str(folder), device="cpu",
    )  # fmt: skip
    perform(step, Console())
    # two views of four steps each, per update
    assert levels[::4] == pytest.approx([strength for strength in geometric_schedule() for _ in range(2)])
    assert (tmp_path / "result" / "scene.ply").is_file()
