"""IC-Light with background condition (Zhang et al. 2024): Stable Diffusion 1.5 conditioned on object and background.

An own implementation on diffusers: the empty prompt's embeddings from a file, DDIM sampling without guidance. Tested
on tiny random networks; untested with the real weights.
"""

from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from splatgraft.harmonization.flux.ddim import NoiseSchedule, ddim
from splatgraft.harmonization.flux.empty_prompt import PROMPT_FILE
from splatgraft.harmonization.flux.latents import pad_by_reflection
from splatgraft.harmonization.flux.network import Autoencoder
from splatgraft.harmonization.flux.sampling import noise
from splatgraft.harmonization.flux.weights.diffusers_library import unet_class
from splatgraft.harmonization.flux.weights.folder import find_part, local_folder
from splatgraft.harmonization.flux.weights.loading import load_autoencoder
from splatgraft.harmonization.flux.weights.tensor_file import read_tensors
from splatgraft.harmonization.flux.weights.widening import widen_layer
from splatgraft.harmonization.interface import Harmonized, HarmonizerInputs
from splatgraft.harmonization.options import HarmonizerContext, ICLightOptions

_BASE = "stablediffusionapi/realistic-vision-v51"
_STEPS = 20
"""DDIM steps, set by hand."""
_MULTIPLE = 64
"""Pixels: 8 of the autoencoder times 8 of the UNet."""
_GREY = 127 / 255
"""sRGB colour around the object in the foreground image, as in the authors' code."""


class ICLight:
    """The loaded network."""

    def __init__(self, unet: Any, autoencoder: Autoencoder, tokens: Float[Tensor, "n d"], seed: int) -> None:
        """Use a UNet whose first layer takes noisy latent, foreground and background."""
        self._unet, self._autoencoder, self._tokens, self._seed = unet, autoencoder, tokens, seed

    @torch.no_grad()
    def harmonize(self, view: HarmonizerInputs) -> Harmonized:
        """Generate the view from the object on grey and the background."""
        height, width = view.mask.shape
        mask = view.mask[..., None]
        images = torch.stack([view.composite * mask + _GREY * (1 - mask), view.background]).permute(0, 3, 1, 2)
        device = next(self._unet.parameters()).device
        latents = self._autoencoder.encode(pad_by_reflection(images, _MULTIPLE).to(device))
        condition = torch.cat([latents[:1], latents[1:]], 1)

        def predict(noisy: Tensor, step: int) -> Tensor:
            joined = torch.cat([noisy, condition], 1).to(self._tokens.dtype)
            return self._unet(joined, step, self._tokens[None], return_dict=False)[0].float()

        start = noise(tuple(latents.shape[1:]), self._seed).to(device)[None]  # pyright: ignore
        clean = ddim(predict, start, NoiseSchedule.stable_diffusion(), steps=_STEPS, predicts="noise")
        image = self._autoencoder.decode(clean)[0, :, :height, :width].permute(1, 2, 0).cpu()
        return Harmonized(image)


def load_ic_light(options: ICLightOptions, context: HarmonizerContext) -> ICLight:
    """The base model and IC-Light's difference to it, `iclight_sd15_fbc.safetensors`.

    Raises:
        ValueError: a file is missing or has other shapes.
    """
    if options.weights is None or not Path(options.weights).is_file():
        raise ValueError(
            "harmonizer ic-light: expected --weights iclight_sd15_fbc.safetensors (hub: lllyasviel/ic-light), "
            f"found {options.weights or 'none'}"
        )
    base = local_folder(options.base or _BASE, context.say)
    beside = Path(options.weights).parent
    tokens = read_tensors(find_part(PROMPT_FILE, base, beside))["tokens"]
    unet = unet_class().from_pretrained(base / "unet")
    add_difference(unet, Path(options.weights))
    autoencoder = load_autoencoder(find_part("vae", base))
    dtype = torch.float16 if context.device.type == "cuda" else torch.float32
    unet.to(context.device, dtype).eval().requires_grad_(False)
    autoencoder.network.to(context.device).eval().requires_grad_(False)
    return ICLight(unet, autoencoder, tokens.to(context.device, dtype), options.seed)


def add_difference(unet: Any, path: Path) -> None:
    """Widen the first layer with zeros and add the file's tensors to all weights, in place.

    Raises:
        ValueError: the file belongs to another network.
    """
    unet.conv_in = widen_layer(unet.conv_in, 3, "zero")
    unet.register_to_config(in_channels=unet.conv_in.in_channels)
    difference, weights = read_tensors(path), unet.state_dict()
    for name, weight in weights.items():
        found = difference.get(name)
        if found is None or found.shape != weight.shape:
            shape = "none" if found is None else tuple(found.shape)
            raise ValueError(f"{path}: expected {name} of {tuple(weight.shape)}, found {shape}")
    with torch.no_grad():
        for name, parameter in nn.Module.named_parameters(unet):
            parameter.add_(difference[name].to(parameter))
