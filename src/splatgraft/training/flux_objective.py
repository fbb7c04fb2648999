"""Training FLUX to harmonise: rectified flow matching on the velocity (paper, Sec. 4). Knows no loop and no data."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from splatgraft.harmonization.flux.empty_prompt import PROMPT_FILE, read_prompt
from splatgraft.harmonization.flux.network import velocity
from splatgraft.harmonization.flux.sampling import noise, noisy, sample, schnell_levels
from splatgraft.harmonization.flux.weights.folder import FluxFolder, Variant, find_part, local_folder, write_description
from splatgraft.harmonization.flux.weights.loading import load_autoencoder, load_transformer, widen_transformer
from splatgraft.harmonization.flux.weights.lora import add_lora, write_lora
from splatgraft.harmonization.flux.weights.widening import FirstLayer
from splatgraft.training.objective import Latents
from splatgraft.training.sources.pair_source import Role

Times = Literal["uniform", "logit-normal", "schnell"]


@dataclass(frozen=True)
class FluxTraining:
    """What is trained of FLUX."""

    base: str
    """Folder or hub id with transformer/, vae/ and empty_prompt.safetensors."""
    condition: Variant = "image-mask"
    first_layer: FirstLayer = "repeat"
    lora: int = 0
    """Rank; 0 trains all weights."""
    times: Times = "uniform"
    checkpointing: bool = True
    """Compute activations twice instead of keeping them."""
    half: bool = False
    """Keep what does not learn in bfloat16."""
    seed: int = 0


class FluxObjective:
    """A FLUX transformer with room for composite and condition."""

    shown: Role = "target"

    def __init__(self, wanted: FluxTraining, say: Any) -> None:
        """Load the base and make room.

        Raises: ValueError where a folder is of another kind or broken.
        """
        folder = local_folder(wanted.base, say)
        checked = FluxFolder.open(folder)
        self._wanted, self._folder = wanted, folder
        config = checked.config
        self._prompt_path = find_part(PROMPT_FILE, folder)
        self.prompt = read_prompt(
            self._prompt_path,
            tokens_width=config.get("joint_attention_dim", 4096),
            pooled_width=config.get("pooled_projection_dim", 768),
        )
        self.autoencoder = load_autoencoder(find_part("vae", folder))
        self.autoencoder.network.eval().requires_grad_(False)
        dtype = torch.bfloat16 if wanted.half and wanted.lora else torch.float32
        self.network = load_transformer(checked, dtype=dtype)
        if checked.inputs == 1:
            widen_transformer(self.network, wanted.first_layer)
        else:
            checked.variant(wanted.condition)
        if wanted.lora:
            say(f"lora: {add_lora(self.network, wanted.lora, seed=wanted.seed)} layers of rank {wanted.lora} learn")
            self.network.x_embedder.float()
        else:
            self.network.requires_grad_(True)
        if wanted.checkpointing:
            self.network.enable_gradient_checkpointing()
        condition: Role = "mask" if wanted.condition == "image-mask" else "background"
        self.roles: tuple[Role, ...] = ("target", "composite", condition)

    def encode(self, pictures: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b c i j"]:
        """Latents of pictures."""
        return self.autoencoder.encode(pictures)

    def to(self, device: Any) -> None:
        """Autoencoder and prompt to a device."""
        self.autoencoder.network.to(device)
        self.prompt = self.prompt.to(torch.device(device), torch.float32)

    def loss(self, network: nn.Module, latents: Latents, seeds: Sequence[int]) -> Float[Tensor, ""]:
        """|| v(z_t, z_comp, z_mask, c, t) - (eps - z_0) ||^2, the mean (paper, Eq. 1)."""
        clean = latents["target"]
        levels, eps = [], []
        for seed in seeds:
            generator = torch.Generator().manual_seed(seed)
            levels.append(_level(self._wanted.times, generator))
            eps.append(torch.randn(clean.shape[1:], generator=generator))
        level, drawn = torch.stack(levels).to(clean.device), torch.stack(eps).to(clean.device)
        joined = torch.cat([noisy(clean, drawn, level), self._conditions(latents)], 1)
        return ((velocity(network, joined, level, self.prompt).float() - (drawn - clean)) ** 2).mean()

    def predict(self, network: nn.Module, latents: Latents, seed: int) -> Float[Tensor, "b 3 h w"]:
        """Harmonised pictures, in schnell's four steps."""
        conditions = self._conditions(latents)
        b, device = conditions.shape[0], conditions.device
        size = tuple(latents["composite"].shape[1:])
        start = noise(size, seed).to(device).expand(b, -1, -1, -1)  # pyright: ignore

        def step(z: Tensor, level: float) -> Tensor:
            return velocity(network, torch.cat([z, conditions], 1), torch.full((b,), level, device=device), self.prompt)

        return self.autoencoder.decode(sample(step, start, schnell_levels()))

    def save(self, state: dict[str, Tensor], folder: Path) -> None:
        """Write a folder that `harmonize --method flux --weights` takes, or lora.safetensors that its --lora takes."""
        folder.mkdir(parents=True, exist_ok=True)
        about = {"variant": self._wanted.condition, "base": self._wanted.base, "first_layer": self._wanted.first_layer}
        write_description(folder, about)
        if self._wanted.lora:
            write_lora(folder / "lora.safetensors", state, {"rank": str(self._wanted.lora), "base": self._wanted.base})
            return
        self.network.save_pretrained(folder / "transformer", state_dict=state)
        self.autoencoder.network.save_pretrained(folder / "vae")
        shutil.copyfile(self._prompt_path, folder / PROMPT_FILE)

    def _conditions(self, latents: Latents) -> Float[Tensor, "b k h w"]:
        return torch.cat([latents[role] for role in self.roles[1:]], 1)


def _level(times: Times, generator: torch.Generator) -> Float[Tensor, ""]:
    """A noise level in (0, 1]."""
    if times == "logit-normal":
        return torch.randn((), generator=generator).sigmoid()
    if times == "schnell":
        return torch.tensor(schnell_levels()[int(torch.randint(4, (), generator=generator))])
    return 1 - torch.rand((), generator=generator)
