"""The empty prompt's embeddings, kept in a file so that no text encoder is loaded. Knows nothing about images."""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.harmonization.flux.weights.library import read_tensors, write_tensors

PROMPT_FILE = "empty_prompt.safetensors"


@dataclass(frozen=True)
class Prompt:
    """What FLUX is told of a text."""

    tokens: Float[Tensor, "n d"]
    """T5's last hidden states."""
    pooled: Float[Tensor, " p"]
    """CLIP's pooled output."""

    def to(self, device: torch.device, dtype: torch.dtype) -> "Prompt":
        """The same elsewhere."""
        return Prompt(self.tokens.to(device, dtype), self.pooled.to(device, dtype))


def write_prompt(path: Path, prompt: Prompt, source: str) -> None:
    """Write the file; `source` names the text encoders."""
    write_tensors(path, {"tokens": prompt.tokens, "pooled": prompt.pooled}, {"text": "", "source": source})


def read_prompt(path: Path, *, tokens_width: int, pooled_width: int) -> Prompt:
    """The embeddings, checked against the widths that a network wants.

    Raises: ValueError where the file is missing, broken or made by other text encoders.
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
    return Prompt(found["tokens"], found["pooled"])
