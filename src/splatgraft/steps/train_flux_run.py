"""Does what `train flux` and `train removal` are asked: sources, prediction of memory, the loop."""

import math
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from splatgraft.project import locked
from splatgraft.steps.terminal import Terminal
from splatgraft.steps.train_options import DataOptions
from splatgraft.train.latent_cache import LatentCache
from splatgraft.train.prediction import Choice, Size, table, training_bytes
from splatgraft.train.settings import Loop
from splatgraft.train.sources.relit import RelitPairs
from splatgraft.train.sources.rendered import RenderedPairs
from splatgraft.train.sources.source import split_mixture
from splatgraft.train.trainer import Training, is_first_process, launched, train

if TYPE_CHECKING:
    from splatgraft.steps.train_flux import TrainFlux
    from splatgraft.steps.train_removal import TrainRemoval


def train_flux(asked: "TrainFlux", terminal: Terminal) -> int:
    """Train a harmoniser."""
    from splatgraft.harmonize.flux.folder import FluxFolder, local_folder
    from splatgraft.train.flux_objective import FluxObjective, FluxTraining

    folder = local_folder(asked.base, terminal.say)
    config = FluxFolder.open(folder).config
    width = config.get("num_attention_heads", 24) * config.get("attention_head_dim", 128)
    doubles, singles = config.get("num_layers", 19), config.get("num_single_layers", 38)
    pixels = math.prod(_pixels(asked.data))
    size = Size(
        # with the modulations that inference bakes: 6 a stream of a double block, 3 a single one
        parameters=width**2 * (36 * doubles + 15 * singles),
        blocks=doubles + singles,
        width=width,
        tokens=pixels // 256 + 512,
        adapted=width * (36 * doubles + 20 * singles),
    )
    _say_memory(size, asked, terminal)
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
        terminal.say,
    )
    return _train(objective, asked, str(folder), terminal)


def train_removal(asked: "TrainRemoval", terminal: Terminal) -> int:
    """Train the object removal."""
    from splatgraft.harmonize.flux.folder import local_folder
    from splatgraft.train.removal_objective import RemovalObjective

    folder = local_folder(asked.base, terminal.say)
    objective = RemovalObjective(str(folder), terminal.say, checkpointing=not asked.no_checkpointing)
    count = sum(p.numel() for p in objective.network.parameters())
    each = 16 - 6 * (asked.loop.optimizer == "adam8bit") + 4 * (asked.loop.ema > 0)
    terminal.say(f"memory: {count * each / 1e9:.1f} GB for weights and optimiser, and activations")
    return _train(objective, asked, str(folder), terminal)


def _train(objective: Any, asked: "TrainFlux | TrainRemoval", base: str, terminal: Terminal) -> int:
    width, height = _pixels(asked.data)
    data = asked.data
    sources = [RenderedPairs(folder) for folder in data.pairs]
    sources += [RelitPairs(folder) for folder in (*data.generated, *data.orida)]
    if not sources:
        raise ValueError("training data: expected --pairs, --generated or --orida, found none")
    mixture, held_out = split_mixture(sources, weights=data.weights, held_out=data.held_out, seed=asked.loop.seed)
    first = is_first_process(cpu=asked.loop.cpu)
    say = terminal.say if first else lambda sentence: None
    for source, indices in zip(mixture.sources, mixture.indices, strict=True):
        say(f"data: {len(indices)} pairs to train on, {len(source) - len(indices)} held out, {source.name}")
    vae = Path(base) / "vae" / "diffusion_pytorch_model.safetensors"
    name = f"{vae.resolve()}|{vae.stat().st_size if vae.is_file() else 0}"
    cache = LatentCache(asked.out / "latents", objective.encode, width=width, height=height, autoencoder=name)
    with terminal.bar("train") as progress:
        run = Training(objective, mixture, held_out, cache, asked.loop, asked.out, say, progress)
        # of several processes the first holds the folder; the others write nothing but latents, whole files each
        with locked(asked.out) if first else nullcontext():
            model = train(run)
    if first:
        terminal.result(model)
    return 0


def _pixels(data: DataOptions) -> tuple[int, int]:
    parts = data.size.split("x")
    if len(parts) != 2 or not all(part.isdigit() and int(part) % 16 == 0 and int(part) for part in parts):
        raise ValueError(f"--size: expected WIDTHxHEIGHT in multiples of 16, found {data.size}")
    return int(parts[0]), int(parts[1])


def _say_memory(size: Size, asked: "TrainFlux", terminal: Terminal) -> None:
    loop: Loop = asked.loop
    processes, shards = launched(cpu=loop.cpu)
    choice = Choice(
        pairs=max(1, loop.batch // (processes * loop.accumulate)),
        lora=asked.lora,
        adam8bit=loop.optimizer == "adam8bit",
        ema=loop.ema > 0,
        checkpointing=not asked.no_checkpointing,
        shards=shards,
        half=loop.precision != "no",
    )
    for line in table(size, choice):
        terminal.say(f"memory: {line}")
    if torch.cuda.is_available() and not loop.cpu:
        free, need = torch.cuda.mem_get_info()[0], training_bytes(size, choice)
        if need > free and not asked.force:
            raise ValueError(
                f"GPU memory: expected {need / 1e9:.0f} GB free, found {free / 1e9:.0f}; choose --lora, --optimizer "
                "adam8bit, --accumulate or more processes, or --force"
            )
