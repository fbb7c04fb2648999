"""FLUX compared with diffusers, PEFT and transformers: the same sampling, adaptations, and empty prompt."""

import json

import pytest
import torch

pytest.importorskip("diffusers")
pytest.importorskip("peft")

import transformers
from diffusers import FlowMatchEulerDiscreteScheduler, FluxPipeline
from peft import LoraConfig
from peft.utils import get_peft_model_state_dict
from safetensors.torch import save_file
from tiny_models import (
    CHANNELS,
    POOLED,
    TEXT,
    flux_folder,
    kontext_folder,
    tiny_autoencoder,
    tiny_prompt,
    tiny_transformer,
)

from splatgraft.cli import main
from splatgraft.harmonization import FluxOptions, HarmonizerContext, make_harmonizer
from splatgraft.harmonization.flux.baked_modulation import bake
from splatgraft.harmonization.flux.loading import BASE, merge_lora, widen_transformer
from splatgraft.harmonization.flux.network import Autoencoder, pack, velocity
from splatgraft.harmonization.flux.prompt import prompt_file, read_prompt
from splatgraft.harmonization.flux.sampling import sample, schnell_levels
from splatgraft_paper.training.flux import add_lora, write_lora

pytestmark = pytest.mark.filterwarnings("ignore")
START = torch.randn(1, CHANNELS, 4, 6, generator=torch.Generator().manual_seed(3))


def pipeline(**parts):
    # schnell's scheduler_config.json: no shift
    scheduler = FlowMatchEulerDiscreteScheduler(shift=1.0, use_dynamic_shifting=False)
    parts = dict.fromkeys(("text_encoder", "tokenizer", "text_encoder_2", "tokenizer_2")) | parts
    made = FluxPipeline(scheduler=scheduler, vae=tiny_autoencoder(), transformer=tiny_transformer(), **parts)
    made.set_progress_bar_config(disable=True)
    return made


def stock_image(stock):
    prompt = tiny_prompt()
    return stock(
        prompt_embeds=prompt.tokens[None], pooled_prompt_embeds=prompt.pooled[None], height=32, width=48,
        num_inference_steps=4, guidance_scale=0.0, latents=pack(START), output_type="pt",
    ).images  # fmt: skip


def our_image(transformer):
    def step(latents, level):
        return velocity(transformer, latents, torch.tensor([level]), tiny_prompt())

    bake(transformer, tiny_prompt(), schnell_levels()[:-1])
    with torch.no_grad():
        return Autoencoder(tiny_autoencoder()).decode(sample(step, START, schnell_levels()))


def test_our_loop_is_the_stock_pipeline_s():
    # the same operations; a division and a product of latents are in another order
    assert torch.allclose(our_image(tiny_transformer()), stock_image(pipeline()), atol=1e-5)


def trained_by_script(folder, **config):
    """Write the file of diffusers' train_dreambooth_lora_flux.py, by its own calls on a tiny transformer."""
    from diffusers.training_utils import _collate_lora_metadata

    transformer = tiny_transformer()
    targets = ["attn.to_k", "attn.to_q", "attn.to_out.0", "attn.add_k_proj", "ff.net.0.proj", "norm1.linear"]
    transformer.add_adapter(LoraConfig(target_modules=targets, **config))
    randomise(transformer)
    FluxPipeline.save_lora_weights(
        folder,
        transformer_lora_layers=get_peft_model_state_dict(transformer),
        text_encoder_lora_layers=None,
        **_collate_lora_metadata({"transformer": transformer}),
    )
    return folder / "pytorch_lora_weights.safetensors"


@torch.no_grad()
def randomise(transformer):
    """Set the matrices B, which begin at zero, to random values."""
    for name, parameter in transformer.named_parameters():
        if "lora_B" in name:
            parameter.normal_(0, 0.2, generator=torch.Generator().manual_seed(1))


CONFIGS = {
    "alpha": {"r": 2, "lora_alpha": 8},
    "pattern": {"r": 2, "lora_alpha": 2, "alpha_pattern": {"attn.to_k": 10}, "rank_pattern": {"attn.to_q": 4}},
    "stabilised, with biases": {"r": 4, "lora_alpha": 4, "use_rslora": True, "lora_bias": True},
}


@pytest.mark.parametrize("config", CONFIGS)
def test_a_file_of_diffusers_own_script_gives_the_image_of_its_own_loading(tmp_path, config):
    path = trained_by_script(tmp_path, **CONFIGS[config])
    stock, ours = pipeline(), tiny_transformer()
    without = stock_image(stock)
    stock.load_lora_weights(str(tmp_path))
    assert merge_lora(ours, path) == 1 + 1 + 1 + 1 + 1 + 1 + 2 * 2
    assert set(dict(ours.named_parameters())) == set(dict(tiny_transformer().named_parameters()))
    wanted = stock_image(stock)
    assert float((wanted - without).abs().max()) > 0.01
    # W x + s B A x against (W + s B A) x, over four steps and a decoder
    assert torch.allclose(our_image(ours), wanted, atol=2e-5)


def test_an_adaptation_begins_at_nothing_and_makes_flux_the_harmoniser_that_was_trained(tmp_path):
    base, path = flux_folder(tmp_path / "base"), tmp_path / "trained" / "lora.safetensors"
    stock, adapted = tiny_transformer(), tiny_transformer()
    widen_transformer(stock)
    widen_transformer(adapted)
    assert add_lora(adapted, 2, seed=5) == (8 + 4) + 2 * (3 + 2)  # a double block's layers, and two single blocks'
    latents, prompt, t = torch.randn(1, CHANNELS * 3, 4, 4), tiny_prompt(), torch.tensor([0.5])
    with torch.no_grad():
        assert torch.equal(velocity(adapted, latents, t, prompt), velocity(stock, latents, t, prompt))
        randomise(adapted)
        adapted.x_embedder.weight.add_(0.1)
        wanted = velocity(adapted, latents, t, prompt)
    path.parent.mkdir()
    state = {name: one for name, one in adapted.state_dict().items() if "lora_" in name or "x_embedder" in name}
    write_lora(path, state, {})
    said, options = [], FluxOptions(weights=str(base), lora=path)
    context = HarmonizerContext(say=said.append, strengths=(0.5,))
    with pytest.raises(ValueError, match=r"lora.safetensors: expected harmonizer.json or .* choose by --variant"):
        make_harmonizer(options, context)
    (path.parent / "harmonizer.json").write_text(json.dumps({"variant": "image-mask"}))
    network = make_harmonizer(options, context).network
    assert f"lora: 22 layers adapted by {path}" in said
    with torch.no_grad():
        # W x + B A x against (W + B A) x: float32 rounding over three blocks
        assert torch.allclose(velocity(network.transformer, latents, t, prompt), wanted, atol=1e-4)


def ones(name, inputs, outputs):
    return {
        f"transformer.{name}.lora_A.weight": torch.ones(2, inputs),
        f"transformer.{name}.lora_B.weight": torch.ones(outputs, 2),
    }


LAYER = "transformer_blocks.0.attn.to_q"
REFUSED = {
    "another model": ones("blocks.0.to_q", 5, 7),
    "another width": ones(LAYER, 3072, 3072),
    "a wider first layer": ones(LAYER, 32, 32) | {"transformer.x_embedder.weight": torch.ones(32, 48)},
    "a UNet's": {"unet.down.lora_A.weight": torch.ones(2, 5), "unet.down.lora_B.weight": torch.ones(5, 2)},
    "no adaptation": {"conv_in.weight": torch.ones(2, 5)},
    "truncated": None,
}


@pytest.mark.parametrize("kind", REFUSED)
def test_a_file_that_does_not_fit_is_one_line(tmp_path, kind):
    path, tensors = tmp_path / "lora.safetensors", REFUSED[kind]
    save_file(tensors or ones(LAYER, 32, 32), path)
    if tensors is None:
        path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(ValueError, match=r"lora.safetensors: expected a low-rank adaptation of this network") as error:
        merge_lora(tiny_transformer(), path)
    assert "\n" not in str(error.value)


def test_the_empty_prompt_is_the_stock_pipeline_s_and_lies_where_harmonize_looks(tmp_path, monkeypatch, capsys):
    folder, words = kontext_folder(tmp_path), ["paper", "train", "embed"]
    monkeypatch.setattr("pathlib.Path.home", lambda: folder / "home")
    assert main([*words, "--base", str(folder), "--tokens", "6"]) == 0
    path = folder / "empty_prompt.safetensors"
    found = read_prompt(path, tokens_width=TEXT, pooled_width=POOLED)
    stock = pipeline(
        text_encoder=transformers.CLIPTextModel.from_pretrained(folder / "text_encoder"),
        tokenizer=transformers.CLIPTokenizer.from_pretrained(folder / "tokenizer"),
        text_encoder_2=transformers.T5EncoderModel.from_pretrained(folder / "text_encoder_2"),
        tokenizer_2=transformers.T5TokenizerFast.from_pretrained(folder / "tokenizer_2"),
    )
    tokens, pooled, _ = stock.encode_prompt("", "", max_sequence_length=6)
    # the same layers on the same words; other kernels run if gradients are kept
    assert torch.allclose(found.tokens, tokens[0], atol=1e-5)
    assert torch.allclose(found.pooled, pooled[0], atol=1e-5)
    with pytest.raises(ValueError, match=r"expected tokens \(n, 4096\) and pooled \(768,\), found"):
        read_prompt(path, tokens_width=4096, pooled_width=768)
    assert main([*words, "--base", str(folder), "--kind", "stable-diffusion"]) == 0
    with pytest.raises(ValueError, match=r"expected tokens \(n, 24\) and pooled"):
        read_prompt(path, tokens_width=TEXT, pooled_width=POOLED)
    assert main([*words, "--base", str(folder / "tokenizer")]) == 2
    assert "tokenizer: expected CLIPTokenizer in tokenizer/, found no such folder" in capsys.readouterr().err
    # a hub id, in the user's cache, from which `harmonize` loads
    for kind in (
        transformers.CLIPTokenizer,
        transformers.CLIPTextModel,
        transformers.T5TokenizerFast,
        transformers.T5EncoderModel,
    ):
        original = kind.from_pretrained
        monkeypatch.setattr(kind, "from_pretrained", lambda base, original=original, **named: original(folder, **named))
    assert main([*words, "--tokens", "6"]) == 0
    assert prompt_file(BASE).is_file()
    assert str(prompt_file(BASE)) in capsys.readouterr().out
