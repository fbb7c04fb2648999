"""Reads and writes the compact network's weights: one safetensors file in float16, with the sizes in the header."""

from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from splatgraft.harmonization.compact.network import CompactNetwork, CompactSize
from splatgraft.runtime.files import atomic_write

FORMAT = "splatgraft compact 1"


def write_weights(path: Path, size: CompactSize, state: dict[str, Tensor], notes: dict[str, str]) -> None:
    """Write a network.

    Args:
        path: the .safetensors file.
        size: the network's widths and depths.
        state: the network's state_dict; stored as float16.
        notes: how it was trained, for the header.
    """
    halves = {name: tensor.detach().cpu().to(torch.float16).contiguous() for name, tensor in state.items()}
    with atomic_write(path) as stream:
        stream.write(save(halves, {"format": FORMAT, **size.to_text(), **notes}))


def read_weights(path: Path) -> CompactNetwork:
    """Read a network in evaluation mode, with gradients off.

    Raises:
        ValueError: the file is missing, broken or holds something else.
    """
    try:
        with safe_open(str(path), "pt") as file:
            header = file.metadata() or {}
            state = {name: file.get_tensor(name).float() for name in file.keys()}  # noqa: SIM118 not a dict
    except (OSError, SafetensorError) as error:
        raise ValueError(f"{path}: expected weights of the compact harmoniser, found {error}") from error
    if header.get("format") != FORMAT:
        raise ValueError(f"{path}: expected '{FORMAT}' in its header, found {header.get('format')!r}")
    try:
        network = CompactNetwork(CompactSize.from_text(header))
        network.load_state_dict(state)
    except (KeyError, ValueError, RuntimeError) as error:
        found = str(error).splitlines()[0]
        raise ValueError(f"{path}: expected the tensors of the compact network, found {found}") from error
    return network.eval().requires_grad_(False)
