"""Recipes of trainings: the paper's experiments as TOML, their command-line options, and the plan of a training."""

import argparse
import shutil
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from splatgraft.reconstruction.options import available_memory
from splatgraft.runtime.console import Console
from splatgraft_paper.training.loop import LoopOptions

_FOLDER = Path(__file__).with_name("recipe_files")


@dataclass(frozen=True)
class RecipeSource:
    """One source of pairs of a recipe."""

    option: str
    """Name of the source's option, such as `pairs`."""
    name: str
    """The paper's name of the source."""
    targets: int
    """Number of consistent pictures in the paper."""
    composites: int
    """Number of inconsistent pictures in the paper."""
    weight: float
    """Share of the drawn pairs, relative to the other sources."""


@dataclass(frozen=True)
class Recipe:
    """A training with all its options and sources."""

    name: str
    title: str
    command: str
    """Command: train flux or train removal."""
    processes: int
    """Number of GPUs in the paper."""
    options: dict[str, Any]
    """Values of the command's options by name."""
    sources: tuple[RecipeSource, ...]
    licences: dict[str, str]
    """Licences of weights and data, by name."""

    @staticmethod
    def read(name: str) -> "Recipe":
        """Read a shipped recipe, or the user's own .toml file."""
        path = Path(name) if name.endswith(".toml") else _FOLDER / f"{name}.toml"
        if not path.is_file():
            known = ", ".join(sorted(path.stem for path in _FOLDER.glob("*.toml")))
            raise ValueError(f"--recipe: expected a file or one of {known}; found {name}")
        try:
            found = tomllib.loads(path.read_text(encoding="utf-8"))
            if "recipe" in found:
                return Recipe.read(found["recipe"])._without(found["without"], path.stem, found["title"])
            sources = [RecipeSource(option, **source) for option, source in found["sources"].items()]
            return Recipe(
                name=path.stem,
                title=found["title"],
                command=found["command"],
                processes=found["processes"],
                options=found["options"],
                sources=tuple(sources),
                licences=found.get("licences", {}),
            )
        except (tomllib.TOMLDecodeError, KeyError, TypeError) as error:
            raise ValueError(f"{path}: expected a recipe with the keys of the shipped ones, found {error}") from error

    def _without(self, option: str, name: str, title: str) -> "Recipe":
        """Drop one source and its licence, for an ablation of the data."""
        sources = tuple(source for source in self.sources if source.option != option)
        dropped = {source.name for source in self.sources if source.option == option}
        licences = {key: text for key, text in self.licences.items() if key not in dropped}
        return replace(self, name=name, title=title, sources=sources, licences=licences)

    def for_folders(self, folders: dict[str, int]) -> "Recipe":
        """Drop the sources without folders."""
        return replace(self, sources=tuple(source for source in self.sources if folders.get(source.option)))

    def weights(self, folders: dict[str, int]) -> tuple[float, ...]:
        """Compute the weight of each folder, in the order of `folders`; all sources need folders."""
        by_option = {source.option: source for source in self.sources}
        if missing := [option for option in by_option if not folders.get(option)]:
            wanted = ", ".join(f"--{option}" for option in by_option)
            raise ValueError(f"training data: expected {wanted} (recipe {self.name}), found no --{missing[0]}")
        if extra := [option for option, count in folders.items() if count and option not in by_option]:
            raise ValueError(f"--{extra[0]}: expected none (recipe {self.name}), found {folders[extra[0]]}")
        shares = [[by_option[option].weight / count] * count for option, count in folders.items() if count]
        return tuple(share for folder in shares for share in folder)


def say_plan(recipe: Recipe | None, loop: LoopOptions, size: str, processes: int, console: Console) -> None:
    """Print the plan of a training: steps, size and processes; with a recipe, also data and licences."""
    place = "processes on the CPU" if loop.cpu else "GPUs"
    lines = [
        f"plan: {loop.steps:,} steps of {loop.batch} pairs at {size}, Adam at {loop.rate:g}, on {processes} {place}"
    ]
    if recipe is not None:
        lines.insert(0, f"recipe {recipe.name}: {recipe.title}")
        total = sum(source.weight for source in recipe.sources)
        for source in recipe.sources:
            drawn = f"{source.weight / total:.0%} of the drawn pairs"
            counts = f"{source.targets:,} targets and {source.composites:,} composites"
            lines.append(f"data: {source.name} (--{source.option}), {counts}, {drawn}")
        lines += [f"licence: {name}: {licence}" for name, licence in recipe.licences.items()]
    for line in lines:
        console.say(line)


def option_words(options: Mapping[str, Any]) -> list[str]:
    """Convert options of a table to command-line arguments, which later arguments replace."""
    words: list[str] = []
    for name, value in options.items():
        if value is not False:
            values = value if isinstance(value, list) else [] if value is True else [value]
            words += [f"--{name}", *map(str, values)]
    return words


_STATES = 3  # two states are kept while a third is written
_RESERVED_BYTES = 2e9  # estimate for the autoencoder, libraries, the CUDA context and fragmentation
_GATHERED = 3  # blocks that are whole at once in shards: weights of two, because the next is fetched, and gradients
_COPIES = 40  # 16-bit copies of a block's tokens that its backward pass needs, as `working_bytes` of inference counts


@dataclass(frozen=True)
class TrainingMemory:
    """Memory and disk that a training needs, bytes; what depends on activations is an estimate."""

    state: int
    """Weights, gradients, both moments of Adam and the average, over all processes that share them."""
    device: float
    """Memory of each GPU, or of each process on the CPU."""
    host: float
    """Memory of a machine whose processes all load the weights at once."""
    disk: float
    """Largest size of states and model, without latents."""

    @staticmethod
    def of(network: Any, loop: LoopOptions, processes: int, *, tokens: int, checkpointing: bool) -> "TrainingMemory":
        """Count the bytes of a network's tensors, which may be on torch's meta device.

        Args:
            network: Network, whose trained parameters require gradients.
            loop: Options of the training.
            processes: Number of processes, all on one machine.
            tokens: Positions of a block of the network, times their channels, of one pass.
            checkpointing: Whether activations within a block are computed twice instead of kept.
        """
        trained = sum(p.numel() for p in network.parameters() if p.requires_grad)
        frozen = sum(p.nbytes for p in network.parameters() if not p.requires_grad)
        weights, copies = 4 * trained + frozen, 5 if loop.ema else 4
        blocks = [block for part in network.children() if isinstance(part, torch.nn.ModuleList) for block in part]
        in_shards = loop.parallel == "shards" and processes > 1
        largest = max((sum(p.numel() for p in block.parameters()) for block in blocks), default=0)
        divisor, gathered = (processes, 4 * largest * _GATHERED) if in_shards else (1, 0)
        # autocast keeps 16-bit copies of the trained weights during a forward pass, when there are no gradients yet
        half = 2 * trained if loop.precision == "bf16" else 0
        forward = (4 * trained * (copies - 1) + frozen) / divisor + half
        backward = (4 * trained * copies + frozen) / divisor
        activations = len(blocks) * tokens * 4 + _COPIES * tokens * 2 * (1 if checkpointing else len(blocks))
        device = max(weights, max(forward, backward) + gathered + activations) + _RESERVED_BYTES
        disk = _STATES * 4 * trained * (copies - 1) + 4 * trained
        return TrainingMemory(4 * trained * copies, device, processes * (device if loop.cpu else weights), disk)

    def say_and_check(self, loop: LoopOptions, processes: int, out: Path, console: Console) -> None:
        """Print the needs; raise a ValueError if this machine has less, as far as it has such devices."""
        place = "process on the CPU" if loop.cpu else "GPU"
        held = "in shards" if loop.parallel == "shards" and processes > 1 else "a copy of all weights in each"
        console.say(
            f"memory: about {self.device / 1e9:,.1f} GB on each {place} ({processes}, {held}), "
            f"{self.host / 1e9:,.1f} GB of the machine, {self.disk / 1e9:,.1f} GB of disk for states and model"
        )
        if not (loop.cpu or torch.cuda.is_available()):
            console.say("memory: not compared, because this machine has no GPU")
            return
        there = out.resolve()
        while not there.exists():
            there = there.parent
        # states that exist already are replaced
        existing = sum(path.stat().st_size for path in out.rglob("*.distcp"))
        found: dict[str, float | None] = {
            "disk": shutil.disk_usage(there).free + existing,
            "host": available_memory("cpu"),
            "device": None if loop.cpu else torch.cuda.get_device_properties(0).total_memory,
        }
        places = {"device": "on each GPU", "host": "of the machine's memory", "disk": f"of disk at {there}"}
        for name, free in found.items():
            if free is not None and getattr(self, name) > free:
                raise ValueError(
                    f"training: expected about {getattr(self, name) / 1e9:,.1f} GB {places[name]}, found "
                    f"{free / 1e9:,.1f} GB; try --parallel shards on more GPUs (torchrun), or --lora"
                )


def arguments_with_recipe(command: str, words: list[str]) -> list[str]:
    """Put the arguments of a command's recipe before the user's own, which replace them."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--recipe")
    name = parser.parse_known_args(words)[0].recipe
    if name is None:
        return words
    recipe = Recipe.read(name)
    if recipe.command != command:
        found = (Recipe.read(path.stem) for path in sorted(_FOLDER.glob("*.toml")))
        known = ", ".join(one.name for one in found if one.command == command)
        raise ValueError(f"--recipe: expected a recipe of `{command}` ({known}), found {name} of `{recipe.command}`")
    return [*option_words(recipe.options), *words]
