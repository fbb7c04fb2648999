"""Randomly initialised models of a few thousand parameters, saved in the folder layouts of the real ones."""

import json
from pathlib import Path

import pytest
import torch

HEADS, HEAD_WIDTH, TEXT, POOLED, CHANNELS = 2, 16, 24, 20, 4

quiet = (pytest.mark.filterwarnings("ignore::FutureWarning"), pytest.mark.filterwarnings("ignore::DeprecationWarning"))


def tiny_transformer(in_channels=CHANNELS * 4, seed=0, **other):
    from diffusers import FluxTransformer2DModel

    torch.manual_seed(seed)
    return FluxTransformer2DModel(
        in_channels=in_channels,
        out_channels=CHANNELS * 4,
        num_layers=1,
        num_single_layers=2,
        attention_head_dim=HEAD_WIDTH,
        num_attention_heads=HEADS,
        joint_attention_dim=TEXT,
        pooled_projection_dim=POOLED,
        axes_dims_rope=(4, 6, 6),
        **other,
    ).eval()


def tiny_autoencoder(seed=1, channels=CHANNELS):
    from diffusers import AutoencoderKL

    torch.manual_seed(seed)
    return AutoencoderKL(
        block_out_channels=(8, 8, 8, 8),
        down_block_types=("DownEncoderBlock2D",) * 4,
        up_block_types=("UpDecoderBlock2D",) * 4,
        latent_channels=channels,
        norm_num_groups=4,
        layers_per_block=1,
        scaling_factor=0.3611,
        shift_factor=0.1159,
        use_quant_conv=False,
        use_post_quant_conv=False,
    ).eval()


def tiny_prompt(seed=2):
    from splatgraft.harmonization.flux.prompt import PromptEmbedding

    g = torch.Generator().manual_seed(seed)
    return PromptEmbedding(torch.randn(3, TEXT, generator=g), torch.randn(POOLED, generator=g))


def flux_folder(folder: Path, in_channels=CHANNELS * 4, variant=None, seed=0) -> Path:
    """Write FLUX.1-schnell's layout (transformer/, vae/), tiny; 48 input channels make it a harmoniser."""
    from splatgraft.harmonization.flux.prompt import write_prompt

    tiny_transformer(in_channels, seed).save_pretrained(folder / "transformer")
    tiny_autoencoder().save_pretrained(folder / "vae")
    write_prompt(folder / "empty_prompt.safetensors", tiny_prompt(), "tiny")
    if variant:
        (folder / "harmonizer.json").write_text(json.dumps({"variant": variant}))
    return folder


def removal_folder(folder: Path) -> Path:
    """Write Stable Diffusion 2's layout (unet/, vae/), tiny."""
    from diffusers import UNet2DConditionModel

    from splatgraft.harmonization.flux.tensor_file import write_tensors

    torch.manual_seed(3)
    UNet2DConditionModel(
        in_channels=CHANNELS,
        out_channels=CHANNELS,
        block_out_channels=(8, 16),
        down_block_types=("CrossAttnDownBlock2D", "DownBlock2D"),
        up_block_types=("UpBlock2D", "CrossAttnUpBlock2D"),
        layers_per_block=1,
        cross_attention_dim=TEXT,
        attention_head_dim=4,
        norm_num_groups=4,
    ).save_pretrained(folder / "unet")
    tiny_autoencoder().save_pretrained(folder / "vae")
    write_tensors(folder / "empty_prompt.safetensors", {"tokens": torch.randn(3, TEXT)})
    return folder


def clip_parts(width: int) -> dict:
    """Return a text encoder of CLIP and its tokenizer, tiny, with a few words."""
    from transformers import CLIPTextConfig, CLIPTextModel, CLIPTokenizer

    words = ["<|startoftext|>", "<|endoftext|>", *(f"{letter}</w>" for letter in "abcdefghij")]
    torch.manual_seed(4)
    config = CLIPTextConfig(
        bos_token_id=0, eos_token_id=1, pad_token_id=1, hidden_size=width, projection_dim=width, intermediate_size=37,
        num_attention_heads=4, num_hidden_layers=2, vocab_size=len(words),
    )  # fmt: skip
    tokenizer = CLIPTokenizer(vocab={word: i for i, word in enumerate(words)}, merges=[], model_max_length=77)
    return {"text_encoder": CLIPTextModel(config), "tokenizer": tokenizer}


def pipeline_folder(folder: Path, kind: str, **transformer) -> Path:
    """Write a whole pipeline of FLUX of a class of diffusers, of the classes in its own tests, tiny."""
    import diffusers
    from transformers import T5Config, T5EncoderModel, T5TokenizerFast

    pieces = [("<pad>", 0.0), ("</s>", 0.0), ("<unk>", 0.0), *((f"\u2581{letter}", -1.0) for letter in "abcdefghij")]
    clip = clip_parts(POOLED)
    t5 = T5Config(vocab_size=200, d_model=TEXT, d_kv=8, d_ff=32, num_layers=1, num_heads=2)
    getattr(diffusers, kind)(
        scheduler=diffusers.FlowMatchEulerDiscreteScheduler(),
        vae=tiny_autoencoder(),
        text_encoder_2=T5EncoderModel(t5),
        tokenizer_2=T5TokenizerFast(vocab=pieces, extra_ids=0),
        transformer=tiny_transformer(**transformer),
        **clip,
    ).save_pretrained(folder)
    return folder


def kontext_folder(folder: Path) -> Path:
    """Write a whole FluxKontextPipeline."""
    return pipeline_folder(folder, "FluxKontextPipeline", guidance_embeds=True)
