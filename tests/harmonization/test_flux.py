"""The harmoniser `flux` on tiny models in the real folder layouts: loading, refusals, results, iterative updates."""

import json
import shutil
from dataclasses import replace

import pytest
import torch

pytest.importorskip("diffusers")

from huggingface_hub.utils import filter_repo_objects
from tiny_models import CHANNELS, flux_folder, kontext_folder, quiet, tiny_autoencoder, tiny_transformer

from splatgraft.harmonization import (
    FluxOptions,
    HarmonizerContext,
    HarmonizerInputs,
    make_harmonizer,
)
from splatgraft.harmonization.flux.loading import BASE, FluxFolder
from splatgraft.harmonization.flux.network import Autoencoder, velocity
from splatgraft.harmonization.flux.prompt import prompt_file
from splatgraft.harmonization.flux.sampling import noise
from splatgraft_paper.consolidation import NoisyStartHarmonizer, noise_levels

pytestmark = list(quiet)
WIDE = CHANNELS * 12
PICTURES = ("composite", "background", "mask", "depth", "prior")


def view(h=32, w=48, seed=0):
    g = torch.Generator().manual_seed(seed)
    background, prior = (torch.rand(h, w, 3, generator=g) for _ in range(2))
    mask = torch.zeros(h, w)
    mask[h // 4 : h // 2, w // 4 : w // 2] = 1
    composite = torch.where(mask[..., None] > 0, torch.rand(h, w, 3, generator=g), background)
    return HarmonizerInputs(composite, background, mask, torch.zeros(h, w), prior)


def flux(folder, *, say=lambda sentence: None, device=torch.device("cpu"), strengths=(1.0,), **other):
    context = HarmonizerContext(device=device, say=say, strengths=strengths)
    return make_harmonizer(FluxOptions(weights=str(folder), **other), context)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a harmoniser that no test changes."""
    return flux_folder(tmp_path_factory.mktemp("flux") / "image-mask", WIDE)


def test_a_harmonizer_keeps_size_and_range_and_is_the_same_twice(folder):
    said = []
    first = flux(folder, say=said.append).harmonize(view(37, 50))
    assert first.shape == (37, 50, 3)
    assert first.min() >= 0
    assert first.max() <= 1
    assert torch.equal(first, flux(folder).harmonize(view(37, 50)))
    assert not torch.equal(first, flux(folder, seed=1).harmonize(view(37, 50)))
    assert not torch.equal(first, flux(folder, sampling_steps=2).harmonize(view(37, 50)))
    assert any("float32, on cpu" in line for line in said)


def test_a_padded_view_is_cropped_from_the_whole(folder):
    harmonizer, small = flux(folder), view(31, 47)

    # padding by hand: one more row and column, mirrored
    def grown(image):
        image = torch.cat([image, image[-2:-1]], 0)
        return torch.cat([image, image[:, -2:-1]], 1)

    whole = replace(small, **{name: grown(getattr(small, name)) for name in PICTURES})
    assert torch.equal(harmonizer.harmonize(small), harmonizer.harmonize(whole)[:31, :47])


def test_the_variant_is_told_by_the_folder_and_changes_what_is_shown(tmp_path):
    named = FluxFolder.open(flux_folder(tmp_path / "image-background", WIDE))
    assert named.variant("auto") == "image-background"
    written = FluxFolder.open(flux_folder(tmp_path / "mine", WIDE, "image-mask"))
    assert written.variant("auto") == "image-mask"
    assert FluxFolder.open(flux_folder(tmp_path / "other", WIDE)).variant("image-mask") == "image-mask"
    with pytest.raises(ValueError, match=r"other: expected harmonizer.json or a folder called .*--variant"):
        FluxFolder.open(tmp_path / "other").variant("auto")
    with pytest.raises(ValueError, match=r"expected image-mask .--variant., found image-background"):
        named.variant("image-mask")
    for text in ("[]", '{"variant": "mine"}', "{"):
        (tmp_path / "mine" / "harmonizer.json").write_text(text)
        with pytest.raises(ValueError, match=r"harmonizer.json: expected a variant, image-mask or .*, found"):
            written.variant("auto")
    harmonizer = flux(tmp_path / "image-background")
    changed = replace(view(), background=torch.zeros(32, 48, 3))
    assert not torch.equal(harmonizer.harmonize(view()), harmonizer.harmonize(changed))


def test_parts_are_found_beside_the_weights_in_the_base_and_in_the_hub_s_cache(folder, tmp_path, monkeypatch):
    wanted = flux(folder).harmonize(view())
    base = flux_folder(tmp_path / "base")
    tiny_transformer(WIDE).save_pretrained(tmp_path / "bare" / "image-mask")
    assert torch.equal(flux(tmp_path / "bare" / "image-mask", base=str(base)).harmonize(view()), wanted)
    # weights by their hub id, in 16 bits and in shards or in one file, beside a root vae/
    monkeypatch.setattr("pathlib.Path.home", lambda: tmp_path / "home")
    monkeypatch.setattr("splatgraft.harmonization.flux.loading.hub_folder", lambda *words: tmp_path / "hub")
    prompt = prompt_file(BASE)
    for size in ("100KB", "5GB"):
        shutil.rmtree(tmp_path / "hub", ignore_errors=True)
        tiny_transformer(WIDE).save_pretrained(tmp_path / "hub/image-mask", variant="bf16", max_shard_size=size)
        shutil.copytree(folder / "vae", tmp_path / "hub" / "vae")
        prompt.unlink(missing_ok=True)
        with pytest.raises(ValueError, match=r"embeddings, found none; `splatgraft paper train embed` makes them"):
            flux("dot3d")
        prompt.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(folder / "empty_prompt.safetensors", prompt)
        # the same weights, aligned otherwise in memory: products may round differently, but little after four steps
        for words in ({"folder": "nviolante/dot3d"}, {"folder": "dot3d"}, {"folder": "dot3d", "variant": "image-mask"}):
            assert torch.allclose(flux(**words).harmonize(view()), wanted, atol=1e-4)
    shutil.copytree(tmp_path / "hub/image-mask", tmp_path / "hub/image-background")
    assert flux("dot3d", variant="image-background").network.variant == "image-background"


def test_weights_kept_in_eight_bits_give_about_the_same(folder):
    said = []
    image = flux(folder, precision="fp8", say=said.append).harmonize(view())
    assert "flux: fp8, as requested, on cpu" in said
    # float8_e4m3 has 3 bits of mantissa: products are off by some percent
    assert 0 < (image - flux(folder).harmonize(view())).abs().mean() < 0.05


def no_hub(repository, patterns, say):
    raise ValueError(f"{repository}: expected a network, found none")


def test_the_empty_prompt_is_looked_for_before_the_weights_are_fetched(tmp_path, monkeypatch):
    monkeypatch.setattr("pathlib.Path.home", lambda: tmp_path)
    fetched = []

    def hub(repository, patterns, say):
        files = ["vae/config.json", *(f"image-mask/{name}" for name in ("config.json", "a-00001-of-2.safetensors"))]
        fetched.extend(filter_repo_objects(files if "dot3d" in repository else (), allow_patterns=list(patterns)))
        return tmp_path / "hub"

    monkeypatch.setattr("splatgraft.harmonization.flux.loading.hub_folder", hub)
    with pytest.raises(
        ValueError, match=r"expected the empty prompt's embeddings, found none; .*(?:text_encoder|tokenizer)"
    ):
        flux("dot3d")
    assert fetched
    assert all(name.endswith(".json") for name in fetched)


def test_the_empty_prompt_is_made_once_where_the_base_has_text_encoders(folder, tmp_path):
    base = kontext_folder(tmp_path / "base")
    tiny_transformer(WIDE).save_pretrained(tmp_path / "bare" / "image-mask")
    said = []
    made = flux(tmp_path / "bare" / "image-mask", base=str(base), say=said.append)
    assert made.network.prompt.tokens.shape[0] == 256
    assert made.harmonize(view()).shape == (32, 48, 3)
    flux(tmp_path / "bare" / "image-mask", base=str(base), say=said.append)
    assert sum("embed the empty prompt once" in line for line in said) == 1


def test_channels_are_those_of_the_weights_not_of_the_base_s_config(folder, tmp_path):
    wanted = flux(folder).harmonize(view())
    shutil.copytree(folder, tmp_path / "image-mask")
    edit(tmp_path / "image-mask" / CONFIG, in_channels=16, out_channels=None)
    assert torch.equal(flux(tmp_path / "image-mask").harmonize(view()), wanted)


def cut(path):
    path.write_bytes(path.read_bytes()[:-100])


def edit(path, **changes):
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


WEIGHTS = "transformer/diffusion_pytorch_model.safetensors"
CONFIG = "transformer/config.json"
REFUSED = {
    "truncated": (lambda folder: cut(folder / WEIGHTS), "transformer: expected weights of FluxTransformer2DModel"),
    "gone": (lambda folder: (folder / WEIGHTS).unlink(), "transformer: expected weights of FluxTransformer2DModel"),
    "no config": (lambda folder: (folder / CONFIG).unlink(), "config.json: expected the config of a FluxTransf"),
    "another class": (
        lambda folder: edit(folder / CONFIG, _class_name="UNet2DConditionModel"),
        "expected the config of a FluxTransformer2DModel, found UNet2DConditionModel",
    ),
    "another width": (
        lambda folder: tiny_transformer(32).save_pretrained(folder / "transformer"),
        r"expected in_channels of 16 \(FLUX\) or 48 \(a harmoniser\), found 32",
    ),
    "FLUX itself": (
        lambda folder: tiny_transformer(16).save_pretrained(folder / "transformer"),
        "expected a harmoniser, found FLUX itself",
    ),
    "FLUX.1-dev": (lambda folder: edit(folder / CONFIG, guidance_embeds=True), "found one with guidance"),
    "no prompt": (
        lambda folder: (folder / "empty_prompt.safetensors").unlink(),
        "empty_prompt.safetensors: expected the empty prompt's embeddings, found none; `splatgraft paper train embed",
    ),
    "a layer less than the config has": (
        lambda folder: edit(folder / CONFIG, num_layers=2),
        r"transformer: expected all weights of config.json, found \d+ missing: transformer_blocks.1",
    ),
    "a truncated autoencoder": (
        lambda folder: cut(folder / "vae" / "diffusion_pytorch_model.safetensors"),
        "vae: expected weights of AutoencoderKL, found .*Unable to load weights",
    ),
    "an autoencoder of another shape": (
        lambda folder: edit(folder / "vae" / "config.json", block_out_channels=[8, 8, 8, 16]),
        "vae: expected weights of AutoencoderKL, found .*Cannot load because .* expected shape",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_broken_folder_is_one_line_that_names_the_file(folder, tmp_path, monkeypatch, name):
    monkeypatch.setattr("pathlib.Path.home", lambda: tmp_path / "image-mask")
    monkeypatch.setattr("splatgraft.harmonization.flux.loading.hub_folder", no_hub)
    how, line = REFUSED[name]
    shutil.copytree(folder, tmp_path / "image-mask")
    how(tmp_path / "image-mask")
    with pytest.raises(ValueError, match=line) as error:
        flux(tmp_path / "image-mask")
    assert "\n" not in str(error.value)
    assert str(tmp_path / "image-mask") in str(error.value)


def test_weights_that_are_nowhere_are_said():
    with pytest.raises(ValueError, match="harmonizer flux: expected --weights"):
        make_harmonizer(FluxOptions())
    with pytest.raises(ValueError, match="expected a folder with transformer/ or a hub id"):
        flux("./nowhere")


def test_numbers_that_are_none_and_memory_that_does_not_do_are_said(folder, monkeypatch):
    harmonizer = flux(folder)
    with torch.no_grad():
        harmonizer.network.transformer.proj_out.bias.fill_(float("nan"))
    with pytest.raises(ValueError, match="harmonizer flux: expected finite latents, found NaN"):
        harmonizer.harmonize(view())

    def full(*arguments, **named):
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr("splatgraft.harmonization.flux.harmonizer.velocity", full)
    with pytest.raises(ValueError, match="expected memory for a view, found too little; finished views"):
        harmonizer.harmonize(view())


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_on_cuda_in_bf16_it_is_about_that_of_the_cpu(folder):
    on_gpu = flux(folder, device=torch.device("cuda")).harmonize(view())
    # bfloat16 keeps 8 bits: percents after four steps
    assert (on_gpu - flux(folder).harmonize(view())).abs().mean() < 0.05


# ------------------------------------------------------------------ iterative updates (paper, ablations)


@pytest.mark.parametrize("schedule", ["linear", "geometric"])
def test_each_level_of_a_schedule_reaches_the_network_with_the_noise_that_belongs_to_it(folder, monkeypatch, schedule):
    strengths, seen = noise_levels(schedule, 5), []
    harmonizer = flux(folder, strengths=strengths)
    assert isinstance(harmonizer, NoisyStartHarmonizer)

    def watched(transformer, latents, level, prompt):
        seen.append((latents.clone(), float(level[0]), int(transformer.time_text_embed(level * 1000, level[None])[0])))
        return velocity(transformer, latents, level, prompt)

    monkeypatch.setattr("splatgraft.harmonization.flux.harmonizer.velocity", watched)
    shown, encoder = view(), Autoencoder(tiny_autoencoder())
    prior, composite = (encoder.encode(image.permute(2, 0, 1)[None]) for image in (shown.prior, shown.composite))
    eps = noise(tuple(prior.shape[1:]), 0)[None]
    for strength in strengths:
        seen.clear()
        harmonizer.harmonize_from(shown, strength)
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
    harmonizer, shown = flux(folder, strengths=noise_levels("linear", 5)), view()
    whole = harmonizer.harmonize_from(shown, 1.0)
    assert torch.equal(whole, flux(folder).harmonize(shown))
    other = replace(shown, prior=1 - shown.prior)
    assert torch.equal(harmonizer.harmonize_from(other, 1.0), whole)
    assert not torch.equal(harmonizer.harmonize_from(other, 0.1), harmonizer.harmonize_from(shown, 0.1))
    with pytest.raises(ValueError, match=r"harmonizer flux: expected to start at a noise level of 1, found 0\.5"):
        flux(folder).harmonize_from(view(), 0.5)
