"""IC-Light with background condition (Zhang et al. 2024): Stable Diffusion 1.5 conditioned on object and background.

An own implementation on diffusers with the settings of the authors' demo (gradio_demo_bg.py of their repository): its
sampler, steps, guidance, prompts and value range. Its second pass, which enlarges a picture of 512 x 640 by half, is
left out: views have about the size of its first pass already. Tested on tiny random networks, against diffusers' own
pipeline; untested with the real weights.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from splatgraft.harmonization.flux.latents import pad_by_reflection
from splatgraft.harmonization.flux.network import Autoencoder
from splatgraft.harmonization.flux.sampling import noise
from splatgraft.harmonization.flux.weights.diffusers_library import dpm_solver_class, unet_class
from splatgraft.harmonization.flux.weights.folder import find_part, local_folder, weights_variant
from splatgraft.harmonization.flux.weights.loading import load_autoencoder
from splatgraft.harmonization.flux.weights.tensor_file import read_tensors
from splatgraft.harmonization.flux.weights.text_encoders import IC_LIGHT_PROMPT_FILE
from splatgraft.harmonization.flux.weights.widening import widen_layer
from splatgraft.harmonization.interface import Harmonized, HarmonizerInputs
from splatgraft.harmonization.options import HarmonizerContext, ICLightOptions

_BASE = "stablediffusionapi/realistic-vision-v51"
_MULTIPLE = 64
"""Pixels: 8 of the autoencoder times 8 of the UNet."""
_GREY = 127 / 255
"""sRGB colour around the object in the foreground image."""
_RANGE = 255 / 254
"""Factor that makes the grey exactly 0 for the autoencoder, whose input is 2 x - 1 here and 2 x 255 / 254 - 1 there."""


@dataclass(frozen=True)
class PublishedSettings:
    """Settings of the authors' demo with a background (gradio_demo_bg.py, version of 2024)."""

    steps: int = 20
    """Steps of DPM-Solver++ (2M, SDE) with Karras' noise levels."""
    guidance: float = 7.0
    """Of classifier-free guidance."""
    first_beta: float = 0.00085
    last_beta: float = 0.012

    def scheduler(self) -> Any:
        """The sampler; its betas are linear, as the demo names no schedule for them."""
        return dpm_solver_class()(
            num_train_timesteps=1000,
            beta_start=self.first_beta,
            beta_end=self.last_beta,
            algorithm_type="sde-dpmsolver++",
            use_karras_sigmas=True,
            steps_offset=1,
        )


PUBLISHED = PublishedSettings()


class ICLight:
    """The loaded network."""

    def __init__(self, unet: Any, autoencoder: Autoencoder, prompts: Float[Tensor, "2 n d"], seed: int) -> None:
        """Use a UNet whose first layer takes noisy latent, foreground and background.

        Args:
            unet: A `UNet2DConditionModel`.
            autoencoder: That of Stable Diffusion 1.5.
            prompts: Embeddings of the negative and of the positive prompt.
            seed: Of the noise; the same for all views.
        """
        self._unet, self._autoencoder, self._prompts, self._seed = unet, autoencoder, prompts, seed

    @torch.no_grad()
    def harmonize(self, view: HarmonizerInputs) -> Harmonized:
        """Generate the view from the object on grey and the background."""
        height, width = view.mask.shape
        mask = view.mask[..., None]
        images = torch.stack([view.composite * mask + _GREY * (1 - mask), view.background]).permute(0, 3, 1, 2)
        device = next(self._unet.parameters()).device
        latents = self._autoencoder.encode(pad_by_reflection(images * _RANGE, _MULTIPLE).to(device))
        condition = torch.cat([latents[:1], latents[1:]], 1)
        clean = self._sample(condition, noise(tuple(latents.shape[1:]), self._seed).to(device)[None])  # pyright: ignore
        image = self._autoencoder.decode(clean)[0, :, :height, :width].permute(1, 2, 0).cpu()
        return Harmonized(image)

    def _sample(self, condition: Float[Tensor, "1 k h w"], start: Float[Tensor, "1 c h w"]) -> Float[Tensor, "1 c h w"]:
        scheduler = PUBLISHED.scheduler()
        scheduler.set_timesteps(PUBLISHED.steps, device=start.device)
        latents, generator = start * scheduler.init_noise_sigma, torch.Generator().manual_seed(self._seed)
        for step in scheduler.timesteps:
            noisy = scheduler.scale_model_input(latents, step)
            joined = torch.cat([noisy, condition], 1).to(self._prompts.dtype).expand(2, -1, -1, -1)
            without, told = self._unet(joined, step, self._prompts, return_dict=False)[0].float().chunk(2)
            predicted = without + PUBLISHED.guidance * (told - without)
            latents = scheduler.step(predicted, step, latents, generator=generator, return_dict=False)[0]
        return latents


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
    base = local_folder(options.base or _BASE, context.say, parts=("unet", "vae"))
    prompts = _read_prompts(Path(options.weights).parent, base)
    unet = unet_class().from_pretrained(base / "unet", variant=weights_variant(base / "unet"))
    add_difference(unet, Path(options.weights))
    autoencoder = load_autoencoder(find_part("vae", base))
    dtype = torch.float16 if context.device.type == "cuda" else torch.float32
    unet.to(context.device, dtype).eval().requires_grad_(False)
    autoencoder.network.to(context.device).eval().requires_grad_(False)
    return ICLight(unet, autoencoder, prompts.to(context.device, dtype), options.seed)


def _read_prompts(beside: Path, base: Path) -> Float[Tensor, "2 n d"]:
    """Embeddings of the negative and the positive prompt, from beside the weights or from the base."""
    path = next((path for path in (beside / IC_LIGHT_PROMPT_FILE, base / IC_LIGHT_PROMPT_FILE) if path.is_file()), None)
    if path is None:
        raise ValueError(
            f"{beside / IC_LIGHT_PROMPT_FILE}: expected IC-Light's prompt embeddings, found none; `splatgraft train "
            f"embed {beside / IC_LIGHT_PROMPT_FILE} --kind ic-light --base {_BASE}` makes them once"
        )
    found = read_tensors(path)
    shapes = {name: tuple(tensor.shape) for name, tensor in found.items()}
    if set(found) != {"positive", "negative"} or len(set(shapes.values())) != 1 or found["positive"].ndim != 2:
        raise ValueError(f"{path}: expected positive and negative embeddings of one shape (n, d), found {shapes}")
    return torch.stack([found["negative"], found["positive"]])


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
