"""The harmoniser `flux` on tiny models in the real folder layouts: loading, refusals, results."""

import json
from dataclasses import replace

import pytest
import torch

pytest.importorskip("diffusers")

from tiny_models import CHANNELS, flux_folder, quiet, tiny_transformer

from splatgraft.harmonization import FluxOptions, HarmonizerContext, HarmonizerInputs, make_harmonizer
from splatgraft.harmonization.flux.detail import limit_material_change, restore_detail
from splatgraft.harmonization.flux.weights.folder import FluxFolder
from splatgraft.harmonization.flux.weights.loading import FluxWeights, load_flux, widen_transformer
from splatgraft.harmonization.flux.weights.lora import add_lora, write_lora

pytestmark = list(quiet)
WIDE = CHANNELS * 12
PICTURES = ("composite", "background", "mask", "depth", "normal", "prior")


def view(h=32, w=48, seed=0):
    g = torch.Generator().manual_seed(seed)
    background = torch.rand(h, w, 3, generator=g)
    mask = torch.zeros(h, w)
    mask[h // 4 : h // 2, w // 4 : w // 2] = 1
    composite = torch.where(mask[..., None] > 0, torch.rand(h, w, 3, generator=g), background)
    flat = torch.zeros(h, w)
    return HarmonizerInputs(composite, background, mask, flat, torch.zeros(h, w, 3), composite)


def flux(folder, say=lambda sentence: None, device=torch.device("cpu"), **other):
    return make_harmonizer(FluxOptions(weights=str(folder), **other), HarmonizerContext(device=device, say=say))


def test_a_harmonizer_keeps_size_and_range_and_is_the_same_twice(tmp_path):
    said = []
    folder = flux_folder(tmp_path / "image-mask", WIDE)
    harmonizer = flux(folder, say=said.append)
    first = harmonizer.harmonize(view(37, 50)).image
    assert first.shape == (37, 50, 3)
    assert first.min() >= 0
    assert first.max() <= 1
    assert torch.equal(first, flux(folder).harmonize(view(37, 50)).image)
    assert not torch.equal(first, flux(folder, seed=1).harmonize(view(37, 50)).image)
    assert any("float32 on cpu" in line for line in said)


def test_a_padded_view_is_cropped_from_the_whole_and_a_legal_size_is_not_padded(tmp_path):
    folder = flux_folder(tmp_path / "image-mask", WIDE)
    harmonizer = flux(folder)
    small = view(31, 47)

    # what padding makes of it by hand: one more row and column, mirrored
    def grown(image):
        image = torch.cat([image, image[-2:-1]], 0)
        return torch.cat([image, image[:, -2:-1]], 1)

    whole = replace(small, **{name: grown(getattr(small, name)) for name in PICTURES})
    assert torch.equal(harmonizer.harmonize(small).image, harmonizer.harmonize(whole).image[:31, :47])


def test_views_at_once_are_those_one_by_one(tmp_path):
    folder = flux_folder(tmp_path / "image-mask", WIDE)
    views = [view(seed=i) for i in range(3)]
    alone = [flux(folder).harmonize(v).image for v in views]
    together = flux(folder, batch=3).harmonize_all(views)
    for one, other in zip(alone, together, strict=True):
        # batched products round otherwise; four steps and a decoder of a tiny model amplify that little
        assert torch.allclose(one, other.image, atol=1e-4)


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
    harmonizer = flux(tmp_path / "image-background")
    changed = replace(view(), background=torch.zeros(32, 48, 3))
    assert not torch.equal(harmonizer.harmonize(view()).image, harmonizer.harmonize(changed).image)


def test_a_folder_that_is_the_transformer_itself_takes_the_rest_from_the_base(tmp_path):
    base = flux_folder(tmp_path / "base")
    tiny_transformer(WIDE).save_pretrained(tmp_path / "image-mask")
    image = flux(tmp_path / "image-mask", base=str(base)).harmonize(view()).image
    whole = flux_folder(tmp_path / "whole" / "image-mask", WIDE)
    assert torch.equal(image, flux(whole).harmonize(view()).image)


def test_a_low_rank_adaptation_of_flux_is_a_harmonizer(tmp_path):
    base = flux_folder(tmp_path / "base")
    adapted = tiny_transformer()
    widen_transformer(adapted)
    add_lora(adapted, 2)
    (tmp_path / "lora").mkdir()
    (tmp_path / "lora" / "harmonizer.json").write_text(json.dumps({"variant": "image-mask"}))
    path = tmp_path / "lora" / "lora.safetensors"
    write_lora(path, adapted.state_dict(), {})
    said = []
    image = flux(base, lora=path, say=said.append).harmonize(view()).image
    assert any("22 layers adapted" in line for line in said)
    plain = flux_folder(tmp_path / "image-mask")
    widened_plain = tiny_transformer()
    widen_transformer(widened_plain)
    widened_plain.save_pretrained(plain / "transformer")
    # B is zero: the adaptation is the widened network itself
    assert torch.equal(image, flux(plain).harmonize(view()).image)


def test_weights_kept_in_eight_bits_give_about_the_same(tmp_path):
    folder = flux_folder(tmp_path / "image-mask", WIDE)
    said = []
    image = flux(folder, precision="fp8", say=said.append).harmonize(view()).image
    assert "flux: fp8 on cpu, as requested" in said
    full = flux(folder).harmonize(view()).image
    # float8_e4m3 has 3 bits of mantissa: products are off by some percent
    assert (image - full).abs().mean() < 0.05


def broken(tmp_path, how):
    folder = flux_folder(tmp_path / "image-mask", WIDE)
    weights = folder / "transformer" / "diffusion_pytorch_model.safetensors"
    config = folder / "transformer" / "config.json"
    how(folder, weights, config)
    return folder


def cut(path):
    path.write_bytes(path.read_bytes()[:-100])


def edit(path, **changes):
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


REFUSED = {
    "truncated": (
        lambda folder, weights, config: weights.write_bytes(weights.read_bytes()[:-100]),
        r"diffusion_pytorch_model.safetensors: expected \d+ bytes by its header, found \d+",
    ),
    "no safetensors": (
        lambda folder, weights, config: weights.write_bytes(b"<html>not found</html>"),
        "diffusion_pytorch_model.safetensors: expected a .safetensors file, found",
    ),
    "gone": (
        lambda folder, weights, config: weights.unlink(),
        "safetensors: expected a .safetensors file, found No such",
    ),
    "no config": (lambda folder, weights, config: config.unlink(), "config.json: expected the config of a FluxTransf"),
    "another class": (
        lambda folder, weights, config: edit(config, _class_name="UNet2DConditionModel"),
        "expected _class_name FluxTransformer2DModel, found UNet2DConditionModel",
    ),
    "config and weights": (
        lambda folder, weights, config: edit(config, in_channels=64),
        "expected x_embedder.weight of 32 x 64 by config.json, found 32 x 48",
    ),
    "no prompt": (
        lambda folder, weights, config: (folder / "empty_prompt.safetensors").unlink(),
        "empty_prompt.safetensors: expected the empty prompt's embeddings, found none; `splatgraft train embed",
    ),
    "a layer less than the config has": (
        lambda folder, weights, config: edit(config, num_layers=2),
        r"transformer: expected all weights of config.json, found \d+ missing: transformer_blocks.1",
    ),
    "a truncated autoencoder": (
        lambda folder, weights, config: cut(folder / "vae" / "diffusion_pytorch_model.safetensors"),
        "vae: expected an AutoencoderKL, found Unable to load weights",
    ),
    "an autoencoder of another shape": (
        lambda folder, weights, config: edit(folder / "vae" / "config.json", block_out_channels=[8, 8, 8, 16]),
        "vae: expected an AutoencoderKL, found Cannot load because .* expected shape",
    ),
    "no autoencoder": (
        lambda folder, weights, config: (folder / "vae" / "config.json").unlink(),
        "vae: expected an AutoencoderKL, found",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_broken_folder_is_one_line_that_names_the_file(tmp_path, name):
    how, line = REFUSED[name]
    folder = broken(tmp_path, how)
    with pytest.raises(ValueError, match=line) as error:
        flux(folder)
    assert "\n" not in str(error.value)
    assert str(folder) in str(error.value)


def test_what_is_no_harmonizer_is_refused_with_both_shapes(tmp_path):
    plain = flux_folder(tmp_path / "image-mask")
    with pytest.raises(ValueError, match=r"expected a first layer of 48 channels, found 16: FLUX itself"):
        flux(plain)
    odd = flux_folder(tmp_path / "odd", CHANNELS * 8)
    with pytest.raises(ValueError, match=r"32 x 16 \(FLUX\) or 32 x 48 \(a harmoniser\), found 32 x 32"):
        flux(odd)


@pytest.mark.parametrize(
    ("weights", "line"),
    [(None, "harmonizer flux: expected --weights"), ("./nowhere", "expected a folder with transformer/ or a hub id")],
)
def test_missing_weights_are_said(weights, line):
    with pytest.raises(ValueError, match=line):
        make_harmonizer(FluxOptions(weights=weights))


def test_numbers_that_are_none_and_memory_that_does_not_do_are_said(tmp_path, monkeypatch):
    harmonizer = flux(flux_folder(tmp_path / "image-mask", WIDE))
    with torch.no_grad():
        harmonizer.network.transformer.proj_out.bias.fill_(float("nan"))
    with pytest.raises(ValueError, match="harmonizer flux: expected finite latents, found NaN"):
        harmonizer.harmonize(view())

    def full(*arguments, **named):
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr("splatgraft.harmonization.flux.harmonizer.velocity", full)
    with pytest.raises(ValueError, match="expected memory for 1 views at once, found too little; finished views"):
        harmonizer.harmonize(view())


def test_detail_and_strength_are_laid_on_what_the_network_makes(tmp_path):
    folder, shown = flux_folder(tmp_path / "image-mask", WIDE), view()
    plain = flux(folder).harmonize(shown).image
    held = limit_material_change(plain, shown.composite, shown.mask, strength=0.3)
    image = flux(folder, detail=0.7, strength=0.3).harmonize(shown).image
    assert torch.equal(image, restore_detail(held, shown.composite, amount=0.7))
    for name in ("detail", "strength"):
        with pytest.raises(ValueError, match=f"--{name}: expected a number from 0 to 1, found 2.0"):
            flux(folder, **{name: 2.0})


def stored(folder, repository):
    """A folder as `splatgraft weights fetch` leaves it."""
    from splatgraft.runtime.weights.layout import HubFile
    from splatgraft.runtime.weights.store import StoredWeights, write_stored

    paths = [path for path in folder.rglob("*") if path.is_file()]
    files = [HubFile(path.relative_to(folder).as_posix(), path.stat().st_size) for path in paths]
    write_stored(folder, StoredWeights(repository, "0" * 40, "other", tuple(files)))


def test_weights_named_by_their_id_are_fetched_once_and_then_found_without_a_network(tmp_path, monkeypatch):
    from splatgraft.runtime.weights.store import folder_of

    monkeypatch.setattr("pathlib.Path.home", lambda: tmp_path / "home")
    asked, said = [], []

    def fetch(model, folder, say):
        asked.append(model)
        flux_folder(folder / "image-background", WIDE)
        stored(folder, model.repository)

    monkeypatch.setattr("splatgraft.harmonization.flux.weights.folder.fetch", fetch)
    first = flux("nviolante/dot3d/image-background", say=said.append)
    assert first.network.variant == "image-background"
    second = flux("nviolante/dot3d/image-background")
    assert torch.equal(first.harmonize(view()).image, second.harmonize(view()).image)
    assert [(model.repository, model.folder, model.parts) for model in asked] == [
        ("nviolante/dot3d", "image-background", ("transformer",))
    ]
    assert (folder_of("nviolante/dot3d") / "image-background").is_dir()


def test_sixteen_bit_files_a_root_autoencoder_and_an_embedded_prompt_are_where_harmonize_looks(tmp_path, monkeypatch):
    import shutil

    from splatgraft.harmonization.flux.weights.loading import BASE
    from splatgraft.runtime.weights.store import folder_of

    monkeypatch.setattr("pathlib.Path.home", lambda: tmp_path / "home")
    there = folder_of("nviolante/dot3d")
    whole = flux_folder(tmp_path / "whole" / "image-mask", WIDE)
    for size in ("100KB", "5GB"):  # in shards and in one file
        shutil.rmtree(there, ignore_errors=True)
        tiny_transformer(WIDE).save_pretrained(there / "image-mask", variant="bf16", max_shard_size=size)
        shutil.copytree(whole / "vae", there / "vae")
        stored(there, "nviolante/dot3d")
        prompt = folder_of(BASE) / "empty_prompt.safetensors"
        prompt.parent.mkdir(parents=True, exist_ok=True)
        prompt.unlink(missing_ok=True)
        with pytest.raises(
            ValueError, match=r"expected the empty prompt's embeddings, found none; `splatgraft train e"
        ):
            flux("nviolante/dot3d")
        shutil.copy(whole / "empty_prompt.safetensors", prompt)
        image = flux("nviolante/dot3d").harmonize(view()).image
        # the same weights, aligned otherwise in memory: products may round differently, by little after four steps
        assert torch.allclose(image, flux(whole).harmonize(view()).image, atol=1e-4)


def test_compiled_blocks_trace_whole_and_give_the_same(tmp_path):
    folder = flux_folder(tmp_path / "image-mask", WIDE)
    network = load_flux(FluxWeights(str(folder)), torch.device("cpu"), say=lambda line: None)
    plain = flux(folder).harmonize(view()).image
    harmonizer = flux(folder)
    object.__setattr__(harmonizer, "network", network)
    # the tracer alone, which needs no compiler: a break in a block's graph would be an error
    network.transformer.compile_repeated_blocks(backend="eager", fullgraph=True)
    assert torch.equal(harmonizer.harmonize(view()).image, plain)


def test_the_network_is_baked_when_it_is_loaded(tmp_path):
    folder = flux_folder(tmp_path / "image-mask", WIDE)
    network = load_flux(FluxWeights(str(folder)), torch.device("cpu"), say=lambda line: None)
    names = [name for name, _ in network.transformer.named_parameters()]
    assert not any(".linear." in name or "time_text" in name for name in names)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_on_cuda_in_bf16_it_is_about_that_of_the_cpu(tmp_path):
    folder = flux_folder(tmp_path / "image-mask", WIDE)
    on_gpu = flux(folder, device=torch.device("cuda")).harmonize(view()).image
    on_cpu = flux(folder).harmonize(view()).image
    # bfloat16 keeps 8 bits: percents after four steps
    assert (on_gpu - on_cpu).abs().mean() < 0.05
