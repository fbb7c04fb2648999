"""The parts of the FLUX harmoniser and calls into them: autoencoder, transformer, layout of the latents."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from splatgraft.harmonization.flux.prompt import PromptEmbedding

Variant = Literal["image-mask", "image-background"]
"""Second condition beside the composite: the object's mask, or the scene without the object."""
FirstLayer = Literal["repeat", "zero"]
MULTIPLE = 16
"""Factor of the image's sides, pixels: 8 for the autoencoder times 2 for the packing (paper, Sec. 5.3)."""
Layer = TypeVar("Layer", nn.Linear, nn.Conv2d)


@dataclass(frozen=True)
class Autoencoder:
    """A variational autoencoder between images and latents."""

    network: Any
    """An `AutoencoderKL`."""

    @property
    def channels(self) -> int:
        """Channels of the latents."""
        return self.network.config.latent_channels

    @torch.no_grad()
    def encode(self, images: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b c i j"]:
        """Encode sRGB images in [0, 1] to latents of an eighth of the size: the mean of the posterior, not a sample."""
        weight = next(self.network.parameters())
        mean = self.network.encode((images * 2 - 1).to(weight)).latent_dist.mode().float()
        return (mean - self._shift) * self.network.config.scaling_factor

    @torch.no_grad()
    def decode(self, latents: Float[Tensor, "b c i j"]) -> Float[Tensor, "b 3 h w"]:
        """Decode latents to sRGB images in [0, 1]."""
        weight = next(self.network.parameters())
        plain = latents / self.network.config.scaling_factor + self._shift
        return (self.network.decode(plain.to(weight), return_dict=False)[0].float() / 2 + 0.5).clamp(0, 1)

    @property
    def _shift(self) -> float:
        return self.network.config.shift_factor or 0.0


@dataclass(frozen=True)
class FluxNetwork:
    """All parts of the harmoniser, on one device."""

    transformer: Any
    """A `FluxTransformer2DModel` whose first layer takes noisy latent, composite and condition."""
    autoencoder: Autoencoder
    prompt: PromptEmbedding
    variant: Variant
    device: torch.device
    dtype: torch.dtype
    """Number type of the transformer's arithmetic."""
    strengths: tuple[float, ...] = (1.0,)
    """Noise levels of a start for which the modulations are precomputed."""


def velocity(
    transformer: Callable[..., Any],
    latents: Float[Tensor, "b k h w"],
    level: Float[Tensor, " b"],
    prompt: PromptEmbedding,
) -> Float[Tensor, "b c h w"]:
    """Predict the velocity eps - z_0 with a `FluxTransformer2DModel` at noise levels in [0, 1].

    `latents` are the noisy latent, composite and condition, concatenated along channels (paper, Sec. 5); k = 3 c.
    """
    b, _, h, w = latents.shape
    text = prompt.tokens
    tokens = transformer(
        hidden_states=pack(latents),
        timestep=level,
        encoder_hidden_states=text.expand(b, -1, -1),
        pooled_projections=prompt.pooled.expand(b, -1),
        txt_ids=torch.zeros(text.shape[0], 3, device=latents.device),
        img_ids=positions(h, w, latents.device),
        return_dict=False,
    )[0]
    return unpack(tokens, h, w)


def pack(latents: Float[Tensor, "b c h w"]) -> Float[Tensor, "b n d"]:
    """Pack blocks of 2x2 latent pixels into tokens, n = h w / 4, d = 4 c.

    The values of a channel stay together, so that packing commutes with concatenation along channels.
    """
    b, c, h, w = latents.shape
    blocks = latents.reshape(b, c, h // 2, 2, w // 2, 2).permute(0, 2, 4, 1, 3, 5)
    return blocks.reshape(b, h // 2 * (w // 2), c * 4)


def unpack(tokens: Float[Tensor, "b n d"], height: int, width: int) -> Float[Tensor, "b c {height} {width}"]:
    """Invert `pack` for latents of `height` x `width`."""
    b, _, d = tokens.shape
    blocks = tokens.reshape(b, height // 2, width // 2, d // 4, 2, 2).permute(0, 3, 1, 4, 2, 5)
    return blocks.reshape(b, d // 4, height, width)


def positions(height: int, width: int, device: torch.device) -> Float[Tensor, "n 3"]:
    """Compute the position of each token of latents of `height` x `width`: 0 (the text coordinate), row, column."""
    rows, columns = torch.arange(height // 2, device=device), torch.arange(width // 2, device=device)
    row, column = torch.meshgrid(rows, columns, indexing="ij")
    return torch.stack([torch.zeros_like(row), row, column], -1).reshape(-1, 3).float()


def pad_by_reflection(images: Float[Tensor, "b c h w"], multiple: int = MULTIPLE) -> Float[Tensor, "b c i j"]:
    """Pad at the bottom and the right by reflection, repeated where needed, to multiples of `multiple` pixels."""
    h, w = images.shape[-2:]
    rows, columns = (_reflected_indices(size, -size % multiple + size).to(images.device) for size in (h, w))
    return images if len(rows) == h and len(columns) == w else images[..., rows, :][..., columns]


def _reflected_indices(size: int, length: int) -> Tensor:
    """Compute the indices 0, 1, .., size-1, size-2, .., 0, 1, .. up to `length` of them."""
    period = max(2 * size - 2, 1)
    index = torch.arange(length) % period
    return torch.where(index < size, index, period - index)


def widen_layer(layer: Layer, times: int, init: FirstLayer = "repeat") -> Layer:
    """Widen a layer to `times` its input channels; the bias and the weights of the first input stay.

    `repeat` copies the weights to the further inputs (the paper, after DEGS). `zero` sets those to 0, so that the
    widened network ignores its conditions at first (diffusers' control training).
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
