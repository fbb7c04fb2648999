"""Adam, or Adam with states of 8 bits (the only importer of bitsandbytes). Knows no network."""

from collections.abc import Iterable
from importlib.util import find_spec

import torch
from torch import nn


def make_optimizer(kind: str, parameters: Iterable[nn.Parameter], rate: float) -> torch.optim.Optimizer:
    """Adam on those parameters, as published (no weight decay).

    Raises: ValueError where adam8bit is asked for and bitsandbytes is missing.
    """
    if kind == "adam":
        return torch.optim.Adam(list(parameters), lr=rate)
    if find_spec("bitsandbytes") is None:
        raise ValueError("--optimizer adam8bit: expected bitsandbytes (pip install bitsandbytes), found none")
    import bitsandbytes

    return bitsandbytes.optim.Adam8bit(list(parameters), lr=rate)
