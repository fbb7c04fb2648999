"""The empty prompt's text embeddings, read from a file so that no text encoder is loaded."""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.harmonization.flux.weights.tensor_file import read_tensors, write_tensors

PROMPT_FILE = "empty_prompt.safetensors"


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


def write_prompt(path: Path, prompt: PromptEmbedding, source: str) -> None:
    """Write the embeddings; `source` names the text encoders, for the file's header."""
    write_tensors(path, {"tokens": prompt.tokens, "pooled": prompt.pooled}, {"text": "", "source": source})


def read_prompt(path: Path, *, tokens_width: int, pooled_width: int) -> PromptEmbedding:
    """Read the embeddings and check their widths.

    Args:
        path: file of `write_prompt`.
        tokens_width: width of T5's hidden states that the network takes.
        pooled_width: width of CLIP's pooled output that the network takes.

    Raises:
        ValueError: the file is missing, broken or made by other text encoders.
    """
    if not path.is_file():
        raise ValueError(
            f"{path}: expected the empty prompt's embeddings, found none; `splatgraft train embed {path} --base "
            "black-forest-labs/FLUX.1-schnell` makes them once"
        )
    found = read_tensors(path)
    shapes = {name: tuple(tensor.shape) for name, tensor in found.items()}
    if set(found) != {"tokens", "pooled"} or found["tokens"].ndim != 2 or found["pooled"].ndim != 1:
        raise ValueError(f"{path}: expected tokens (n, {tokens_width}) and pooled ({pooled_width},), found {shapes}")
    if found["tokens"].shape[1] != tokens_width or found["pooled"].shape[0] != pooled_width:
        raise ValueError(f"{path}: expected tokens (n, {tokens_width}) and pooled ({pooled_width},), found {shapes}")
    return PromptEmbedding(found["tokens"], found["pooled"])
