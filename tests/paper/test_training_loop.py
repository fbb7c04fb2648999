"""Training overfits, its model loads unchanged, a killed run resumes bit for bit, and errors are one line."""

import gc
import json
import re
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch.distributed.checkpoint import FileSystemReader

pytest.importorskip("diffusers")

from tiny_models import CHANNELS, quiet, removal_folder
from tiny_pairs import rendered_folder
from tiny_training import QUICK, measured_by, read_losses, run_of, silent, training

from splatgraft.core.images import read_rgb
from splatgraft.harmonization import FluxOptions, HarmonizerInputs, make_harmonizer
from splatgraft.harmonization.flux.tensor_file import write_tensors
from splatgraft_paper.training.flux import FluxObjective, FluxTrainingOptions
from splatgraft_paper.training.loop import LOG_FILE, list_states
from splatgraft_paper.training.pairs import crop_pair_to_size, open_rendered
from splatgraft_paper.training.removal import RemovalObjective

pytestmark = [*quiet, pytest.mark.filterwarnings("ignore::UserWarning")]
WEIGHTS = "transformer/diffusion_pytorch_model.safetensors"


def killed_at(step):
    def progress(done, total, message):
        if done == step:
            raise KeyboardInterrupt

    return progress


def inputs(sample):
    composite, mask = sample.composite, (sample.mask > 0.5).float()
    flat = torch.zeros_like(mask)
    return HarmonizerInputs(composite, sample.background, mask, flat, composite)


def one_shipped_pair(tmp_path):
    """Return the first of the rendered pairs that ship with the repository."""
    shipped, folder = Path(__file__).parents[2] / "data" / "pairs", tmp_path / "shipped"
    folder.mkdir()
    line = (shipped / "manifest.jsonl").read_text().splitlines()[0]
    (folder / "manifest.jsonl").write_text(line + "\n")
    (folder / json.loads(line)["folder"]).symlink_to(shipped / json.loads(line)["folder"])
    return open_rendered(folder)


@pytest.mark.long
def test_it_overfits(tmp_path):
    loop = replace(QUICK, steps=250, batch=8, rate=3e-3, save_every=1000, validate_every=1000)
    pair = one_shipped_pair(tmp_path)
    training(tmp_path, "out", loop, folders=[pair], pairs=1, times="schnell", no_checkpointing=True).train()
    losses = torch.tensor(read_losses(tmp_path / "out" / LOG_FILE))
    assert losses[-20:].mean() < losses[:5].mean() / 10


def test_a_trained_model_is_loaded_as_it_was(tmp_path):
    loop = replace(QUICK, steps=8, rate=3e-3, save_every=1000, validate_every=1000)
    pair = one_shipped_pair(tmp_path)
    run = training(tmp_path, "out", loop, folders=[pair], pairs=1)
    model = run.train()
    objective, files = run.task.objective, pair.pairs[0]
    latents = run.cache.encode_missing([run.cache.load(files, objective.roles)], objective.roles)
    shown = objective.predict(objective.network.eval(), latents, 3)
    harmonizer = make_harmonizer(FluxOptions(weights=str(model), seed=3))
    image = harmonizer.harmonize(inputs(crop_pair_to_size(files.read(), 32, 32)))
    # kept latents are rounded to bfloat16 (2^-9 of values of about one), fresh ones are not
    assert (image - shown[0].permute(1, 2, 0)).abs().max() < 0.02
    stored = json.loads((model / "transformer" / "config.json").read_text())
    assert stored["in_channels"] == CHANNELS * 12
    assert json.loads((model / "harmonizer.json").read_text())["variant"] == "image-mask"


@pytest.mark.parametrize("options", [{}, {"lora": 2}], ids=["all weights", "lora"])
def test_a_killed_training_goes_on_to_the_same_curve_and_weights(tmp_path, options):
    loop = replace(QUICK, ema=0.5, accumulate=2, warm_up=3)
    model = training(tmp_path, "whole", loop, **options).train()
    with pytest.raises(KeyboardInterrupt):
        training(tmp_path, "killed", loop, progress=killed_at(5), **options).train()
    said = []
    again = training(tmp_path, "killed", loop, say=said.append, **options).train()
    assert "resumed from step 4" in said
    assert read_losses(tmp_path / "killed" / LOG_FILE) == read_losses(tmp_path / "whole" / LOG_FILE)
    name = "lora.safetensors" if options else WEIGHTS
    assert (model / name).read_bytes() == (again / name).read_bytes()
    assert sorted(p.name for p in (tmp_path / "killed" / "states").iterdir()) == ["00000004", "00000006"]
    if options:
        saved = FileSystemReader(tmp_path / "killed" / "states" / "00000006").read_metadata().state_dict_metadata
        assert saved
        assert all("lora_" in name or "x_embedder" in name or "param_groups" in name for name in saved)
        # the folder says which harmoniser it makes of the base
        assert json.loads((model / "harmonizer.json").read_text())["variant"] == "image-mask"
        make_harmonizer(FluxOptions(weights=str(tmp_path / "base"), lora=model / name))


def test_the_other_condition_is_trained_and_told(tmp_path):
    run = training(tmp_path, "out", condition="image-background")
    assert run.task.objective.roles == ("target", "composite", "background")
    harmonizer = make_harmonizer(FluxOptions(weights=str(run.train())))
    assert harmonizer.network.variant == "image-background"
    with pytest.raises(ValueError, match=r"model: expected image-mask .--variant., found image-background"):
        FluxObjective(tmp_path / "out" / "model", FluxTrainingOptions(), silent)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_on_cuda_in_bf16_losses_are_about_those_of_the_cpu(tmp_path):
    training(tmp_path, "cpu").train()
    training(tmp_path, "cuda", replace(QUICK, cpu=False, precision="bf16")).train()
    cpu, cuda = (torch.tensor(read_losses(tmp_path / name / LOG_FILE)) for name in ("cpu", "cuda"))
    # 8 bits of mantissa: percents
    assert torch.allclose(cpu, cuda, rtol=0.05)


def test_the_order_does_not_depend_on_the_number_of_passes_or_threads(tmp_path):
    losses = []
    for passes, readers in ((1, 1), (2, 3)):
        training(tmp_path, f"passes{passes}", replace(QUICK, accumulate=passes, readers=readers, steps=2)).train()
        losses.append(torch.tensor(read_losses(tmp_path / f"passes{passes}" / LOG_FILE)))
    # the same pairs and the same noise: only sums are rounded in another order
    assert torch.allclose(*losses, rtol=1e-4)


def test_kept_latents_are_the_fresh_ones_and_a_changed_picture_is_encoded_anew(tmp_path):
    run = training(tmp_path, "out")
    drawn, roles = run.task.data.mixture.draw(0), run.task.objective.roles
    fresh = run.cache.encode_missing([run.cache.load(drawn, roles)], roles)
    loaded = run.cache.load(drawn, roles)
    assert not loaded.pictures
    kept = run.cache.encode_missing([loaded], roles)
    assert all(torch.equal(fresh[role], kept[role]) for role in roles)
    target = next((tmp_path / "pairs").glob("*/target.png"))
    for path in (tmp_path / "pairs").glob("*/target.png"):
        path.write_bytes(target.read_bytes() + b" ")
    assert set(run.cache.load(drawn, roles).pictures) == {"target", "composite"}


def test_validation_shows_held_out_pairs_and_the_end_says_the_speed(tmp_path):
    said = []
    run = training(tmp_path, "out", say=said.append)
    run.train()
    assert any("(held out)" in line for line in said)
    assert re.fullmatch(r"throughput: [\d.]+ pairs/s; \d+% of the time spent waiting for pictures", said[-1])
    sheet = read_rgb(tmp_path / "out" / "validation" / "00000003.png")
    assert sheet.shape == (2 * 32, 3 * 32, 3)
    trained, shown = ({pair.group for pair in one.all()} for one in (run.task.data.mixture, run.task.data.held_out))
    assert not trained & shown


def test_another_training_in_the_folder_is_refused(tmp_path):
    training(tmp_path, "out").train()
    line = r"out: expected the same training to resume, found rate 0.001 instead of 0.5"
    with pytest.raises(ValueError, match=line):
        training(tmp_path, "out", replace(QUICK, rate=0.5, steps=8)).train()


def test_a_loss_that_is_no_number_stops_and_keeps_the_last_state(tmp_path):
    run = training(tmp_path, "out", replace(QUICK, save_every=1))

    def poison(done, total, message):
        if done == 2:
            with torch.no_grad():
                run.task.network.proj_out.bias.fill_(float("nan"))

    # the poison comes after step 2's weights were reported and before they are saved
    line = "expected finite weights after step 2, found others; the state of step 1 is kept"
    with pytest.raises(ValueError, match=line):
        replace(run, progress=poison).train()
    assert {p.name for p in (tmp_path / "out" / "states").iterdir()} == {"00000001"}


def test_a_pair_whose_loss_is_no_number_is_named_and_the_step_before_is_kept(tmp_path):
    loop = replace(QUICK, batch=2, save_every=99, validate_every=99, steps=9)
    run = training(tmp_path, "out", loop, pairs=6)
    draw = run.task.data.mixture.draw
    step, bad = next(
        (position // 2, draw(position))
        for position in range(2, 18)
        if all(draw(earlier) != draw(position) for earlier in range(position // 2 * 2))
    )
    loaded = run.cache.load(bad, run.task.objective.roles)
    latents = run.cache.encode_missing([loaded], run.task.objective.roles)["composite"][0]
    write_tensors(loaded.paths["composite"], {"latents": latents.fill_(float("nan")).to(torch.bfloat16)})
    line = (
        f"a finite loss and gradient at step {step + 1}, found others for {bad.relit}; the state of step {step} is kept"
    )
    with pytest.raises(ValueError, match=re.escape(line)):
        run.train()
    assert {p.name for p in (tmp_path / "out" / "states").iterdir()} == {f"{step:08d}"}
    whole = training(tmp_path, "whole", replace(loop, steps=step), pairs=6).train()
    # the kept state is that of the last good step, bit for bit
    loaded.paths["composite"].unlink()
    kept = training(tmp_path, "out", replace(loop, steps=step), pairs=6).train()
    assert (kept / WEIGHTS).read_bytes() == (whole / WEIGHTS).read_bytes()


def test_a_picture_that_vanished_is_one_line_and_leaves_a_state_and_no_open_file(tmp_path):
    run = training(tmp_path, "out", replace(QUICK, save_every=99, validate_every=99, steps=50), pairs=3)

    def remove(done, total, message):
        if done == 3:
            for path in (tmp_path / "pairs").glob("*/relit_0.png"):
                path.unlink()

    gc.collect()
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always", ResourceWarning)
        with pytest.raises(ValueError, match=r"relit_0.png: expected a picture of a pair, found No such file"):
            replace(run, progress=remove).train()
        gc.collect()  # an open file is found when it is collected
    assert not [warning for warning in found if issubclass(warning.category, ResourceWarning)]
    (state,) = list_states(tmp_path / "out")
    assert int(state.name) >= 3
    assert len(read_losses(tmp_path / "out" / LOG_FILE)) == int(state.name)


def test_a_damaged_state_is_said_and_the_one_before_it_is_taken(tmp_path):
    model = training(tmp_path, "out").train()
    before = (model / WEIGHTS).read_bytes()
    file = tmp_path / "out" / "states" / "00000006" / "__0_0.distcp"
    file.write_bytes(file.read_bytes()[:1000])
    said = []
    assert training(tmp_path, "out", say=said.append).train() == model
    assert (model / WEIGHTS).read_bytes() == before
    assert "00000006: expected a complete state, found" in said[0]
    assert "resumed from step 4" in said


def test_too_little_memory_is_one_line(tmp_path, monkeypatch):
    run = training(tmp_path, "out")

    def full(*arguments, **named):
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(run.task.objective, "loss", full)
    with pytest.raises(ValueError, match="expected memory for 2 pairs a pass, found too little at step 0"):
        run.train()


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"batch": 3, "accumulate": 2}, r"--batch: expected a multiple of 2 \(1 processes x --accumulate 2\), found 3"),
        ({"ema": 1.0}, "--ema: expected a decay from 0 to below 1, found 1.0"),
        ({"steps": 0}, "--steps: expected at least 1, found 0"),
    ],
)
def test_bad_options_are_one_line(tmp_path, change, line):
    with pytest.raises(ValueError, match=line):
        replace(QUICK, **change).check(1)


def removal_run(tmp_path, name, base, loop, progress=silent):
    pairs = tmp_path / "rendered"
    folder = open_rendered(pairs if pairs.is_dir() else rendered_folder(pairs, 1))
    objective = RemovalObjective(str(base), silent, checkpointing=False)
    return run_of(objective, [folder], loop, tmp_path / name, held_out=0.0, progress=progress)


@pytest.mark.long
def test_object_removal_learns_its_pair(tmp_path):
    base = removal_folder(tmp_path / "base")
    loop = replace(QUICK, steps=20, batch=4, rate=8e-3, save_every=18, validate_every=99, validation_pairs=1)

    def error(folder):
        run = removal_run(tmp_path, "out", folder, loop)
        objective = run.task.objective
        item = run.cache.load(run.task.data.mixture.draw(0), objective.roles)
        latents = run.cache.encode_missing([item] * 16, objective.roles)
        with torch.no_grad():
            return float(objective.loss(objective.network.eval(), latents, range(16)))

    assert error(removal_run(tmp_path, "out", base, loop).train()) < 0.7 * error(base)


@pytest.mark.long
def test_object_removal_is_trained_by_the_same_loop_and_resumes(tmp_path):
    base = removal_folder(tmp_path / "base")
    loop = replace(QUICK, steps=3, batch=1, save_every=2, validate_every=99, validation_pairs=1)
    model = removal_run(tmp_path, "out", base, loop).train()
    with pytest.raises(KeyboardInterrupt):
        removal_run(tmp_path, "killed", base, loop, killed_at(3)).train()
    removal_run(tmp_path, "killed", base, loop).train()
    assert read_losses(tmp_path / "killed" / LOG_FILE) == read_losses(tmp_path / "out" / LOG_FILE)
    run = removal_run(tmp_path, "out", model, loop)
    trained = run.task.objective
    assert trained.network.config.in_channels == CHANNELS * 3
    latents = run.cache.encode_missing([run.cache.load(run.task.data.mixture.draw(0), trained.roles)], trained.roles)
    with torch.no_grad():
        image = trained.predict(trained.network.eval(), latents, 0)
    assert image.shape == (1, 3, 32, 32)
    assert bool(image.isfinite().all())


@pytest.mark.parametrize("kind", ["transformer", "unet"])
def test_what_validation_measured_is_what_is_saved(tmp_path, kind):
    from diffusers import FluxTransformer2DModel, UNet2DConditionModel

    loop = replace(QUICK, ema=0.9, steps=4, validate_every=4)
    if kind == "transformer":
        run, model = training(tmp_path, "out", loop), FluxTransformer2DModel
    else:
        run, model = removal_run(tmp_path, "out", removal_folder(tmp_path / "base"), loop), UNet2DConditionModel
    measured = measured_by(run)
    read, trained = model.from_pretrained(run.train() / kind).state_dict(), run.task.network.state_dict()
    assert set(read) == set(measured)
    assert all(torch.equal(read[name], measured[name]) for name in read)
    # the last weights differ from their average
    assert sum(not torch.equal(read[name], trained[name]) for name in read) > len(read) / 2
