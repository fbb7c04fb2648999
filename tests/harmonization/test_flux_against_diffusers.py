"""Against diffusers' own pipeline, where transformers is installed: the same sampling, the same empty prompt."""

import json

import pytest
import torch

pytest.importorskip("diffusers")
pytest.importorskip("transformers")

import transformers
from tiny_models import CHANNELS, POOLED, TEXT, tiny_autoencoder, tiny_prompt, tiny_transformer

from splatgraft.harmonization.flux.empty_prompt import read_prompt
from splatgraft.harmonization.flux.network import Autoencoder, velocity
from splatgraft.harmonization.flux.sampling import sample, schnell_levels
from splatgraft.harmonization.flux.weights.text_encoders import embed_empty_prompt, embed_empty_prompt_stable_diffusion

pytestmark = pytest.mark.filterwarnings("ignore")


@pytest.fixture
def text_encoders(tmp_path):
    """Tiny T5 and CLIP with tokenizers, in the folders of FLUX."""
    torch.manual_seed(0)
    clip = transformers.CLIPTextConfig(
        vocab_size=8, hidden_size=POOLED, intermediate_size=16, num_hidden_layers=1, num_attention_heads=2,
        eos_token_id=1, bos_token_id=0, pad_token_id=1,
    )  # fmt: skip
    transformers.CLIPTextModel(clip).eval().save_pretrained(tmp_path / "text_encoder")
    vocabulary = {"<|startoftext|>": 0, "<|endoftext|>": 1, "a</w>": 2}
    (tmp_path / "tokenizer").mkdir()
    (tmp_path / "tokenizer" / "vocab.json").write_text(json.dumps(vocabulary))
    (tmp_path / "tokenizer" / "merges.txt").write_text("#version: 0.2\n")
    (tmp_path / "tokenizer" / "tokenizer_config.json").write_text('{"model_max_length": 77}')
    t5 = transformers.T5Config(vocab_size=8, d_model=TEXT, d_kv=8, d_ff=16, num_layers=1, num_heads=2)
    transformers.T5EncoderModel(t5).eval().save_pretrained(tmp_path / "text_encoder_2")
    from tokenizers import Tokenizer, models

    pieces = [("<pad>", 0.0), ("</s>", 0.0), ("<unk>", 0.0), ("a", -1.0)]
    rust = Tokenizer(models.Unigram(pieces, unk_id=2))
    t5_tokenizer = transformers.T5TokenizerFast(tokenizer_object=rust, extra_ids=0)
    t5_tokenizer.save_pretrained(tmp_path / "tokenizer_2")
    return tmp_path


def pipeline(folder=None):
    from diffusers import FlowMatchEulerDiscreteScheduler, FluxPipeline

    parts = dict.fromkeys(("text_encoder", "tokenizer", "text_encoder_2", "tokenizer_2"))
    if folder:
        parts = {
            "text_encoder": transformers.CLIPTextModel.from_pretrained(folder / "text_encoder"),
            "tokenizer": transformers.CLIPTokenizer.from_pretrained(folder / "tokenizer"),
            "text_encoder_2": transformers.T5EncoderModel.from_pretrained(folder / "text_encoder_2"),
            "tokenizer_2": transformers.T5TokenizerFast.from_pretrained(folder / "tokenizer_2"),
        }
    # schnell's scheduler_config.json: no shift
    scheduler = FlowMatchEulerDiscreteScheduler(shift=1.0, use_dynamic_shifting=False)
    made = FluxPipeline(scheduler=scheduler, vae=tiny_autoencoder(), transformer=tiny_transformer(), **parts)
    made.set_progress_bar_config(disable=True)
    return made


def test_our_loop_is_the_stock_pipeline_s():
    from splatgraft.harmonization.flux.latents import pack

    prompt, stock = tiny_prompt(), pipeline()
    start = torch.randn(1, CHANNELS, 4, 6, generator=torch.Generator().manual_seed(3))
    wanted = stock(
        prompt_embeds=prompt.tokens[None],
        pooled_prompt_embeds=prompt.pooled[None],
        height=32,
        width=48,
        num_inference_steps=4,
        guidance_scale=0.0,
        latents=pack(start),
        output_type="pt",
    ).images

    def step(latents, level):
        return velocity(stock.transformer, latents, torch.tensor([level]), prompt)

    with torch.no_grad():
        made = Autoencoder(stock.vae).decode(sample(step, start, schnell_levels()))
    # the same operations; a division and a product of latents are in another order
    assert torch.allclose(made, wanted, atol=1e-5)


def test_the_empty_prompt_is_the_stock_pipeline_s(text_encoders):
    path = text_encoders / "empty_prompt.safetensors"
    said = []
    embed_empty_prompt(str(text_encoders), path, tokens=6, say=said.append)
    found = read_prompt(path, tokens_width=TEXT, pooled_width=POOLED)
    tokens, pooled, _ = pipeline(text_encoders).encode_prompt("", "", max_sequence_length=6)
    # the same layers on the same words; other kernels serve where gradients are kept
    assert torch.allclose(found.tokens, tokens[0], atol=1e-5)
    assert torch.allclose(found.pooled, pooled[0], atol=1e-5)
    assert len(said) == 2
    with pytest.raises(ValueError, match=r"expected tokens \(n, 4096\) and pooled \(768,\), found"):
        read_prompt(path, tokens_width=4096, pooled_width=768)
    embed_empty_prompt_stable_diffusion(str(text_encoders), path, say=said.append)
    with pytest.raises(ValueError, match=r"expected tokens \(n, 24\) and pooled"):
        read_prompt(path, tokens_width=TEXT, pooled_width=POOLED)
    with pytest.raises(ValueError, match=r"nowhere: expected CLIPTokenizer in tokenizer/, found"):
        embed_empty_prompt(str(text_encoders / "nowhere"), path, tokens=6, say=said.append)


def test_embedding_without_a_file_writes_where_harmonize_and_ic_light_look(
    text_encoders, tmp_path, monkeypatch, capsys
):
    from splatgraft.cli import main
    from splatgraft.harmonization.flux.weights.tensor_file import read_tensors

    monkeypatch.setattr("pathlib.Path.home", lambda: tmp_path / "home")
    assert main(["train", "embed", "--base", str(text_encoders), "--tokens", "6"]) == 0
    found = read_prompt(text_encoders / "empty_prompt.safetensors", tokens_width=TEXT, pooled_width=POOLED)
    assert found.tokens.shape == (6, TEXT)
    assert main(["train", "embed", "--kind", "ic-light", "--base", str(text_encoders)]) == 0
    prompts = read_tensors(text_encoders / "ic_light_prompt.safetensors")
    assert set(prompts) == {"positive", "negative"}
    assert prompts["positive"].shape == prompts["negative"].shape == (77, POOLED)
    # a hub id: in the folder of its weights, which is where `harmonize` looks; there is no network here
    from splatgraft.harmonization.flux.weights import text_encoders as module
    from splatgraft.harmonization.flux.weights.loading import BASE
    from splatgraft.runtime.weights.store import folder_of

    load = module._load
    monkeypatch.setattr(module, "_load", lambda base, part, kind: load(str(text_encoders), part, kind))
    assert main(["train", "embed", "--tokens", "6"]) == 0
    assert (folder_of(BASE) / "empty_prompt.safetensors").is_file()
    assert str(folder_of(BASE)) in capsys.readouterr().out
