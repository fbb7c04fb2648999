"""Computes the empty prompt's embeddings with the text encoders (the only module that imports transformers)."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from splatgraft.harmonization.flux.empty_prompt import PromptEmbedding, write_prompt
from splatgraft.harmonization.flux.weights.tensor_file import write_tensors

Say = Callable[[str], None]
IC_LIGHT_PROMPT_FILE = "ic_light_prompt.safetensors"
IC_LIGHT_PROMPTS = {"positive": "best quality", "negative": "lowres, bad anatomy, bad hands, cropped, worst quality"}
"""The added and the negative prompt of IC-Light's own demo; the user's prompt before them is empty here."""


def embed_empty_prompt(base: str, out: Path, *, tokens: int, say: Say) -> None:
    """Compute and write FLUX's embeddings of the empty string.

    Args:
        base: folder or hub id of FLUX with T5 and CLIP.
        out: file to write.
        tokens: length of T5's output.
        say: receives progress messages.

    Raises:
        ValueError: `base` holds no such text encoders.
    """
    clip_tokenizer, clip = _load(base, "tokenizer", "CLIPTokenizer"), _load(base, "text_encoder", "CLIPTextModel")
    say(f"{base}: CLIP embeds the empty prompt")
    with torch.no_grad():
        ids = clip_tokenizer([""], padding="max_length", max_length=77, return_tensors="pt").input_ids
        pooled = clip(ids).pooler_output[0]
    del clip
    t5_tokenizer, t5 = _load(base, "tokenizer_2", "T5TokenizerFast"), _load(base, "text_encoder_2", "T5EncoderModel")
    say(f"{base}: T5 embeds the empty prompt")
    with torch.no_grad():
        ids = t5_tokenizer([""], padding="max_length", max_length=tokens, return_tensors="pt").input_ids
        hidden = t5(ids).last_hidden_state[0]
    write_prompt(out, PromptEmbedding(hidden.float(), pooled.float()), base)


def embed_empty_prompt_stable_diffusion(base: str, out: Path, *, say: Say) -> None:
    """Compute and write Stable Diffusion's embeddings of the empty string, by the CLIP of folder or hub id `base`.

    Raises:
        ValueError: `base` holds no such text encoder.
    """
    tokenizer, clip = _load(base, "tokenizer", "CLIPTokenizer"), _load(base, "text_encoder", "CLIPTextModel")
    say(f"{base}: CLIP embeds the empty prompt")
    with torch.no_grad():
        ids = tokenizer([""], padding="max_length", max_length=77, return_tensors="pt").input_ids
        write_tensors(out, {"tokens": clip(ids).last_hidden_state[0].float()}, {"text": "", "source": base})


def embed_ic_light_prompts(base: str, out: Path, *, say: Say) -> None:
    """Compute and write the embeddings of IC-Light's two prompts, by the CLIP of folder or hub id `base`.

    Raises:
        ValueError: `base` holds no such text encoder.
    """
    tokenizer, clip = _load(base, "tokenizer", "CLIPTokenizer"), _load(base, "text_encoder", "CLIPTextModel")
    say(f"{base}: CLIP embeds IC-Light's prompts")
    with torch.no_grad():
        ids = {
            name: tokenizer([text], padding="max_length", max_length=77, return_tensors="pt").input_ids
            for name, text in IC_LIGHT_PROMPTS.items()
        }
        embedded = {name: clip(tokens).last_hidden_state[0].float() for name, tokens in ids.items()}
    write_tensors(out, embedded, {**IC_LIGHT_PROMPTS, "source": base})


def _load(base: str, part: str, kind: str) -> Any:
    import transformers

    try:
        return getattr(transformers, kind).from_pretrained(base, subfolder=part)
    except (OSError, ValueError) as error:
        found = " ".join(str(error).split())[:160]
        raise ValueError(f"{base}: expected {kind} in {part}/, found {type(error).__name__}: {found}") from error
