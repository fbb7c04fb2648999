"""A small network that corrects the estimated light at a place from what is known there.

Input is the description of a place. Output is a factor per direction and colour, a lamp that the estimate may have
missed, and how uncertain the corrected irradiance is. All brightness is relative to that of the surfaces around, so
that another exposure changes nothing; columns wrap around, so that a turn about the up axis turns the output.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from splatgraft.relighting.light.place_description import (
    COLUMNS,
    MAPS,
    NUMBERS,
    ROWS,
    PlaceDescription,
    cell_directions,
    cell_solid_angles,
)

_BRIGHTNESSES = (
    "red",
    "green",
    "blue",
    "estimated",
    "estimated unseen",
    "estimated clipped",
    "surfaces' brightness",
)
"""Maps in absolute units: they become relative to the surfaces around."""
_LEVEL = NUMBERS.index("log brightness of surfaces")
_RANGE = 8.0
"""Stops around that level within which inputs are told apart."""
_MOST = 3.0
"""Stops by which a direction is corrected at most."""
_NO_LAMP = -6.0
"""Log2 of the lamp's irradiance over the estimated mean, from which training starts."""
_NO_LIGHT = 1e-9
"""Radiance of a lamp that is not there, over the estimated mean."""
_STRONGEST = 2.0
"""The same of the strongest lamp."""
_UNSURE = 3.0
"""Log2 of the factor by which an uncertainty may be smaller or larger than half a stop."""
_HEIGHTS = 2
"""Maps of where a cell is: sine and cosine of its height."""


@dataclass(frozen=True)
class LightNetworkSize:
    """Size of the network."""

    channels: int = 24
    blocks: int = 4


@dataclass(frozen=True)
class LightCorrection:
    """What the network says of b places."""

    gain: Float[Tensor, "b 12 24 3"]
    """Log2 of the factor of the radiance."""
    lamp: Float[Tensor, "b 12 24"]
    """Log2 of the radiance of a lamp in each cell, over the estimated mean radiance; white."""
    log_sd: Float[Tensor, "b 3"]
    """Log2 of standard deviations, stops: of the irradiance's level, of its change over normals, of its tint."""

    def weakened(self, share: float) -> "LightCorrection":
        """A share of the correction, in [0, 1]; as uncertain as the whole."""
        lamp = (share * self.lamp.exp2()).clamp_min(_NO_LIGHT).log2()
        return LightCorrection(gain=share * self.gain, lamp=lamp, log_sd=self.log_sd)


class LightNetwork(nn.Module):
    """The network; see the module."""

    def __init__(self, size: LightNetworkSize = LightNetworkSize()) -> None:
        """Make one with random weights whose correction is near nothing."""
        super().__init__()
        c = size.channels
        self.size = size
        self.first = nn.Conv2d(len(MAPS) + _HEIGHTS + len(NUMBERS) - 1, c, 1)
        self.blocks = nn.ModuleList(_Block(c, dilation) for dilation in (1, 2, 3, 4)[: size.blocks])
        self.cells = nn.Sequential(nn.Conv2d(2 * c, c, 1), nn.GELU(), nn.Conv2d(c, 2, 1))
        self.whole = nn.Sequential(nn.Linear(c + len(NUMBERS) - 1, c), nn.GELU(), nn.Linear(c, 7))
        for last in (self.cells[-1], self.whole[-1]):
            assert isinstance(last, nn.Conv2d | nn.Linear)
            last.weight.data *= 0.1
            assert last.bias is not None
            last.bias.data.zero_()

    def forward(self, inputs: Float[Tensor, "b f 12 24"]) -> LightCorrection:
        """Correct the light at places, of which `network_inputs` made the inputs."""
        x = self.first(inputs)
        for block in self.blocks:
            x = block(x)
        areas = cell_solid_angles().to(x)
        mean = (x * areas).sum((2, 3)) / areas.sum()
        cells = self.cells(torch.cat([x, mean[..., None, None].expand_as(x)], 1))
        whole = self.whole(torch.cat([mean, inputs[:, 1 - len(NUMBERS) :, 0, 0]], 1))
        level, red, blue, lamp = whole[:, :4].unbind(1)
        tint = torch.stack([red, torch.zeros_like(red), blue], 1)
        gray = _MOST * torch.tanh((cells[:, 0] + level[:, None, None]) / _MOST)
        share = cells[:, 1].flatten(1).log_softmax(1).reshape(-1, ROWS, COLUMNS) / torch.tensor(2.0).log()
        strength = (lamp + _NO_LAMP).clamp_max(_STRONGEST)[:, None, None]
        return LightCorrection(
            gain=gray[..., None] + tint[:, None, None],
            lamp=strength + share - (areas / areas.sum()).log2(),
            log_sd=_UNSURE * torch.tanh(whole[:, 4:] / _UNSURE) - 1,
        )


class _Block(nn.Module):
    """A residual block; columns wrap around."""

    def __init__(self, channels: int, dilation: int) -> None:
        super().__init__()
        self.dilation = dilation
        self.norm = nn.GroupNorm(1, channels)
        self.around = nn.Conv2d(channels, channels, 3, dilation=dilation)
        self.mix = nn.Conv2d(channels, channels, 1)

    def forward(self, x: Float[Tensor, "b c 12 24"]) -> Float[Tensor, "b c 12 24"]:
        d = self.dilation
        wrapped = F.pad(F.pad(self.norm(x), (d, d, 0, 0), mode="circular"), (0, 0, d, d), mode="replicate")
        return x + self.mix(F.gelu(self.around(wrapped)))


def network_inputs(place: PlaceDescription) -> Float[Tensor, "f 12 24"]:
    """The description as the network takes it: maps, where each cell is, numbers; all about in [-2, 2]."""
    level = place.numbers[_LEVEL]
    maps = place.maps.clone()
    for name in _BRIGHTNESSES:
        index = MAPS.index(name)
        maps[index] = (maps[index] - level).clamp(-_RANGE, _RANGE) / 4
    height = cell_directions()[..., 2]
    numbers = torch.cat([place.numbers[:_LEVEL], place.numbers[_LEVEL + 1 :]]).clamp(-4, 4)
    return torch.cat(
        [
            maps,
            height[None],
            (1 - height**2).sqrt()[None],
            numbers[:, None, None].expand(-1, ROWS, COLUMNS),
        ]
    )


def corrected_radiance(correction: LightCorrection, radiance: Float[Tensor, "b 12 24 3"]) -> Float[Tensor, "b 12 24 3"]:
    """The radiance of the cells after the correction, linear rgb."""
    areas = cell_solid_angles().to(radiance)
    mean = (radiance.mean(-1) * areas).sum((1, 2), keepdim=True) / areas.sum()
    return radiance * correction.gain.exp2() + (mean * correction.lamp.exp2())[..., None]
