"""Low-rank adaptations by other programs, and networks made of FLUX.1-dev: as PEFT and diffusers load them."""

import json

import numpy as np
import pytest
import torch

pytest.importorskip("diffusers")

from safetensors.torch import save_file
from tiny_models import CHANNELS, flux_folder, quiet, tiny_autoencoder, tiny_prompt, tiny_transformer

from splatgraft.harmonization import FluxOptions, HarmonizerContext, make_harmonizer
from splatgraft.harmonization.flux.baked_modulation import bake
from splatgraft.harmonization.flux.network import Autoencoder, velocity
from splatgraft.harmonization.flux.sampling import sample, schnell_levels
from splatgraft.harmonization.flux.weights.folder import FluxFolder
from splatgraft.harmonization.flux.weights.loading import FluxWeights, load_flux
from splatgraft.harmonization.flux.weights.lora import merge_lora
from splatgraft.harmonization.flux.weights.lora_file import read_lora

pytestmark = list(quiet)
LAYER, OTHER = "transformer_blocks.0.attn.to_q", "single_transformer_blocks.1.proj_mlp"
RANK = 2


def matrices(name, rank=RANK, seed=0):
    g = torch.Generator().manual_seed(seed)
    weight = dict(tiny_transformer().named_parameters())[f"{name}.weight"]
    down, up = torch.randn(rank, weight.shape[1], generator=g), torch.randn(weight.shape[0], rank, generator=g)
    return {f"transformer.{name}.lora_A.weight": down, f"transformer.{name}.lora_B.weight": up}


def peft_header(**values):
    """The header of diffusers' training scripts: PEFT's configuration with the module's name before each key."""
    return {"lora_adapter_metadata": json.dumps({f"transformer.{key}": value for key, value in values.items()})}


FILES = {  # tensors beside the matrices, header, expected scale of LAYER and OTHER
    "no alpha": ({}, None, (1, 1)),
    "diffusers' script": ({}, peft_header(r=RANK, lora_alpha=16), (8, 8)),
    "a pattern": ({}, peft_header(r=RANK, lora_alpha=4, alpha_pattern={"attn.to_q": 1}), (0.5, 2)),
    "stabilised": ({}, peft_header(r=RANK, lora_alpha=4, use_rslora=True), (4 / 2**0.5, 4 / 2**0.5)),
    "alpha tensors": ({f"transformer.{LAYER}.alpha": torch.tensor(6.0)}, None, (3, 3)),
    "PEFT's default": ({}, peft_header(r=RANK), (4, 4)),
}


@pytest.mark.parametrize("kind", FILES)
def test_alpha_over_rank_scales_the_product(tmp_path, kind):
    more, header, scales = FILES[kind]
    path = tmp_path / "lora.safetensors"
    tensors = matrices(LAYER) | matrices(OTHER, seed=1)
    save_file(tensors | more, path, metadata=header)
    network = tiny_transformer()
    before = {name: p.detach().numpy().astype(np.float64) for name, p in network.named_parameters()}
    assert merge_lora(network, read_lora(path)) == 2
    for name, scale in zip((LAYER, OTHER), scales, strict=True):
        down, up = (tensors[f"transformer.{name}.lora_{part}.weight"].numpy().astype(np.float64) for part in "AB")
        found = dict(network.named_parameters())[f"{name}.weight"].detach().numpy()
        # float32 sums of a few values below 100
        np.testing.assert_allclose(found, before[f"{name}.weight"] + scale * up @ down, atol=1e-4)


def test_a_bias_of_an_adaptation_is_added_with_its_scale(tmp_path):
    path, bias = tmp_path / "lora.safetensors", torch.arange(32.0)
    tensors = matrices(LAYER) | {f"transformer.{LAYER}.lora_B.bias": bias}
    save_file(tensors, path, metadata=peft_header(r=RANK, lora_alpha=1))
    network = tiny_transformer()
    before = network.get_submodule(LAYER).bias.clone()
    merge_lora(network, read_lora(path))
    assert torch.allclose(network.get_submodule(LAYER).bias, before + bias / 2)


def ones(name, down, up):
    return {f"transformer.{name}.lora_A.weight": torch.ones(down), f"transformer.{name}.lora_B.weight": torch.ones(up)}


REFUSED = {
    "another model": (
        ones("blocks.0.to_q", (2, 5), (7, 2)),
        None,
        r"expected a network whose blocks.0.to_q is \(7, 5\), found no such layer",
    ),
    "another width": (
        ones(LAYER, (2, 3072), (3072, 2)),
        None,
        r"expected a network whose transformer_blocks.0.attn.to_q is \(3072, 3072\), found \(32, 32\)",
    ),
    "a UNet's": ({"unet.down.lora_A.weight": torch.ones(2, 5)}, None, "expected unet.down.lora_A.weight and .lora_B"),
    "no adaptation": ({"conv_in.weight": torch.ones(2, 5)}, None, "expected a low-rank .*found conv_in.weight"),
    "two ranks": (
        ones(LAYER, (2, 32), (32, 3)),
        None,
        r"\(rank, in\) and .lora_B.weight \(out, rank\), found \(2, 32\) and \(32, 3\)",
    ),
    "DoRA": (
        matrices(LAYER) | {f"transformer.{LAYER}.lora_magnitude_vector": torch.ones(32)},
        None,
        "found transformer.transformer_blocks.0.attn.to_q.lora_magnitude_vector, of another kind",
    ),
    "alpha twice": (
        matrices(LAYER) | {f"transformer.{LAYER}.alpha": torch.tensor(2.0)},
        peft_header(r=2, lora_alpha=2),
        "expected alphas in the header or as tensors, found both",
    ),
    "a header of something else": (matrices(LAYER), {"lora_adapter_metadata": "[]"}, "expected PEFT's configuration"),
}  # fmt: skip


@pytest.mark.parametrize("kind", REFUSED)
def test_what_does_not_fit_is_one_line_and_changes_nothing(tmp_path, kind):
    tensors, header, line = REFUSED[kind]
    path, network = tmp_path / "lora.safetensors", tiny_transformer()
    save_file(matrices(OTHER) | tensors if kind.startswith("another") else tensors, path, metadata=header)
    with pytest.raises(ValueError, match=line) as error:
        merge_lora(network, read_lora(path))
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)
    assert all(torch.equal(p, q) for p, q in zip(network.parameters(), tiny_transformer().parameters(), strict=True))


def test_a_truncated_file_is_one_line(tmp_path):
    path = tmp_path / "lora.safetensors"
    save_file(matrices(LAYER), path)
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(ValueError, match=r"lora.safetensors: expected a whole .safetensors file, found") as error:
        read_lora(path)
    assert "\n" not in str(error.value)


def test_an_adaptation_of_a_harmonizer_needs_no_description_and_one_of_flux_must_widen_it(tmp_path):
    path = tmp_path / "lora.safetensors"
    save_file(matrices(LAYER) | {"text_encoder.a.lora_A.weight": torch.ones(2, 2)}, path)
    said = []
    context = HarmonizerContext(say=said.append)
    folder = flux_folder(tmp_path / "image-mask", CHANNELS * 12)
    make_harmonizer(FluxOptions(weights=str(folder), lora=path), context)
    assert f"lora: 1 layers adapted by {path}" in said
    assert any("1 tensors of text encoders are not used" in line for line in said)
    plain = flux_folder(tmp_path / "plain")
    with pytest.raises(ValueError, match="expected x_embedder in an adaptation that makes FLUX a harmoniser, found"):
        make_harmonizer(FluxOptions(weights=str(plain), lora=path, variant="image-mask"), context)


def dev(**other):
    return tiny_transformer(guidance_embeds=True, **other)


@pytest.mark.parametrize("guidance", [3.5, 1.0])
def test_a_network_made_of_flux_dev_is_told_its_guidance_in_the_table(tmp_path, guidance):
    folder = flux_folder(tmp_path / "image-mask", CHANNELS * 12)
    network = dev(in_channels=CHANNELS * 12)
    network.save_pretrained(folder / "transformer")
    if guidance != 3.5:
        (folder / "harmonizer.json").write_text(json.dumps({"variant": "image-mask", "guidance": guidance}))
    assert FluxFolder.open(folder).guidance == guidance
    said, cpu = [], torch.device("cpu")
    loaded = load_flux(FluxWeights(str(folder)), cpu, say=said.append)
    assert any(f"FLUX.1-dev); guidance {guidance:g}" in line for line in said)
    g = torch.Generator().manual_seed(0)
    latents, level, prompt = torch.randn(1, CHANNELS * 3, 4, 6, generator=g), torch.tensor([0.5]), tiny_prompt()
    from splatgraft.harmonization.flux.latents import pack, positions, unpack

    with torch.no_grad():
        wanted = network(
            hidden_states=pack(latents), timestep=level, guidance=torch.tensor([guidance]),
            encoder_hidden_states=prompt.tokens[None], pooled_projections=prompt.pooled[None],
            txt_ids=torch.zeros(3, 3), img_ids=positions(4, 6, cpu), return_dict=False,
        )[0]  # fmt: skip
        # fused projections may round otherwise
        assert torch.allclose(velocity(loaded.transformer, latents, level, prompt), unpack(wanted, 4, 6), atol=1e-5)
        if guidance == 3.5:
            assert torch.equal(velocity(network, latents, level, prompt), unpack(wanted, 4, 6))
            table = dev(in_channels=CHANNELS * 12)
            bake(table, prompt, (0.5,))
            assert torch.equal(velocity(table, latents, level, prompt), unpack(wanted, 4, 6))


def test_a_guidance_that_is_none_is_one_line(tmp_path):
    folder = flux_folder(tmp_path / "image-mask", CHANNELS * 12)
    dev(in_channels=CHANNELS * 12).save_pretrained(folder / "transformer")
    (folder / "harmonizer.json").write_text('{"variant": "image-mask", "guidance": "high"}')
    with pytest.raises(ValueError, match=r"harmonizer.json: expected a number as guidance, found 'high'"):
        load_flux(FluxWeights(str(folder)), torch.device("cpu"), say=lambda sentence: None)


# ------------------------------------------------------------------ against PEFT and diffusers themselves


def stock_pipeline(transformer):
    from diffusers import FlowMatchEulerDiscreteScheduler, FluxPipeline

    scheduler = FlowMatchEulerDiscreteScheduler(shift=1.0, use_dynamic_shifting=False)
    parts = dict.fromkeys(("text_encoder", "tokenizer", "text_encoder_2", "tokenizer_2"))
    made = FluxPipeline(scheduler=scheduler, vae=tiny_autoencoder(), transformer=transformer, **parts)
    made.set_progress_bar_config(disable=True)
    return made


def image_of_pipeline(pipeline, start):
    from splatgraft.harmonization.flux.latents import pack

    prompt = tiny_prompt()
    return pipeline(
        prompt_embeds=prompt.tokens[None], pooled_prompt_embeds=prompt.pooled[None], height=32, width=48,
        num_inference_steps=4, guidance_scale=3.5, latents=pack(start), output_type="pt",
    ).images  # fmt: skip


def image_of_ours(transformer, start):
    def step(latents, level):
        return velocity(transformer, latents, torch.tensor([level]), tiny_prompt())

    bake(transformer, tiny_prompt(), schnell_levels()[:-1])
    with torch.no_grad():
        return Autoencoder(tiny_autoencoder()).decode(sample(step, start, schnell_levels()))


def trained_by_script(make, folder, **config):
    """The file that diffusers' train_dreambooth_lora_flux.py writes, after its own calls on a tiny transformer."""
    from diffusers import FluxPipeline
    from diffusers.training_utils import _collate_lora_metadata
    from peft import LoraConfig
    from peft.utils import get_peft_model_state_dict

    transformer = make()
    transformer.add_adapter(LoraConfig(**{"init_lora_weights": "gaussian", **config}))
    g = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for name, parameter in transformer.named_parameters():
            if "lora_B" in name:
                parameter.normal_(0, 0.2, generator=g)
    FluxPipeline.save_lora_weights(
        folder,
        transformer_lora_layers=get_peft_model_state_dict(transformer),
        text_encoder_lora_layers=None,
        **_collate_lora_metadata({"transformer": transformer}),
    )
    return folder / "pytorch_lora_weights.safetensors"


SCRIPT_TARGETS = [
    "attn.to_k",
    "attn.to_q",
    "attn.to_v",
    "attn.to_out.0",
    "attn.add_k_proj",
    "ff.net.0.proj",
    "norm1.linear",
]
CONFIGS = {
    "alpha": {"r": 2, "lora_alpha": 8},
    "pattern": {"r": 2, "lora_alpha": 2, "alpha_pattern": {"attn.to_k": 10}, "rank_pattern": {"attn.to_q": 4}},
    "rslora": {"r": 4, "lora_alpha": 4, "use_rslora": True},
    "bias": {"r": 2, "lora_alpha": 4, "lora_bias": True, "init_lora_weights": True},
}


@pytest.mark.parametrize("make", [tiny_transformer, dev], ids=["schnell", "dev"])
@pytest.mark.parametrize("config", CONFIGS)
@pytest.mark.filterwarnings("ignore")
def test_a_file_of_diffusers_own_script_gives_the_image_of_its_own_loading(tmp_path, make, config):
    pytest.importorskip("peft")
    pytest.importorskip("transformers")
    path = trained_by_script(make, tmp_path, target_modules=SCRIPT_TARGETS, **CONFIGS[config])
    start = torch.randn(1, CHANNELS, 4, 6, generator=torch.Generator().manual_seed(3))
    stock = stock_pipeline(make())
    without = image_of_pipeline(stock, start)
    stock.load_lora_weights(str(tmp_path))
    wanted = image_of_pipeline(stock, start)
    ours = make()
    merge_lora(ours, read_lora(path))
    made = image_of_ours(ours, start)
    assert float((wanted - without).abs().max()) > 0.01
    # W x + s B A x against (W + s B A) x, over four steps and a decoder
    assert torch.allclose(made, wanted, atol=2e-5)


@pytest.mark.filterwarnings("ignore")
def test_alpha_tensors_count_as_diffusers_counts_them(tmp_path):
    pytest.importorskip("peft")
    pytest.importorskip("transformers")
    path = tmp_path / "pytorch_lora_weights.safetensors"
    tensors = (
        matrices(LAYER) | matrices(OTHER, rank=4, seed=1) | matrices("single_transformer_blocks.0.proj_mlp", seed=2)
    )
    alphas = {f"transformer.{LAYER}.alpha": torch.tensor(1.0), f"transformer.{OTHER}.alpha": torch.tensor(6.0)}
    alphas["transformer.single_transformer_blocks.0.proj_mlp.alpha"] = torch.tensor(6.0)
    save_file({name: 0.1 * tensor for name, tensor in tensors.items()} | alphas, path)
    start = torch.randn(1, CHANNELS, 4, 6, generator=torch.Generator().manual_seed(3))
    stock = stock_pipeline(tiny_transformer())
    stock.load_lora_weights(str(tmp_path))
    ours = tiny_transformer()
    merge_lora(ours, read_lora(path))
    assert torch.allclose(image_of_ours(ours, start), image_of_pipeline(stock, start), atol=2e-5)  # as above
