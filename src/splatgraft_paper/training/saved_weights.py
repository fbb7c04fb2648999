"""Writes trained weights as diffusers' own folders."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from splatgraft.runtime.atomic_folder import atomic_folder


def save_weights(model: Any, config: Mapping[str, Any], state: Mapping[str, Tensor], folder: Path) -> None:
    """Write exactly these weights by the library's own `save_pretrained`.

    It writes what a model holds and takes no other weights. So an empty model of the same config receives them first:
    the network in training may be split over processes, and it holds the last weights, not their average.

    Args:
        model: the diffusers class.
        config: of the network.
        state: every weight of it, by name.
        folder: is replaced when all is written.
    """
    with torch.device("meta"):
        empty = model.from_config(config)
    empty.load_state_dict(state, strict=True, assign=True)
    with atomic_folder(folder) as new:
        empty.save_pretrained(new)
