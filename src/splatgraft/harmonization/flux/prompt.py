"""Text embeddings of the empty prompt, read from a file so that no text encoder is loaded."""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.harmonization.flux.tensor_file import read_tensors, write_tensors
from splatgraft.runtime.hub import hub_id

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
