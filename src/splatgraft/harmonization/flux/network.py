"""The loaded FLUX harmoniser: transformer, autoencoder and prompt embeddings, and the calls into them."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.harmonization.flux.baked_modulation import GUIDANCE
from splatgraft.harmonization.flux.empty_prompt import PromptEmbedding
from splatgraft.harmonization.flux.latents import pack, positions, unpack
from splatgraft.harmonization.flux.weights.folder import Variant


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
        """Encode sRGB images in [0, 1] to latents of an eighth of the size; the mean of the posterior, not a sample."""
        weight = next(self.network.parameters())
        mean = self.network.encode((images * 2 - 1).to(weight)).latent_dist.mode().float()
        return (mean - _shift(self.network)) * self.network.config.scaling_factor

    @torch.no_grad()
    def decode(self, latents: Float[Tensor, "b c i j"]) -> Float[Tensor, "b 3 h w"]:
        """Decode latents to sRGB images in [0, 1]."""
        weight = next(self.network.parameters())
        plain = latents / self.network.config.scaling_factor + _shift(self.network)
        return (self.network.decode(plain.to(weight), return_dict=False)[0].float() / 2 + 0.5).clamp(0, 1)


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
    """Of the transformer's arithmetic."""
    steps: int = 4
    """Sampling steps that its modulations are precomputed for."""
    strengths: tuple[float, ...] = (1.0,)
    """Noise levels to start from that its modulations are precomputed for."""


def velocity(
    transformer: Any,
    latents: Float[Tensor, "b k h w"],
    level: Float[Tensor, " b"],
    prompt: PromptEmbedding,
) -> Float[Tensor, "b c h w"]:
    """Predict the velocity eps - z_0.

    Args:
        transformer: a `FluxTransformer2DModel`; one that was distilled with guidance is told `GUIDANCE`.
        latents: noisy latent, composite and condition, concatenated along channels (paper, Sec. 5); k = 3 c.
        level: noise levels in [0, 1].
        prompt: text embeddings, the same for all samples.
    """
    b, _, h, w = latents.shape
    text = prompt.tokens
    config = _unwrapped(transformer).config
    guidance = torch.full((b,), GUIDANCE, device=latents.device) if config.guidance_embeds else None
    tokens = transformer(
        hidden_states=pack(latents),
        timestep=level,
        guidance=guidance,
        encoder_hidden_states=text.expand(b, -1, -1),
        pooled_projections=prompt.pooled.expand(b, -1),
        txt_ids=torch.zeros(text.shape[0], 3, device=latents.device),
        img_ids=positions(h, w, latents.device),
        return_dict=False,
    )[0]
    return unpack(tokens, h, w)


def _unwrapped(network: Any) -> Any:
    """The network within DistributedDataParallel and other wrappers of several processes."""
    while hasattr(network, "module"):
        network = network.module
    return network


def _shift(network: Any) -> float:
    return network.config.shift_factor or 0.0
