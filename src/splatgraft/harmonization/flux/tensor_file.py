"""Reads and writes .safetensors files: named tensors with a short description in the header."""

import json
from collections.abc import Mapping
from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from splatgraft.runtime.files import atomic_write


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Read all tensors of a .safetensors file."""
    try:
        return load_file(path)
    except (OSError, SafetensorError) as error:
        raise ValueError(f"{path}: expected a whole .safetensors file, found {one_line(error)}") from error


def write_tensors(path: Path, tensors: Mapping[str, Tensor], about: Mapping[str, str] | None = None) -> None:
    """Write a .safetensors file atomically; `about` goes into its metadata, as JSON."""
    # one key, because safetensors writes several keys in an order that differs from run to run
    metadata = {"splatgraft": json.dumps(dict(about), sort_keys=True)} if about else None
    content = save({name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}, metadata)
    with atomic_write(path) as stream:
        stream.write(content)


def one_line(error: Exception) -> str:
    """Format type and message of an error in one line; the message is cut at 200 characters."""
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
