"""First layers made wider, so that conditions can join the noisy latents (paper, Sec. 4). Knows no network."""

from typing import Literal, TypeVar

import torch
from torch import nn

FirstLayer = Literal["repeat", "zero"]
Layer = TypeVar("Layer", nn.Linear, nn.Conv2d)


def widened(layer: Layer, times: int, init: FirstLayer = "repeat") -> Layer:
    """A layer for `times` as many input channels; its bias and its first weights are those of `layer`.

    `repeat` copies the weights for each further input (the paper, after DEGS), `zero` lets them begin at nothing (as
    in diffusers' control training: the widened network first ignores its conditions).
    """
    weight = layer.weight.detach()
    further = weight if init == "repeat" else torch.zeros_like(weight)
    where = {"device": weight.device, "dtype": weight.dtype, "bias": layer.bias is not None}
    if isinstance(layer, nn.Linear):
        wider = nn.Linear(layer.in_features * times, layer.out_features, **where)
    else:
        shape = {"stride": layer.stride, "padding": layer.padding}
        wider = nn.Conv2d(layer.in_channels * times, layer.out_channels, layer.kernel_size, **shape, **where)  # pyright: ignore
    with torch.no_grad():
        wider.weight.copy_(torch.cat([weight, *[further] * (times - 1)], 1))
        if layer.bias is not None:
            wider.bias.copy_(layer.bias)  # pyright: ignore
    return wider  # pyright: ignore
