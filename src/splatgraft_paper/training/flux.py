"""Training of FLUX as a harmoniser by rectified flow matching on the velocity (paper, Sec. 5, Eq. 1)."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.harmonization.flux.loading import (
    DESCRIPTION_FILE,
    FluxFolder,
    diffusers_library,
    load_transformer,
    local_folder,
    widen_transformer,
)
from splatgraft.harmonization.flux.network import FirstLayer, Variant, velocity
from splatgraft.harmonization.flux.prompt import TOKENS, find_prompt, read_prompt
from splatgraft.harmonization.flux.sampling import noise, noisy, sample, schnell_levels
from splatgraft.harmonization.flux.tensor_file import write_tensors
from splatgraft.project.step import locked
from splatgraft.runtime.console import Console
from splatgraft.runtime.files import atomic_write
from splatgraft.runtime.hub import hub_id
from splatgraft_paper.synthesis.jobs import parse_image_size
from splatgraft_paper.training.loop import LoopOptions, join_processes
from splatgraft_paper.training.objective import Latents, Network, Objective, train_objective
from splatgraft_paper.training.pairs import DataOptions, Role, TrainingData, crop_pair_to_size, open_training_data
from splatgraft_paper.training.recipes import Recipe, TrainingMemory, say_plan
from splatgraft_paper.training.tiny_base import TinyBaseOptions, write_tiny_base

Times = Literal["uniform", "schnell"]
TINY = "tiny"
"""Name of a base model of three million weights, which is made first, in OUT/base."""
_BASE_PICTURES = 1200  # maximum number of pictures for training the tiny base model's autoencoder
# attention and feed-forward layers of all blocks
_LORA_TARGETS = (
    r"(single_)?transformer_blocks\..*"
    r"\.(to_[qkv]|to_out\.0|add_[qkv]_proj|to_add_out|proj_mlp|proj_out|ff(_context)?\.net\.(0\.proj|2))"
)


@dataclass(frozen=True)
class FluxTrainingOptions:
    """Options of the training of the FLUX harmoniser (paper, Sec. 5)."""

    base: str = "flux"
    """Folder or hub id with transformer/ and vae/, also of a harmoniser; `tiny` makes a small one in OUT/base."""
    data: DataOptions = field(default_factory=DataOptions)
    loop: LoopOptions = field(default_factory=LoopOptions)
    condition: Variant = "image-mask"
    """Input of the network beside the composite: the object's mask (the paper) or the scene without the object."""
    first_layer: FirstLayer = "repeat"
    """Initial weights of the wider first layer: repeated (the paper) or zeros."""
    lora: int = 0
    """Rank of a low-rank adaptation; 0 trains all weights."""
    times: Times = "uniform"
    """Noise levels of the training: uniform, or the four of inference."""
    no_checkpointing: bool = False
    """Keep activations instead of computing them twice; faster, but needs several times the memory."""
    recipe: str | None = None
    """Default options: paper, without-blender, without-flux, without-orida, tiny or a .toml file."""
    plan: bool = False
    """Print the plan without training: steps, GPUs, data, licences."""


class FluxObjective(Objective):
    """A FLUX transformer conditioned on the composite and a second image."""

    output_role: Role = "target"

    def __init__(self, folder: Path, options: FluxTrainingOptions, say: Callable[[str], None]) -> None:
        """Load the base model (transformer/, vae/, empty_prompt.safetensors) and widen its first layer where needed."""
        checked = FluxFolder.open(folder)
        super().__init__(folder)
        self._options, config = options, checked.config
        self._prompt_path = find_prompt(options.base, folder)
        self.prompt = read_prompt(
            self._prompt_path,
            tokens_width=config.get("joint_attention_dim", 4096),
            pooled_width=config.get("pooled_projection_dim", 768),
        )
        dtype = torch.bfloat16 if options.loop.precision == "bf16" and options.lora else torch.float32
        self.network = load_transformer(checked, dtype=dtype)
        if checked.is_harmonizer:
            checked.variant(options.condition)
        else:
            widen_transformer(self.network, options.first_layer)
        if options.lora:
            count = add_lora(self.network, options.lora, seed=options.loop.seed)
            say(f"lora: {count} layers of rank {options.lora} are trained")
        else:
            self.network.requires_grad_(True)
        if not options.no_checkpointing:
            self.network.enable_gradient_checkpointing()
        condition: Role = "mask" if options.condition == "image-mask" else "background"
        self.roles: tuple[Role, ...] = ("target", "composite", condition)

    def to(self, device: Any) -> None:
        """Move autoencoder and prompt to a device."""
        super().to(device)
        self.prompt = self.prompt.to(torch.device(device), torch.float32)

    def loss(self, network: Network, latents: Latents, seeds: Sequence[int]) -> Float[Tensor, ""]:
        """Compute the mean of || v(z_t, z_comp, z_mask, c, t) - (eps - z_0) ||^2 (paper, Eq. 1)."""
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
        """Harmonise with schnell's four steps."""
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
        options, base = self._options, str(self.folder)
        description = {"variant": options.condition, "base": base, "first_layer": options.first_layer}
        with atomic_write(folder / DESCRIPTION_FILE) as stream:
            stream.write((json.dumps(description, indent=1) + "\n").encode())
        if options.lora:
            write_lora(folder / "lora.safetensors", state, {"rank": str(options.lora), "base": base})
            return
        kind = diffusers_library().FluxTransformer2DModel
        self.save_model(kind, state, folder / "transformer", self._prompt_path)

    def _conditions(self, latents: Latents) -> Float[Tensor, "b k h w"]:
        return torch.cat([latents[role] for role in self.roles[1:]], 1)


def add_lora(network: Any, rank: int, *, seed: int) -> int:
    """Freeze `network`, add trainable low-rank matrices to its linear layers in place (PEFT), and return their number.

    All weights of the first layer stay trainable, because it may have been widened.
    """
    from peft import LoraConfig

    network.requires_grad_(False)
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(seed)
        network.add_adapter(LoraConfig(r=rank, lora_alpha=rank, target_modules=_LORA_TARGETS))
    network.x_embedder.requires_grad_(True)
    for parameter in network.parameters():
        if parameter.requires_grad:
            parameter.data = parameter.data.float()
    return sum(name.endswith("lora_A") for name, _ in network.named_modules())


def write_lora(path: Path, state: dict[str, Tensor], about: dict[str, str]) -> None:
    """Write the low-rank matrices and the whole first layer under diffusers' names."""
    named = {f"transformer.{name.replace('.default.', '.')}": tensor for name, tensor in state.items()}
    write_tensors(path, {name: one for name, one in named.items() if ".lora_" in name or ".x_embedder." in name}, about)


def _level(times: Times, generator: torch.Generator) -> Float[Tensor, ""]:
    """Draw a noise level in (0, 1]."""
    if times == "schnell":
        return torch.tensor(schnell_levels()[int(torch.randint(4, (), generator=generator))])
    return 1 - torch.rand((), generator=generator)


def train_flux(out: Path, options: FluxTrainingOptions, console: Console) -> Path | None:
    """Train a harmoniser and return its folder; None in all but the first process, or if only the plan is printed."""
    recipe = Recipe.read(options.recipe) if options.recipe else None
    processes = join_processes(options.loop)
    loop, count = options.loop, processes.num_processes
    if options.plan and recipe and count == 1 and not loop.cpu:
        # without a launcher the plan is for the GPUs here, or else for the recipe's number
        count = torch.cuda.device_count() or recipe.processes
    elif not options.plan:
        loop = replace(loop, cpu=processes.device.type == "cpu")
    if processes.is_main_process and (options.plan or recipe):
        say_plan(recipe, loop, options.data.size, count, console)
    loop.check(count)
    data = None if options.plan else open_training_data(options.data, options.loop.seed, recipe)
    if processes.is_main_process and options.base != TINY:
        training_memory(options, loop, count).say_and_check(loop, count, out, console)
    if data is None:
        return None
    folder = out / "base"
    if options.base != TINY:
        folder = local_folder(options.base, console.say)
    elif processes.is_main_process and not folder.is_dir():
        _make_tiny_base(folder, data, options.loop.seed, console)
    processes.wait_for_everyone()
    objective = FluxObjective(folder, options, console.say)
    return train_objective(objective, data, out, options.loop, base=folder, console=console)


def training_memory(options: FluxTrainingOptions, loop: LoopOptions, processes: int) -> TrainingMemory:
    """Compute a training's memory from the shapes of its network's tensors, without allocating them.

    A base that is not on this machine counts as FLUX.1-schnell.
    """
    kind, folder = diffusers_library().FluxTransformer2DModel, Path(hub_id(options.base))
    width, height = parse_image_size(options.data.size, multiple_of=16)
    with torch.device("meta"):
        network = kind.from_config(FluxFolder.open(folder).config) if folder.is_dir() else kind()
        if network.config.in_channels == network.out_channels:
            widen_transformer(network)
        if options.lora:
            add_lora(network.to(torch.bfloat16 if loop.precision == "bf16" else torch.float32), options.lora, seed=0)
    per_pass = max(1, loop.batch // (processes * loop.accumulate))
    tokens = per_pass * (width * height // 256 + TOKENS) * network.inner_dim
    return TrainingMemory.of(network, loop, processes, tokens=tokens, checkpointing=not options.no_checkpointing)


def _make_tiny_base(folder: Path, data: TrainingData, seed: int, console: Console) -> None:
    """Make the tiny base model; training pictures train its autoencoder."""
    pictures = []
    for files in data.mixture.all()[: _BASE_PICTURES // 3]:
        pair = crop_pair_to_size(files.read(), data.width, data.height)
        pictures += [pair.picture(role).permute(2, 0, 1) for role in ("target", "composite", "mask")]
    folder.parent.mkdir(parents=True, exist_ok=True)
    with console.bar("autoencoder") as progress, locked(folder.parent):
        write_tiny_base(folder, pictures, TinyBaseOptions(seed=seed), say=console.say, progress=progress)
