"""Training overfits, its model loads unchanged, a killed run resumes bit for bit, and errors are one line."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch.distributed.checkpoint import FileSystemReader

pytest.importorskip("diffusers")

from tiny_models import CHANNELS, quiet, removal_folder
from tiny_pairs import rendered_folder
from tiny_training import QUICK, silent, training

from splatgraft.core.images import read_rgb
from splatgraft.harmonization import FluxOptions, HarmonizerInputs, make_harmonizer
from splatgraft.harmonization.flux.weights.tensor_file import write_tensors
from splatgraft_paper.training.flux_objective import FluxObjective, FluxTraining
from splatgraft_paper.training.latent_cache import LatentCache
from splatgraft_paper.training.removal_objective import RemovalObjective
from splatgraft_paper.training.sources.pair_source import crop_pair_to_size, split_mixture
from splatgraft_paper.training.sources.relit_pairs import RelitPairs
from splatgraft_paper.training.sources.rendered_pairs import RenderedPairs
from splatgraft_paper.training.trainer import TrainingRun, train
from splatgraft_paper.training.training_log import LOG_FILE, read_losses

pytestmark = [*quiet, pytest.mark.filterwarnings("ignore::UserWarning")]
ROLES = RemovalObjective.roles


def killed_at(step):
    def progress(done, total, message):
        if done == step:
            raise KeyboardInterrupt

    return progress


def inputs(sample):
    composite, mask = sample.composite, (sample.mask > 0.5).float()
    flat = torch.zeros_like(mask)
    return HarmonizerInputs(composite, sample.background, mask, flat, torch.zeros_like(composite), composite)


def one_shipped_pair(tmp_path):
    """The first of the rendered pairs that ship with the repository."""
    shipped, folder = Path(__file__).parents[2] / "data" / "pairs", tmp_path / "shipped"
    folder.mkdir()
    line = (shipped / "manifest.jsonl").read_text().splitlines()[0]
    (folder / "manifest.jsonl").write_text(line + "\n")
    (folder / json.loads(line)["folder"]).symlink_to(shipped / json.loads(line)["folder"])
    return folder


def test_it_overfits_and_is_loaded_as_it_was(tmp_path):
    loop = replace(QUICK, steps=250, batch=8, rate=3e-3, save_every=1000, validate_every=1000)
    run = training(tmp_path, "out", loop, pairs=1, times="schnell", checkpointing=False)
    mixture, _ = split_mixture([RenderedPairs(one_shipped_pair(tmp_path))], weights=(), held_out=0.0, seed=0)
    run = replace(run, mixture=mixture, held_out=None)
    model = train(run)
    losses = torch.tensor(read_losses(tmp_path / "out" / LOG_FILE))
    assert losses[-20:].mean() < losses[:5].mean() / 10
    sample = run.mixture.draw(0)
    loaded = run.cache.load(sample, run.objective.roles)
    shown = run.objective.predict(
        run.objective.network.eval(), run.cache.encode_missing([loaded], run.objective.roles), 3
    )
    harmonizer = make_harmonizer(FluxOptions(weights=str(model), seed=3))
    image = harmonizer.harmonize(inputs(crop_pair_to_size(sample.source.read(sample.index), 32, 32))).image
    # kept latents are rounded to bfloat16 (2^-9 of values of about one), fresh ones are not
    assert (image - shown[0].permute(1, 2, 0)).abs().max() < 0.02
    stored = json.loads((model / "transformer" / "config.json").read_text())
    assert stored["in_channels"] == CHANNELS * 12
    assert json.loads((model / "harmonizer.json").read_text())["variant"] == "image-mask"


@pytest.mark.parametrize("options", [{}, {"lora": 2}], ids=["all weights", "lora"])
def test_a_killed_training_goes_on_to_the_same_curve_and_weights(tmp_path, options):
    loop = replace(QUICK, ema=0.5, accumulate=2, warm_up=3)
    model = train(training(tmp_path, "whole", loop, **options))
    with pytest.raises(KeyboardInterrupt):
        train(training(tmp_path, "killed", loop, progress=killed_at(5), **options))
    said = []
    again = train(training(tmp_path, "killed", loop, say=said.append, **options))
    assert "resumed from step 4" in said
    assert read_losses(tmp_path / "killed" / LOG_FILE) == read_losses(tmp_path / "whole" / LOG_FILE)
    name = "lora.safetensors" if options else "transformer/diffusion_pytorch_model.safetensors"
    assert (model / name).read_bytes() == (again / name).read_bytes()
    assert sorted(p.name for p in (tmp_path / "killed" / "states").iterdir()) == ["00000004", "00000006"]
    if options:
        saved = FileSystemReader(tmp_path / "killed" / "states" / "00000006").read_metadata().state_dict_metadata
        assert saved
        assert all("lora_" in name or "x_embedder" in name or "param_groups" in name for name in saved)


def test_a_trained_adaptation_changes_what_the_base_makes(tmp_path):
    model = train(training(tmp_path, "out", replace(QUICK, rate=0.05), lora=2))
    options = FluxOptions(weights=str(tmp_path / "base"), lora=model / "lora.safetensors")
    pair = RelitPairs(tmp_path / "pairs").read(0)
    image = make_harmonizer(options).harmonize(inputs(pair)).image
    assert image.shape == pair.target.shape
    assert json.loads((model / "harmonizer.json").read_text())["variant"] == "image-mask"


def test_the_other_condition_is_trained_and_told(tmp_path):
    run = training(tmp_path, "out", condition="image-background", times="logit-normal", first_layer="zero")
    assert run.objective.roles == ("target", "composite", "background")
    harmonizer = make_harmonizer(FluxOptions(weights=str(train(run))))
    assert harmonizer.network.variant == "image-background"
    with pytest.raises(ValueError, match=r"model: expected image-mask .--variant., found image-background"):
        FluxObjective(FluxTraining(str(tmp_path / "out" / "model")), silent)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_on_cuda_in_bf16_losses_are_about_those_of_the_cpu(tmp_path):
    train(training(tmp_path, "cpu"))
    train(training(tmp_path, "cuda", replace(QUICK, cpu=False, precision="bf16")))
    cpu, cuda = (torch.tensor(read_losses(tmp_path / name / LOG_FILE)) for name in ("cpu", "cuda"))
    # 8 bits of mantissa: percents
    assert torch.allclose(cpu, cuda, rtol=0.05)


def test_the_order_does_not_depend_on_the_number_of_passes(tmp_path):
    losses = []
    for passes in (1, 2):
        train(training(tmp_path, f"passes{passes}", replace(QUICK, accumulate=passes, steps=2)))
        losses.append(torch.tensor(read_losses(tmp_path / f"passes{passes}" / LOG_FILE)))
    # the same pairs and the same noise: only sums are rounded in another order
    assert torch.allclose(*losses, rtol=1e-4)


def test_kept_latents_are_the_fresh_ones_and_a_changed_picture_is_encoded_anew(tmp_path):
    run = training(tmp_path, "out")
    drawn, roles = run.mixture.draw(0), run.objective.roles
    fresh = run.cache.encode_missing([run.cache.load(drawn, roles)], roles)
    loaded = run.cache.load(drawn, roles)
    assert not loaded.pictures
    kept = run.cache.encode_missing([loaded], roles)
    assert all(torch.equal(fresh[role], kept[role]) for role in roles)
    target = next((tmp_path / "pairs").glob("*/target.png"))
    for path in (tmp_path / "pairs").glob("*/target.png"):
        path.write_bytes(target.read_bytes() + b" ")
    assert set(run.cache.load(drawn, roles).pictures) == {"target"}


def test_validation_shows_held_out_pairs(tmp_path):
    said = []
    run = training(tmp_path, "out", say=said.append)
    train(run)
    assert any("(held out)" in line for line in said)
    sheet = read_rgb(tmp_path / "out" / "validation" / "00000003.png")
    assert sheet.shape == (2 * 32, 3 * 32, 3)
    trained = {run.mixture.sources[0].group(i) for i in run.mixture.indices[0]}
    shown = {run.held_out.sources[0].group(i) for i in run.held_out.indices[0]}
    assert not trained & shown


def test_another_training_in_the_folder_is_refused(tmp_path):
    train(training(tmp_path, "out"))
    with pytest.raises(
        ValueError, match=r"out: expected the same training to go on with, found rate 0.001 instead of 0.5"
    ):
        train(training(tmp_path, "out", replace(QUICK, rate=0.5, steps=8)))


def test_a_loss_that_is_no_number_stops_and_keeps_the_last_state(tmp_path):
    run = training(tmp_path, "out", replace(QUICK, save_every=1))

    def poison(done, total, message):
        if done == 2:
            with torch.no_grad():
                run.objective.network.proj_out.bias.fill_(float("nan"))

    # the poison comes after step 2's weights were reported and before they are saved
    line = "expected finite weights after step 2, found others; the state of step 1 is kept"
    with pytest.raises(ValueError, match=line):
        train(replace(run, progress=poison))
    assert {p.name for p in (tmp_path / "out" / "states").iterdir()} == {"00000001"}


def test_a_pair_whose_loss_is_no_number_is_named_and_the_step_before_is_kept(tmp_path):
    run = training(tmp_path, "out", replace(QUICK, batch=2, save_every=99, validate_every=99, steps=9), pairs=6)
    step, bad = next(
        (position // 2, run.mixture.draw(position))
        for position in range(2, 18)
        if all(
            run.mixture.draw(earlier).index != run.mixture.draw(position).index for earlier in range(position // 2 * 2)
        )
    )
    loaded = run.cache.load(bad, run.objective.roles)
    latents = run.cache.encode_missing([loaded], run.objective.roles)["composite"][0]
    write_tensors(loaded.paths["composite"], {"latents": latents.fill_(float("nan")).to(torch.bfloat16)})
    name = bad.source.location(bad.index)
    line = (
        f"training: expected a finite loss at step {step + 1}, found nan for {name}; the state of step {step} is kept"
    )
    with pytest.raises(ValueError, match=re.escape(line)):
        train(run)
    assert {p.name for p in (tmp_path / "out" / "states").iterdir()} == {f"{step:08d}"}
    whole = train(replace(training(tmp_path, "whole", replace(run.loop, steps=step), pairs=6), mixture=run.mixture))
    # the state that is kept is that of the last good step, to the bit
    loaded.paths["composite"].unlink()
    kept = train(replace(training(tmp_path, "out", replace(run.loop, steps=step), pairs=6), mixture=run.mixture))
    name = "transformer/diffusion_pytorch_model.safetensors"
    assert (kept / name).read_bytes() == (whole / name).read_bytes()


def test_a_picture_that_vanished_is_one_line_and_the_steps_before_are_kept(tmp_path):
    run = training(tmp_path, "out", replace(QUICK, save_every=99, validate_every=99, steps=50), pairs=3)

    def remove(done, total, message):
        if done == 3:
            for path in (tmp_path / "pairs").glob("*/relit_0.png"):
                path.unlink()

    with pytest.raises(ValueError, match=r"relit_0.png: expected a picture of a pair, found No such file"):
        train(replace(run, progress=remove))
    (state,) = (tmp_path / "out" / "states").iterdir()
    assert int(state.name) >= 3


def test_a_damaged_state_is_said_and_the_one_before_it_is_taken(tmp_path):
    model = train(training(tmp_path, "out"))
    before = (model / "transformer/diffusion_pytorch_model.safetensors").read_bytes()
    file = tmp_path / "out" / "states" / "00000006" / "__0_0.distcp"
    file.write_bytes(file.read_bytes()[:1000])
    said = []
    assert train(training(tmp_path, "out", say=said.append)) == model
    assert (model / "transformer/diffusion_pytorch_model.safetensors").read_bytes() == before
    assert "00000006: expected a whole state, found" in said[0]
    assert "resumed from step 4" in said
    with pytest.raises(ValueError, match=r"out: expected no states \(--resume never\), found .*00000006"):
        train(training(tmp_path, "out", replace(QUICK, resume="never")))


def test_too_little_memory_is_one_line(tmp_path, monkeypatch):
    run = training(tmp_path, "out")

    def full(*arguments, **named):
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(run.objective, "loss", full)
    with pytest.raises(ValueError, match="expected memory for 2 pairs a pass, found too little at step 0"):
        train(run)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"batch": 3, "accumulate": 2}, r"--batch: expected a multiple of 2 \(1 processes x --accumulate 2\), found 3"),
        ({"ema": 1.0}, "--ema: expected a decay from 0 to below 1, found 1.0"),
        ({"steps": 0}, "--steps: expected at least 1, found 0"),
        ({"optimizer": "adam8bit"}, "--optimizer adam8bit: expected bitsandbytes"),
        ({"tensorboard": True}, "--tensorboard: expected the package tensorboard"),
    ],
)
def test_bad_options_are_one_line(tmp_path, change, line):
    with pytest.raises(ValueError, match=line):
        train(training(tmp_path, "out", replace(QUICK, **change)))


def test_object_removal_is_trained_by_the_same_loop(tmp_path):
    base = removal_folder(tmp_path / "base")
    loop = replace(QUICK, steps=20, batch=4, rate=8e-3, save_every=18, validate_every=99, validation_pairs=1)
    source = RenderedPairs(rendered_folder(tmp_path / "pairs", 1))

    def run(name, folder, loop, progress=silent):
        objective = RemovalObjective(str(folder), silent, checkpointing=False)
        mixture, held_out = split_mixture([source], weights=(), held_out=0.0, seed=0)
        cache = LatentCache(tmp_path / "latents", objective.encode, width=32, height=32, autoencoder="tiny")
        return TrainingRun(objective, mixture, held_out, cache, loop, tmp_path / name, silent, progress)

    def error(folder):
        again, seeds = run("out", folder, loop), range(16)
        latents = again.cache.encode_missing(
            [again.cache.load(again.mixture.draw(0), again.objective.roles)] * 16, ROLES
        )
        with torch.no_grad():
            return float(again.objective.loss(again.objective.network.eval(), latents, seeds))

    model = train(run("out", base, loop))
    assert error(model) < 0.7 * error(base)
    with pytest.raises(KeyboardInterrupt):
        train(run("killed", base, loop, killed_at(19)))
    train(run("killed", base, loop))
    assert read_losses(tmp_path / "killed" / LOG_FILE) == read_losses(tmp_path / "out" / LOG_FILE)
    trained, again = RemovalObjective(str(model), silent), run("out", base, loop)
    assert trained.network.config.in_channels == CHANNELS * 3
    pair = again.cache.load(again.mixture.draw(0), trained.roles)
    latents = again.cache.encode_missing([pair], trained.roles)
    with torch.no_grad():
        image = trained.predict(trained.network.eval(), latents, 0)
    assert image.shape == (1, 3, 32, 32)
    assert bool(image.isfinite().all())
