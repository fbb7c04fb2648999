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
