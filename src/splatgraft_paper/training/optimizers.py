"""Adam, or Adam with 8-bit states (the only module that imports bitsandbytes)."""

from collections.abc import Iterable
from importlib.util import find_spec

import torch
from torch import nn


def make_optimizer(kind: str, parameters: Iterable[nn.Parameter], rate: float) -> torch.optim.Optimizer:
    """Make Adam without weight decay.

    Args:
        kind: adam or adam8bit.
        parameters: what is trained.
        rate: learning rate.

    Raises:
        ValueError: adam8bit is requested and bitsandbytes is not installed.
    """
    if kind == "adam":
        return torch.optim.Adam(list(parameters), lr=rate)
    if find_spec("bitsandbytes") is None:
        raise ValueError("--optimizer adam8bit: expected bitsandbytes (pip install bitsandbytes), found none")
    import bitsandbytes

    return bitsandbytes.optim.Adam8bit(list(parameters), lr=rate)
