"""Does what `train flux` and `train removal` are asked: sources, prediction of memory, the loop."""

import math
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
from splatgraft.workflow.training_data import DataOptions

if TYPE_CHECKING:
    from splatgraft.commands.train.flux import TrainFlux
    from splatgraft.commands.train.removal import TrainRemoval


def train_flux(asked: "TrainFlux", console: Console) -> int:
    """Train a harmoniser."""
    from splatgraft.harmonization.flux.weights.folder import FluxFolder, local_folder
    from splatgraft.training.flux_objective import FluxObjective, FluxTraining

    folder = local_folder(asked.base, console.say)
    config = FluxFolder.open(folder).config
    width = config.get("num_attention_heads", 24) * config.get("attention_head_dim", 128)
    doubles, singles = config.get("num_layers", 19), config.get("num_single_layers", 38)
    pixels = math.prod(_pixels(asked.data))
    size = TransformerSize(
        # with the modulations that inference bakes: 6 a stream of a double block, 3 a single one
        parameters=width**2 * (36 * doubles + 15 * singles),
        blocks=doubles + singles,
        width=width,
        tokens=pixels // 256 + 512,
        adapted=width * (36 * doubles + 20 * singles),
    )
    _say_memory(size, asked, console)
    objective = FluxObjective(
        FluxTraining(
            base=str(folder),
            condition=asked.condition,
            first_layer=asked.first_layer,
            lora=asked.lora,
            times=asked.times,
            checkpointing=not asked.no_checkpointing,
            half=asked.loop.precision == "bf16",
            seed=asked.loop.seed,
        ),
        console.say,
    )
    return _train(objective, asked, str(folder), console)


def train_removal(asked: "TrainRemoval", console: Console) -> int:
    """Train the object removal."""
    from splatgraft.harmonization.flux.weights.folder import local_folder
    from splatgraft.training.removal_objective import RemovalObjective

    folder = local_folder(asked.base, console.say)
    objective = RemovalObjective(str(folder), console.say, checkpointing=not asked.no_checkpointing)
    count = sum(p.numel() for p in objective.network.parameters())
    each = 16 - 6 * (asked.loop.optimizer == "adam8bit") + 4 * (asked.loop.ema > 0)
    console.say(f"memory: {count * each / 1e9:.1f} GB for weights and optimiser, and activations")
    return _train(objective, asked, str(folder), console)


def _train(objective: Any, asked: "TrainFlux | TrainRemoval", base: str, console: Console) -> int:
    width, height = _pixels(asked.data)
    data = asked.data
    sources = [RenderedPairs(folder) for folder in data.pairs]
    sources += [RelitPairs(folder) for folder in (*data.generated, *data.orida)]
    if not sources:
        raise ValueError("training data: expected --pairs, --generated or --orida, found none")
    mixture, held_out = split_mixture(sources, weights=data.weights, held_out=data.held_out, seed=asked.loop.seed)
    first = is_first_process(cpu=asked.loop.cpu)
    say = console.say if first else lambda sentence: None
    for source, indices in zip(mixture.sources, mixture.indices, strict=True):
        say(f"data: {len(indices)} pairs to train on, {len(source) - len(indices)} held out, {source.name}")
    vae = Path(base) / "vae" / "diffusion_pytorch_model.safetensors"
    name = f"{vae.resolve()}|{vae.stat().st_size if vae.is_file() else 0}"
    cache = LatentCache(asked.out / "latents", objective.encode, width=width, height=height, autoencoder=name)
    with console.bar("train") as progress:
        run = TrainingRun(objective, mixture, held_out, cache, asked.loop, asked.out, say, progress)
        # of several processes the first holds the folder; the others write nothing but latents, whole files each
        with locked(asked.out) if first else nullcontext():
            model = train(run)
    if first:
        console.result(model)
    return 0


def _pixels(data: DataOptions) -> tuple[int, int]:
    parts = data.size.split("x")
    if len(parts) != 2 or not all(part.isdigit() and int(part) % 16 == 0 and int(part) for part in parts):
        raise ValueError(f"--size: expected WIDTHxHEIGHT in multiples of 16, found {data.size}")
    return int(parts[0]), int(parts[1])


def _say_memory(size: TransformerSize, asked: "TrainFlux", console: Console) -> None:
    loop: LoopOptions = asked.loop
    processes, shards = process_counts(cpu=loop.cpu)
    options = MemoryOptions(
        pairs=max(1, loop.batch // (processes * loop.accumulate)),
        lora=asked.lora,
        adam8bit=loop.optimizer == "adam8bit",
        ema=loop.ema > 0,
        checkpointing=not asked.no_checkpointing,
        shards=shards,
        half=loop.precision != "no",
    )
    for line in memory_table(size, options):
        console.say(f"memory: {line}")
    if torch.cuda.is_available() and not loop.cpu:
        free, need = torch.cuda.mem_get_info()[0], training_bytes(size, options)
        if need > free and not asked.force:
            raise ValueError(
                f"GPU memory: expected {need / 1e9:.0f} GB free, found {free / 1e9:.0f}; choose --lora, --optimizer "
                "adam8bit, --accumulate or more processes, or --force"
            )
