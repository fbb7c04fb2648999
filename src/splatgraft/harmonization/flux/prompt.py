"""Text embeddings of the empty prompt, made once by the text encoders and then read from a file."""

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.harmonization.flux.tensor_file import read_tensors, write_tensors
from splatgraft.runtime.hub import hub_id

PROMPT_FILE = "empty_prompt.safetensors"
TOKENS = 256
"""Length of T5's sequence: FLUX.1-schnell was distilled at 256; the default of diffusers is 512."""


@dataclass(frozen=True)
class TextEncoder:
    """One text encoder of a model folder."""

    tokenizer: str
    """Class of the tokenizer in transformers."""
    encoder: str
    """Class of the encoder."""
    tokens: int
    """Length of the sequence."""
    number: str = ""
    """End of the names of its folders."""


CLIP = TextEncoder("CLIPTokenizer", "CLIPTextModel", 77)
TEXT_FOLDERS = ("text_encoder", "tokenizer", "text_encoder_2", "tokenizer_2")
"""Folders of FLUX's text encoders, 10 GB."""


@dataclass(frozen=True)
class PromptEmbedding:
    """Text embeddings that FLUX takes."""

    tokens: Float[Tensor, "n d"]
    """T5's last hidden states."""
    pooled: Float[Tensor, " p"]
    """CLIP's pooled output."""

    def to(self, device: torch.device, dtype: torch.dtype) -> "PromptEmbedding":
        """Move to a device and dtype."""
        return PromptEmbedding(self.tokens.to(device, dtype), self.pooled.to(device, dtype))


def prompt_file(base: str) -> Path:
    """Return the file for the embeddings of a base: in its folder, or for a hub id in the user's cache."""
    if Path(base).is_dir():
        return Path(base) / PROMPT_FILE
    return Path.home() / ".cache" / "splatgraft" / "prompts" / hub_id(base).replace("/", "--") / PROMPT_FILE


def find_prompt(base: str, *folders: Path) -> Path:
    """Find the embeddings in the first of `folders` that has them, else in the file of `base` (`prompt_file`)."""
    return next((folder / PROMPT_FILE for folder in folders if (folder / PROMPT_FILE).is_file()), prompt_file(base))


def write_prompt(path: Path, prompt: PromptEmbedding, source: str) -> None:
    """Write the embeddings; `source` names the text encoders, for the file's header."""
    write_tensors(path, {"tokens": prompt.tokens, "pooled": prompt.pooled}, {"text": "", "source": source})


def read_prompt(path: Path, *, tokens_width: int, pooled_width: int) -> PromptEmbedding:
    """Read the embeddings and check the widths of T5's hidden states and CLIP's pooled output."""
    if not path.is_file():
        raise ValueError(
            f"{path}: expected the empty prompt's embeddings, found none; `splatgraft paper train embed` makes them"
        )
    found = read_tensors(path)
    shapes = {name: tuple(tensor.shape) for name, tensor in found.items()}
    if {name: shape[-1:] for name, shape in shapes.items()} != {"tokens": (tokens_width,), "pooled": (pooled_width,)}:
        raise ValueError(f"{path}: expected tokens (n, {tokens_width}) and pooled ({pooled_width},), found {shapes}")
    return PromptEmbedding(found["tokens"], found["pooled"])


def embed_empty_prompt(base: str, *, tokens: int = TOKENS) -> PromptEmbedding:
    """Compute FLUX's embeddings of the empty prompt by the text encoders in a folder or of a hub id.

    Raises:
        ValueError: A tokenizer or an encoder is missing.
    """
    pooled = embed_text(base, CLIP).pooler_output[0]
    states = embed_text(base, TextEncoder("T5TokenizerFast", "T5EncoderModel", tokens, "_2")).last_hidden_state[0]
    return PromptEmbedding(states.float(), pooled.float())


@torch.no_grad()
def embed_text(base: str, encoder: TextEncoder) -> Any:
    """Compute a text encoder's output for the empty prompt, padded to its number of tokens."""
    # imported by name, because pyright would spend a third of its time on types that are not used
    transformers: Any = import_module("transformers")

    def load(kind: str, part: str) -> Any:
        # transformers would make an empty tokenizer from a missing folder
        if Path(base).is_dir() and not (Path(base) / part).is_dir():
            raise ValueError(f"{base}: expected {kind} in {part}/, found no such folder")
        try:
            return getattr(transformers, kind).from_pretrained(base, subfolder=part)
        except (OSError, ValueError) as error:
            found = " ".join(str(error).split())[:160]
            raise ValueError(f"{base}: expected {kind} in {part}/, found {found}") from error

    texts = load(encoder.tokenizer, f"tokenizer{encoder.number}")
    ids = texts([""], padding="max_length", max_length=encoder.tokens, return_tensors="pt").input_ids
    return load(encoder.encoder, f"text_encoder{encoder.number}")(ids)
