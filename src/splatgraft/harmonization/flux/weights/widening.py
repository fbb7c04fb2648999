"""Widens a network's first layer, so that it also takes condition latents (paper, Sec. 5)."""

from typing import Literal, TypeVar

import torch
from torch import nn

FirstLayer = Literal["repeat", "zero"]
Layer = TypeVar("Layer", nn.Linear, nn.Conv2d)


def widen_layer(layer: Layer, times: int, init: FirstLayer = "repeat") -> Layer:
    """Make a layer for `times` as many input channels, with the same bias and the same weights for the first input.

    Args:
        layer: the first layer.
        times: number of inputs, each with as many channels as `layer` takes.
        init: weights of the further inputs: `repeat` copies them (the paper, after DEGS), `zero` sets them to 0, so
            that the widened network ignores its conditions at first (diffusers' control training).
    """
    weight = layer.weight.detach()
    further = weight if init == "repeat" else torch.zeros_like(weight)
    settings = {"device": weight.device, "dtype": weight.dtype, "bias": layer.bias is not None}
    if isinstance(layer, nn.Linear):
        wider = nn.Linear(layer.in_features * times, layer.out_features, **settings)
    else:
        shape = {"stride": layer.stride, "padding": layer.padding}
        wider = nn.Conv2d(layer.in_channels * times, layer.out_channels, layer.kernel_size, **shape, **settings)  # pyright: ignore
    with torch.no_grad():
        wider.weight.copy_(torch.cat([weight, *[further] * (times - 1)], 1))
        if layer.bias is not None:
            wider.bias.copy_(layer.bias)  # pyright: ignore
    return wider  # pyright: ignore
