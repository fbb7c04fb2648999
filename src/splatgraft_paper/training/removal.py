"""Removal of objects and their shadows by Stable Diffusion 2, training and inference (paper, Sec. 5.2 and 5.3).

The UNet's first layer is widened to the noisy latent and the latents of image and mask; it predicts the velocity.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.harmonization.flux.loading import diffusers_library, local_folder, read_config
from splatgraft.harmonization.flux.network import pad_by_reflection, widen_layer
from splatgraft.harmonization.flux.prompt import find_prompt
from splatgraft.harmonization.flux.sampling import noise
from splatgraft.harmonization.flux.tensor_file import read_tensors
from splatgraft.runtime.console import Console
from splatgraft.runtime.hub import hub_id
from splatgraft_paper.synthesis.jobs import parse_image_size
from splatgraft_paper.training.loop import LoopOptions, join_processes
from splatgraft_paper.training.objective import Latents, Network, Objective, train_objective
from splatgraft_paper.training.pairs import DataOptions, Role, open_training_data
from splatgraft_paper.training.recipes import Recipe, TrainingMemory, say_plan

CONDITIONS = 2
"""Number of images that condition the network: the image with the object, and the mask."""
_MULTIPLE = 64  # pixels; factors of 8 in the autoencoder and 8 in the UNet


@dataclass(frozen=True)
class RemovalTrainingOptions:
    """Options of the training of the object removal (paper, Sec. 5.2 and 5.3)."""

    base: str = "stable-diffusion"
    """Folder or hub id with unet/ and vae/."""
    data: DataOptions = field(default_factory=DataOptions)
    loop: LoopOptions = field(default_factory=lambda: LoopOptions(steps=260_000, batch=8, rate=1e-5))
    no_checkpointing: bool = False
    """Keep activations instead of computing them twice; faster, but needs several times the memory."""
    recipe: str | None = None
    """Default options: removal or a .toml file."""
    plan: bool = False
    """Print the plan without training: steps, GPUs, data, licences."""


class RemovalObjective(Objective):
    """A UNet that generates the image without the object from the image with the object and its mask."""

    roles: tuple[Role, ...] = ("background", "target", "mask")
    output_role: Role = "background"

    def __init__(self, base: str, say: Callable[[str], None], *, checkpointing: bool = True) -> None:
        """Load Stable Diffusion 2 or a removal network: unet/, vae/ and empty_prompt.safetensors."""
        folder = local_folder(base, say, parts=("unet",))
        config = read_config(folder / "unet" / "config.json", "UNet2DConditionModel")
        self._prompt_path = find_prompt(base, folder)
        if not self._prompt_path.is_file():
            raise ValueError(
                f"{self._prompt_path}: expected the empty prompt's embeddings, found none; `splatgraft paper "
                f"train embed --kind stable-diffusion --base {base}` makes them once"
            )
        self.tokens = read_tensors(self._prompt_path)["tokens"]
        super().__init__(folder)
        channels = self.autoencoder.channels
        if config["in_channels"] not in (channels, channels * (CONDITIONS + 1)):
            raise ValueError(
                f"{folder}: expected a UNet of {channels} input channels (Stable Diffusion) or "
                f"{channels * (CONDITIONS + 1)} (object removal), found {config['in_channels']}"
            )
        try:
            self.network = diffusers_library().UNet2DConditionModel.from_pretrained(folder / "unet")
        except (OSError, ValueError, RuntimeError) as error:
            found = " ".join(str(error).split())[:200]
            raise ValueError(f"{folder / 'unet'}: expected weights that fit config.json, found {found}") from error
        if config["in_channels"] == channels:
            self.network.conv_in = widen_layer(self.network.conv_in, CONDITIONS + 1)
            self.network.register_to_config(in_channels=self.network.conv_in.in_channels)
        if checkpointing:
            self.network.enable_gradient_checkpointing()
        # the scheduler_config.json of Stable Diffusion 2
        self._schedule = diffusers_library().DDIMScheduler(
            beta_start=0.00085,
            beta_end=0.012,
            beta_schedule="scaled_linear",
            prediction_type="v_prediction",
            clip_sample=False,
            timestep_spacing="trailing",  # begins at pure noise
        )

    def to(self, device: Any) -> None:
        """Move autoencoder and prompt to a device."""
        super().to(device)
        self.tokens = self.tokens.to(device)

    def loss(self, network: Network, latents: Latents, seeds: Sequence[int]) -> Float[Tensor, ""]:
        """Compute the mean squared error of the velocity."""
        clean = latents["background"]
        steps, eps = [], []
        for seed in seeds:
            generator = torch.Generator().manual_seed(seed)
            steps.append(torch.randint(1000, (), generator=generator))
            eps.append(torch.randn(clean.shape[1:], generator=generator))
        step, drawn = torch.stack(steps).to(clean.device), torch.stack(eps).to(clean.device)
        predicted = self._velocity(network, self._schedule.add_noise(clean, drawn, step), latents, step)
        return ((predicted.float() - self._schedule.get_velocity(clean, drawn, step)) ** 2).mean()

    @torch.no_grad()
    def predict(self, network: Network, latents: Latents, seed: int) -> Float[Tensor, "b 3 h w"]:
        """Generate the images without the object."""
        target = latents["target"]
        size = tuple(target.shape[1:])
        latent = noise(size, seed).to(target.device).expand(target.shape[0], -1, -1, -1)  # pyright: ignore
        self._schedule.set_timesteps(20)  # DDIM steps, set by hand
        for step in self._schedule.timesteps:
            predicted = self._velocity(network, latent, latents, step.expand(len(latent)).to(latent.device))
            latent = self._schedule.step(predicted.float(), step, latent).prev_sample
        return self.autoencoder.decode(latent)

    def save(self, state: dict[str, Tensor], folder: Path) -> None:
        """Write unet/, vae/ and the prompt embeddings."""
        folder.mkdir(parents=True, exist_ok=True)
        self.save_model(diffusers_library().UNet2DConditionModel, state, folder / "unet", self._prompt_path)

    def _velocity(
        self, network: Network, noisy: Float[Tensor, "b c h w"], latents: Latents, step: Tensor
    ) -> Float[Tensor, "b c h w"]:
        joined = torch.cat([noisy, latents["target"], latents["mask"]], 1)
        return network(joined, step, self.tokens.expand(joined.shape[0], -1, -1), return_dict=False)[0]


class ObjectRemover:
    """A loaded removal network."""

    def __init__(self, weights: Path, device: torch.device, say: Callable[[str], None], *, seed: int = 0) -> None:
        """Load the folder that `train removal` wrote; `seed` determines the initial noise."""
        self._objective = RemovalObjective(str(weights), say, checkpointing=False)
        self._objective.network.to(device).eval().requires_grad_(False)
        self._objective.to(device)
        self._device, self._seed = device, seed

    @torch.no_grad()
    def remove(self, image: Float[Tensor, "h w 3"], mask: Float[Tensor, "h w"]) -> Float[Tensor, "h w 3"]:
        """Remove the object and its shadow.

        The network paints pixels inside the mask. Elsewhere its change is added to the image, so that background and
        target do not differ by the autoencoder's blur.
        """
        height, width = mask.shape
        binary = (mask > 0.5).float()[..., None].expand(-1, -1, 3)
        images = torch.stack([image, binary]).permute(0, 3, 1, 2)
        latents = self._objective.autoencoder.encode(pad_by_reflection(images, _MULTIPLE).to(self._device))
        removed = self._objective.predict(
            self._objective.network, {"target": latents[:1], "mask": latents[1:]}, self._seed
        )
        decoded = self._objective.autoencoder.decode(latents[:1])
        removed, decoded = (x[0, :, :height, :width].permute(1, 2, 0).cpu() for x in (removed, decoded))
        return torch.where(binary > 0, removed, image + removed - decoded).clamp(0, 1)


def train_removal(out: Path, options: RemovalTrainingOptions, console: Console) -> Path | None:
    """Train the object removal, return its folder; None in all but the first process, or if only planned."""
    loop, recipe = options.loop, Recipe.read(options.recipe) if options.recipe else None
    processes = join_processes(loop)
    shown, first = (
        loop if options.plan else replace(loop, cpu=processes.device.type == "cpu"),
        processes.is_main_process,
    )
    if first and (options.plan or recipe):
        say_plan(recipe, shown, options.data.size, processes.num_processes, console)
    data = None if options.plan else open_training_data(options.data, loop.seed, recipe)
    if first:
        memory = training_memory(options, shown, processes.num_processes)
        memory.say_and_check(shown, processes.num_processes, out, console)
    if data is None:
        return None
    objective = RemovalObjective(options.base, console.say, checkpointing=not options.no_checkpointing)
    return train_objective(objective, data, out, loop, base=objective.folder, console=console)


# the config.json of Stable Diffusion 2's UNet, where it differs from the defaults of diffusers
_STABLE_DIFFUSION_2 = {
    "cross_attention_dim": 1024,
    "attention_head_dim": (5, 10, 20, 20),
    "use_linear_projection": True,
    "in_channels": 4 * (CONDITIONS + 1),
}


def training_memory(options: RemovalTrainingOptions, loop: LoopOptions, processes: int) -> TrainingMemory:
    """Compute the memory of a training; a base that is not on this machine counts as Stable Diffusion 2."""
    kind, folder = diffusers_library().UNet2DConditionModel, Path(hub_id(options.base))
    width, height = parse_image_size(options.data.size, multiple_of=16)
    with torch.device("meta"):
        file = folder / "unet" / "config.json"
        network = kind.from_config(read_config(file, kind.__name__)) if folder.is_dir() else kind(**_STABLE_DIFFUSION_2)
    per_pass = max(1, loop.batch // (processes * loop.accumulate))
    tokens = per_pass * (width // 8) * (height // 8) * network.config.block_out_channels[0]
    return TrainingMemory.of(network, loop, processes, tokens=tokens, checkpointing=not options.no_checkpointing)
