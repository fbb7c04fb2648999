"""Training of FLUX as a harmoniser: rectified flow matching on the velocity (paper, Sec. 5, Eq. 1)."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.harmonization.flux.empty_prompt import PROMPT_FILE, read_prompt
from splatgraft.harmonization.flux.network import velocity
from splatgraft.harmonization.flux.sampling import noise, noisy, sample, schnell_levels
from splatgraft.harmonization.flux.weights.diffusers_library import flux_transformer_class
from splatgraft.harmonization.flux.weights.folder import FluxFolder, Variant, find_part, local_folder, write_description
from splatgraft.harmonization.flux.weights.loading import load_autoencoder, load_transformer, widen_transformer
from splatgraft.harmonization.flux.weights.lora import add_lora, write_lora
from splatgraft.harmonization.flux.weights.widening import FirstLayer
from splatgraft_paper.training.objective import Latents, Network
from splatgraft_paper.training.saved_weights import save_weights
from splatgraft_paper.training.sources.pair_source import Role

Times = Literal["uniform", "logit-normal", "schnell"]
"""Distribution of the noise levels: uniform, logit-normal (Esser et al. 2024), or only schnell's four levels."""


@dataclass(frozen=True)
class FluxTraining:
    """Options of the training of FLUX."""

    base: str
    """Folder or hub id with transformer/, vae/ and empty_prompt.safetensors."""
    condition: Variant = "image-mask"
    first_layer: FirstLayer = "repeat"
    lora: int = 0
    """Rank; 0 trains all weights."""
    times: Times = "uniform"
    checkpointing: bool = True
    """Recompute activations in the backward pass instead of keeping them."""
    half: bool = False
    """Keep frozen weights in bfloat16; only with `lora`."""
    seed: int = 0
    """Of the low-rank matrices' initial values."""


class FluxObjective:
    """A FLUX transformer conditioned on the composite and a second image."""

    output_role: Role = "target"

    def __init__(self, options: FluxTraining, say: Any) -> None:
        """Load the base model and widen its first layer where needed.

        Raises:
            ValueError: a folder is of another kind or broken.
        """
        folder = local_folder(options.base, say)
        checked = FluxFolder.open(folder)
        self._options = options
        config = checked.config
        self._prompt_path = find_part(PROMPT_FILE, folder)
        self.prompt = read_prompt(
            self._prompt_path,
            tokens_width=config.get("joint_attention_dim", 4096),
            pooled_width=config.get("pooled_projection_dim", 768),
        )
        self.autoencoder = load_autoencoder(find_part("vae", folder))
        self.autoencoder.network.eval().requires_grad_(False)
        dtype = torch.bfloat16 if options.half and options.lora else torch.float32
        self.network = load_transformer(checked, dtype=dtype)
        if checked.inputs == 1:
            widen_transformer(self.network, options.first_layer)
        else:
            checked.variant(options.condition)
        if options.lora:
            count = add_lora(self.network, options.lora, seed=options.seed)
            say(f"lora: {count} layers of rank {options.lora} are trained")
            self.network.x_embedder.float()
        else:
            self.network.requires_grad_(True)
        if options.checkpointing:
            self.network.enable_gradient_checkpointing()
        condition: Role = "mask" if options.condition == "image-mask" else "background"
        self.roles: tuple[Role, ...] = ("target", "composite", condition)

    def encode(self, images: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b c i j"]:
        """Encode sRGB images in [0, 1] to latents."""
        return self.autoencoder.encode(images)

    def to(self, device: Any) -> None:
        """Move autoencoder and prompt to a device."""
        self.autoencoder.network.to(device)
        self.prompt = self.prompt.to(torch.device(device), torch.float32)

    def loss(self, network: Network, latents: Latents, seeds: Sequence[int]) -> Float[Tensor, ""]:
        """Mean of || v(z_t, z_comp, z_mask, c, t) - (eps - z_0) ||^2 (paper, Eq. 1)."""
        clean = latents["target"]
        levels, eps = [], []
        for seed in seeds:
            generator = torch.Generator().manual_seed(seed)
            levels.append(_level(self._options.times, generator))
            eps.append(torch.randn(clean.shape[1:], generator=generator))
        level, drawn = torch.stack(levels).to(clean.device), torch.stack(eps).to(clean.device)
        joined = torch.cat([noisy(clean, drawn, level), self._conditions(latents)], 1)
        return ((velocity(network, joined, level, self.prompt).float() - (drawn - clean)) ** 2).mean()

    def predict(self, network: Network, latents: Latents, seed: int) -> Float[Tensor, "b 3 h w"]:
        """Harmonise by schnell's four steps."""
        conditions = self._conditions(latents)
        b, device = conditions.shape[0], conditions.device
        size = tuple(latents["composite"].shape[1:])
        start = noise(size, seed).to(device).expand(b, -1, -1, -1)  # pyright: ignore

        def step(z: Tensor, level: float) -> Tensor:
            return velocity(network, torch.cat([z, conditions], 1), torch.full((b,), level, device=device), self.prompt)

        return self.autoencoder.decode(sample(step, start, schnell_levels()))

    def save(self, state: dict[str, Tensor], folder: Path) -> None:
        """Write a folder for `harmonize --method flux --weights`, or lora.safetensors for its --lora."""
        folder.mkdir(parents=True, exist_ok=True)
        description = {
            "variant": self._options.condition,
            "base": self._options.base,
            "first_layer": self._options.first_layer,
        }
        write_description(folder, description)
        if self._options.lora:
            write_lora(
                folder / "lora.safetensors", state, {"rank": str(self._options.lora), "base": self._options.base}
            )
            return
        save_weights(flux_transformer_class(), self.network.config, state, folder / "transformer")
        self.autoencoder.network.save_pretrained(folder / "vae")
        shutil.copyfile(self._prompt_path, folder / PROMPT_FILE)

    def _conditions(self, latents: Latents) -> Float[Tensor, "b k h w"]:
        return torch.cat([latents[role] for role in self.roles[1:]], 1)


def _level(times: Times, generator: torch.Generator) -> Float[Tensor, ""]:
    """Draw a noise level in (0, 1]."""
    if times == "logit-normal":
        return torch.randn((), generator=generator).sigmoid()
    if times == "schnell":
        return torch.tensor(schnell_levels()[int(torch.randint(4, (), generator=generator))])
    return 1 - torch.rand((), generator=generator)
