"""The compact network: a U-Net of ConvNeXt blocks (Liu et al. 2022) with global attention at its coarsest level.

It predicts the harmonised view from the prior in one step: the large model's rectified flow (paper, Sec. 5) from the
prior to the ground truth, at a fixed time. The output heads are initialised to zero, with which the result is the prior
itself. Attribute names are the tensor names in weights files and must not change.
"""

from dataclasses import asdict, dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from splatgraft.harmonization.compact.features import CHANNELS, GRID_BINS, SH_COUNT, CompactOutput
from splatgraft.runtime.files import atomic_write

SHIPPED = Path(__file__).parent / "compact.safetensors"
_FORMAT = "splatgraft compact 1"

# bounds of the outputs, either sign; the weights were trained with them
_MAX_LOG_GAIN = 2.0
_MAX_PRIOR_SCALE = 1.0  # largest difference of the prior's factor from 1
_MAX_ADDED_LIGHT = 0.25  # linear light, off the object
_MAX_AFFINE = 0.5  # largest difference of a colour map's entry from the identity
_INITIAL_LOG_ERROR = -3.0  # log of the expected error before training


@dataclass(frozen=True)
class CompactSize:
    """Channels at 1/2, 1/4, 1/8 and 1/16 of the input size, and blocks per level of the encoder."""

    widths: tuple[int, int, int, int] = (24, 64, 128, 256)
    blocks: tuple[int, int, int, int] = (1, 2, 3, 2)
    heads: int = 8

    def to_text(self) -> dict[str, str]:
        """Format for the header of a weights file."""
        return {name: " ".join(map(str, v)) if isinstance(v, tuple) else str(v) for name, v in asdict(self).items()}

    @staticmethod
    def from_text(text: dict[str, str]) -> "CompactSize":
        """Parse what `to_text` wrote."""
        a, b, c, d = map(int, text["widths"].split())
        e, f, g, h = map(int, text["blocks"].split())
        return CompactSize((a, b, c, d), (e, f, g, h), int(text["heads"]))


class CompactNetwork(nn.Module):
    """Network from the channels of a view to a `CompactOutput`; the input's sides are multiples of 16."""

    def __init__(self, size: CompactSize = CompactSize()) -> None:
        """Initialise with random weights and zero output heads."""
        super().__init__()
        self.size = size
        w, n = size.widths, size.blocks
        self.stem = _Downsample(CHANNELS, w[0])
        self.down = nn.ModuleList([_Downsample(w[i], w[i + 1]) for i in range(3)])
        self.falling = nn.ModuleList([_blocks(w[i], n[i]) for i in range(4)])
        self.attention = _SelfAttention(w[3], size.heads)
        self.up = nn.ModuleList([_PointwiseConvolution(w[i + 1], w[i]) for i in range(3)])
        self.rising = nn.ModuleList([_blocks(w[i], min(n[i], 2)) for i in range(3)])
        self.maps = _PointwiseConvolution(w[0], 12)
        self.by_normal = nn.Linear(2 * w[3], 3 * SH_COUNT)
        self.grid = _PointwiseConvolution(w[3], 12 * GRID_BINS)
        for head in (self.maps, self.by_normal, self.grid):
            nn.init.zeros_(head.weight)
            nn.init.zeros_(head.bias)

    def forward(self, channels: Float[Tensor, "b 16 h w"]) -> CompactOutput:
        """Predict the output: maps at half the input size, the grid at a sixteenth."""
        x = self.falling[0](self.stem(channels))
        skips = [x]
        for down, blocks in zip(self.down, self.falling[1:], strict=True):
            x = blocks(down(x))
            skips.append(x)
        coarse = x = self.attention(x)
        for i in (2, 1, 0):
            x = F.interpolate(self.up[i](x), size=skips[i].shape[-2:], mode="bilinear", align_corners=False)
            x = self.rising[i](x + skips[i])
        maps = self.maps(x)
        inside = F.adaptive_avg_pool2d(channels[:, 9:10] * 0.5 + 0.5, coarse.shape[-2:])
        on_object = (coarse * inside).sum((2, 3)) / inside.sum((2, 3)).clamp_min(1e-3)
        pooled = torch.cat([on_object, coarse.mean((2, 3))], 1)
        b, _, p, q = coarse.shape
        return CompactOutput(
            object_prior_scale=_MAX_PRIOR_SCALE * torch.tanh(maps[:, 0:1]),
            object_gain=_bounded(maps[:, 1:4], _MAX_LOG_GAIN),
            object_sh=_bounded(self.by_normal(pooled), _MAX_LOG_GAIN).reshape(b, SH_COUNT, 3),
            object_grid=_bounded(self.grid(coarse), _MAX_AFFINE).reshape(b, 12, GRID_BINS, p, q),
            scene_prior_scale=_MAX_PRIOR_SCALE * torch.tanh(maps[:, 4:5]),
            scene_gain=_bounded(maps[:, 5:8], _MAX_LOG_GAIN),
            scene_added=_bounded(maps[:, 8:11], _MAX_ADDED_LIGHT),
            log_error=maps[:, 11:12] + _INITIAL_LOG_ERROR,
        )


def _bounded(x: Tensor, bound: float) -> Tensor:
    return bound * torch.tanh(x / bound)


def _blocks(width: int, count: int) -> nn.Sequential:
    return nn.Sequential(*[_ConvNeXtBlock(width) for _ in range(count)])


class _PointwiseConvolution(nn.Linear):
    """A 1x1 convolution as a matrix product, which trains three times as fast on a CPU."""

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d h w"]:
        return super().forward(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class _Downsample(_PointwiseConvolution):
    """A 2x2 convolution with stride 2 as a matrix product."""

    def __init__(self, channels: int, width: int) -> None:
        super().__init__(4 * channels, width)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d i j"]:
        return super().forward(F.pixel_unshuffle(x, 2))


class _ConvNeXtBlock(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.wide = nn.Conv2d(width, width, 7, padding=3, groups=width)
        self.norm = nn.LayerNorm(width)
        self.mix = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width))
        self.scale = nn.Parameter(torch.full((width,), 0.1))

    def forward(self, x: Tensor) -> Tensor:
        y = self.norm(self.wide(x).permute(0, 2, 3, 1))
        return x + (self.scale * self.mix(y)).permute(0, 3, 1, 2)


class _SelfAttention(nn.Module):
    """Self-attention over all positions of the coarsest level."""

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


def write_weights(path: Path, size: CompactSize, state: dict[str, Tensor], notes: dict[str, str]) -> None:
    """Write a network's state_dict as float16; `notes` on its training go into the header."""
    halves = {name: tensor.detach().cpu().to(torch.float16).contiguous() for name, tensor in state.items()}
    with atomic_write(path) as stream:
        stream.write(save(halves, {"format": _FORMAT, **size.to_text(), **notes}))


def read_weights(path: Path) -> CompactNetwork:
    """Read a network in evaluation mode, with gradients off."""
    try:
        with safe_open(str(path), "pt") as file:
            header = file.metadata() or {}
            state = {name: file.get_tensor(name).float() for name in file.keys()}  # noqa: SIM118 not a dict
    except (OSError, SafetensorError) as error:
        raise ValueError(f"{path}: expected weights of the compact harmoniser, found {error}") from error
    if header.get("format") != _FORMAT:
        raise ValueError(f"{path}: expected '{_FORMAT}' in its header, found {header.get('format')!r}")
    try:
        network = CompactNetwork(CompactSize.from_text(header))
        network.load_state_dict(state)
    except (KeyError, ValueError, RuntimeError) as error:
        found = str(error).splitlines()[0]
        raise ValueError(f"{path}: expected the tensors of the compact network, found {found}") from error
    return network.eval().requires_grad_(False)
