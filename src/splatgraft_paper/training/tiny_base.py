"""A base model of three million parameters in FLUX's layout, of the same classes, for the recipe `tiny`.

The transformer is random. The autoencoder is trained for a few minutes on the pictures of the pairs, because a random
one cannot reproduce a picture. Its latents are then scaled to mean 0 and deviation 1, as FLUX's are.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.harmonization.flux.loading import diffusers_library
from splatgraft.harmonization.flux.prompt import PROMPT_FILE, PromptEmbedding, write_prompt
from splatgraft.runtime.files import atomic_folder
from splatgraft.runtime.progress import Progress

_LATENTS, _TEXT, _POOLED = 16, 32, 32  # channels of latents, text tokens and the pooled text
_MEAN_STEPS = 50  # steps over which the displayed error is averaged


@dataclass(frozen=True)
class TinyBaseOptions:
    """Size and training of the tiny base model."""

    heads: int = 4
    head_width: int = 40
    double_blocks: int = 2
    single_blocks: int = 4
    autoencoder_widths: tuple[int, ...] = (24, 48, 64)
    """Channels of the autoencoder's levels, multiples of 8; each level but the first halves the picture."""
    autoencoder_steps: int = 4000
    """Steps of the autoencoder, on parts of pictures with half their width and height."""
    batch: int = 8
    rate: float = 5e-4
    """Learning rate of Adam, falling to zero along a cosine; with 2e-3 the autoencoder never learns colours."""
    seed: int = 0

    @property
    def pixels_per_latent(self) -> int:
        """Pixels per latent along each side."""
        return 2 ** (len(self.autoencoder_widths) - 1)


def write_tiny_base(
    folder: Path,
    pictures: Sequence[Tensor],
    options: TinyBaseOptions,
    *,
    say: Callable[[str], None],
    progress: Progress,
) -> None:
    """Train the autoencoder on pictures (3 h w) of one size, sRGB in [0, 1], and write the base model's folder."""
    torch.manual_seed(options.seed)
    autoencoder = _autoencoder(options.autoencoder_widths)
    stacked = torch.stack(list(pictures)) * 2 - 1
    error = _train(autoencoder, stacked, options, progress)
    _normalise(autoencoder, stacked)
    transformer = _transformer(options)
    count = sum(p.numel() for p in transformer.parameters())
    psnr = -10 * torch.log10(torch.tensor(error / 4))
    say(f"base: transformer of {count / 1e6:.1f} million parameters, autoencoder of {_count(autoencoder):.2f} million")
    say(f"base: the autoencoder reproduces {len(pictures)} pictures at {float(psnr):.1f} dB")
    with atomic_folder(folder) as new:
        transformer.save_pretrained(new / "transformer")
        autoencoder.save_pretrained(new / "vae")
        prompt = PromptEmbedding(torch.randn(1, _TEXT), torch.randn(_POOLED))
        write_prompt(new / PROMPT_FILE, prompt, "random: the recipe has no text")


def _autoencoder(widths: tuple[int, ...]) -> Any:
    return diffusers_library().AutoencoderKL(
        block_out_channels=widths,
        down_block_types=("DownEncoderBlock2D",) * len(widths),
        up_block_types=("UpDecoderBlock2D",) * len(widths),
        latent_channels=_LATENTS,
        norm_num_groups=8,
        layers_per_block=1,
        scaling_factor=1.0,
        shift_factor=0.0,
        use_quant_conv=False,
        use_post_quant_conv=False,
        mid_block_add_attention=False,
    )


def _transformer(options: TinyBaseOptions) -> Any:
    width = options.head_width
    return diffusers_library().FluxTransformer2DModel(
        in_channels=_LATENTS * 4,
        num_layers=options.double_blocks,
        num_single_layers=options.single_blocks,
        attention_head_dim=width,
        num_attention_heads=options.heads,
        joint_attention_dim=_TEXT,
        pooled_projection_dim=_POOLED,
        axes_dims_rope=(width // 5, width // 5 * 2, width // 5 * 2),
    )


def _train(autoencoder: Any, pictures: Float[Tensor, "n 3 h w"], options: TinyBaseOptions, progress: Progress) -> float:
    """Train on parts of random pictures, and return the final mean squared error of values in [-1, 1]."""
    optimizer = torch.optim.Adam(autoencoder.parameters(), lr=options.rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, options.autoencoder_steps)
    generator, errors = torch.Generator().manual_seed(options.seed), []
    draw = partial(torch.randint, size=(1,), generator=generator)
    multiple = options.pixels_per_latent
    height, width = (side // 2 // multiple * multiple for side in pictures.shape[2:])
    for step in range(options.autoencoder_steps):
        batch = pictures[torch.randint(len(pictures), (options.batch,), generator=generator)]
        top, left = int(draw(pictures.shape[2] - height + 1)), int(draw(pictures.shape[3] - width + 1))
        batch = batch[:, :, top : top + height, left : left + width]
        latents = autoencoder.encode(batch).latent_dist.mode()
        shown = autoencoder.decode(latents, return_dict=False)[0]
        error = ((shown - batch) ** 2).mean()
        # the absolute error keeps smooth gradients of shading; the last term keeps the latents near 0
        loss = error + 0.1 * (shown - batch).abs().mean() + 1e-4 * (latents**2).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        errors = [*errors[1 - _MEAN_STEPS :], float(error.detach())]
        progress(step + 1, options.autoencoder_steps, f"autoencoder, error {sum(errors) / len(errors):.4f}")
    with torch.no_grad():
        some = pictures[:: max(1, len(pictures) // 64)]
        return float(((autoencoder.decode(autoencoder.encode(some).latent_dist.mode()).sample - some) ** 2).mean())


@torch.no_grad()
def _normalise(autoencoder: Any, pictures: Float[Tensor, "n 3 h w"]) -> None:
    latents = torch.cat([autoencoder.encode(part).latent_dist.mode() for part in pictures[:64].split(8)])
    shift, scale = float(latents.mean()), 1 / float(latents.std())
    autoencoder.register_to_config(shift_factor=shift, scaling_factor=scale)


def _count(network: Any) -> float:
    return sum(p.numel() for p in network.parameters()) / 1e6
