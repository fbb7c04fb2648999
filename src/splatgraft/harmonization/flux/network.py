"""A loaded harmoniser: transformer, autoencoder and the empty prompt; pictures to latents, velocity, and back.

Knows nothing about folders, memory or views.
"""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.harmonization.flux.empty_prompt import Prompt
from splatgraft.harmonization.flux.latents import pack, positions, unpack
from splatgraft.harmonization.flux.weights.folder import Variant


@dataclass(frozen=True)
class Autoencoder:
    """FLUX's pictures-to-latents network."""

    network: Any
    """An `AutoencoderKL`."""

    @property
    def channels(self) -> int:
        """Of the latents."""
        return self.network.config.latent_channels

    @torch.no_grad()
    def encode(self, images: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b c i j"]:
        """Latents (an eighth of the size) of sRGB pictures in [0, 1]: the mean, which needs no noise."""
        weight = next(self.network.parameters())
        mean = self.network.encode((images * 2 - 1).to(weight)).latent_dist.mode().float()
        return (mean - _shift(self.network)) * self.network.config.scaling_factor

    @torch.no_grad()
    def decode(self, latents: Float[Tensor, "b c i j"]) -> Float[Tensor, "b 3 h w"]:
        """sRGB pictures in [0, 1] of latents."""
        weight = next(self.network.parameters())
        plain = latents / self.network.config.scaling_factor + _shift(self.network)
        return (self.network.decode(plain.to(weight), return_dict=False)[0].float() / 2 + 0.5).clamp(0, 1)


@dataclass(frozen=True)
class FluxNetwork:
    """All parts of one harmoniser, on one device."""

    transformer: Any
    """A `FluxTransformer2DModel` whose first layer takes noisy latent, composite and condition."""
    autoencoder: Autoencoder
    prompt: Prompt
    variant: Variant
    device: torch.device
    dtype: torch.dtype
    """Of the arithmetic in the transformer."""


def velocity(
    transformer: Any,
    latents: Float[Tensor, "b k h w"],
    level: Float[Tensor, " b"],
    prompt: Prompt,
) -> Float[Tensor, "b c h w"]:
    """eps - z_0 as the transformer sees it, at noise levels in [0, 1].

    `latents`: noisy latent, composite and condition joined along channels (paper, Sec. 4); k = 3 c.
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


def _shift(network: Any) -> float:
    return network.config.shift_factor or 0.0
