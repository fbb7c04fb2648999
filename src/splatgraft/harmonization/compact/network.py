"""The compact network: a U-Net of ConvNeXt blocks (Liu et al. 2022) with global attention at its coarsest level.

It is a bridge of one step from composite to harmonised picture: the flow of the big model (paper, Sec. 4.1) with its
time fixed, the straight path's two ends being prior and truth, so that what it predicts is the whole way. Its heads
begin at zero, where the answer is the prior itself. Knows no pictures' files and no training.
"""

from dataclasses import asdict, dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from splatgraft.harmonization.compact.features import CHANNELS, GRID_BINS, SH_COUNT, Answer

_GAIN, _FOLLOW, _ADDED, _GRID = 2.0, 1.0, 0.25, 0.5
"""Bounds of log gain, of the prior's weight, of added light and of an affine change."""


@dataclass(frozen=True)
class CompactSize:
    """Widths at 1/2, 1/4, 1/8 and 1/16 of the picture, and how many blocks each has going down."""

    widths: tuple[int, int, int, int] = (24, 64, 128, 256)
    blocks: tuple[int, int, int, int] = (1, 2, 3, 2)
    heads: int = 8

    def to_text(self) -> dict[str, str]:
        """For the header of a weights' file."""
        return {name: " ".join(map(str, v)) if isinstance(v, tuple) else str(v) for name, v in asdict(self).items()}

    @staticmethod
    def from_text(text: dict[str, str]) -> "CompactSize":
        """What `to_text` wrote.

        Raises: ValueError, KeyError where it did not.
        """
        a, b, c, d = map(int, text["widths"].split())
        e, f, g, h = map(int, text["blocks"].split())
        return CompactSize((a, b, c, d), (e, f, g, h), int(text["heads"]))


class CompactNetwork(nn.Module):
    """Channels of a view in, an `Answer` out; sides are multiples of 16."""

    def __init__(self, size: CompactSize = CompactSize()) -> None:
        """Random weights but for the heads, which are zero."""
        super().__init__()
        self.size = size
        w, n = size.widths, size.blocks
        self.stem = _Halved(CHANNELS, w[0])
        self.down = nn.ModuleList([_Halved(w[i], w[i + 1]) for i in range(3)])
        self.falling = nn.ModuleList([_blocks(w[i], n[i]) for i in range(4)])
        self.attention = _Attention(w[3], size.heads)
        self.up = nn.ModuleList([_Mixed(w[i + 1], w[i]) for i in range(3)])
        self.rising = nn.ModuleList([_blocks(w[i], min(n[i], 2)) for i in range(3)])
        self.maps = _Mixed(w[0], 12)
        self.by_normal = nn.Linear(2 * w[3], 3 * SH_COUNT)
        self.grid = _Mixed(w[3], 12 * GRID_BINS)
        for head in (self.maps, self.by_normal, self.grid):
            nn.init.zeros_(head.weight)
            nn.init.zeros_(head.bias)

    def forward(self, channels: Float[Tensor, "b 16 h w"]) -> Answer:
        """See `Answer`; maps at half the size, the grid at a sixteenth."""
        x = self.falling[0](self.stem(channels))
        kept = [x]
        for down, blocks in zip(self.down, self.falling[1:], strict=True):
            x = blocks(down(x))
            kept.append(x)
        coarse = x = self.attention(x)
        for i in (2, 1, 0):
            x = F.interpolate(self.up[i](x), size=kept[i].shape[-2:], mode="bilinear", align_corners=False)
            x = self.rising[i](x + kept[i])
        maps = self.maps(x)
        inside = F.adaptive_avg_pool2d(channels[:, 9:10] * 0.5 + 0.5, coarse.shape[-2:])
        on_object = (coarse * inside).sum((2, 3)) / inside.sum((2, 3)).clamp_min(1e-3)
        pooled = torch.cat([on_object, coarse.mean((2, 3))], 1)
        b, _, p, q = coarse.shape
        return Answer(
            object_follow=_FOLLOW * torch.tanh(maps[:, 0:1]),
            object_gain=_bounded(maps[:, 1:4], _GAIN),
            object_sh=_bounded(self.by_normal(pooled), _GAIN).reshape(b, SH_COUNT, 3),
            object_grid=_bounded(self.grid(coarse), _GRID).reshape(b, 12, GRID_BINS, p, q),
            scene_follow=_FOLLOW * torch.tanh(maps[:, 4:5]),
            scene_gain=_bounded(maps[:, 5:8], _GAIN),
            scene_added=_bounded(maps[:, 8:11], _ADDED),
            log_error=maps[:, 11:12] - 3,
        )


def _bounded(x: Tensor, most: float) -> Tensor:
    return most * torch.tanh(x / most)


def _blocks(width: int, count: int) -> nn.Sequential:
    return nn.Sequential(*[_Block(width) for _ in range(count)])


class _Mixed(nn.Linear):
    """A convolution of 1x1 as a product of matrices, which trains three times as fast on a CPU."""

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d h w"]:
        return super().forward(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class _Halved(_Mixed):
    """A convolution of 2x2 with stride 2, in the same way."""

    def __init__(self, channels: int, width: int) -> None:
        super().__init__(4 * channels, width)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d i j"]:
        return super().forward(F.pixel_unshuffle(x, 2))


class _Block(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.wide = nn.Conv2d(width, width, 7, padding=3, groups=width)
        self.norm = nn.LayerNorm(width)
        self.mix = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width))
        self.scale = nn.Parameter(torch.full((width,), 0.1))

    def forward(self, x: Tensor) -> Tensor:
        y = self.norm(self.wide(x).permute(0, 2, 3, 1))
        return x + (self.scale * self.mix(y)).permute(0, 3, 1, 2)


class _Attention(nn.Module):
    """All places of the coarsest level with all others."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width)
        self.query_key_value = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)

    def forward(self, x: Float[Tensor, "b c p q"]) -> Float[Tensor, "b c p q"]:
        b, c, p, q = x.shape
        tokens = x.flatten(2).transpose(1, 2)
        parts = self.query_key_value(self.norm(tokens)).reshape(b, p * q, 3, self.heads, c // self.heads)
        query, key, value = parts.permute(2, 0, 3, 1, 4)
        mixed = F.scaled_dot_product_attention(query, key, value).transpose(1, 2).reshape(b, p * q, c)
        return x + self.out(mixed).transpose(1, 2).reshape(b, c, p, q)
