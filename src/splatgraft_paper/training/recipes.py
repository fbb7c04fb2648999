"""Recipes of trainings: the paper's experiments as TOML, their command-line options, and their estimated cost."""

import argparse
import math
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from splatgraft.runtime.console import Console
from splatgraft_paper.synthesis.jobs import parse_image_size
from splatgraft_paper.training.loop import LoopOptions

_FOLDER = Path(__file__).with_name("recipe_files")
# H100 seconds per pair at 704x496. FLUX, all weights: the paper's two days on four for 50K steps of 4 pairs (Sec. 5.3)
_GPU_SECONDS_PER_PAIR = 48 * 3600 * 4 / (50_000 * 4)
# Stable Diffusion 2, estimated: 4 x 1.1 TFLOP at the 52 TFLOP/s of the paper's harmoniser
_REMOVAL_SECONDS_PER_PAIR = 0.08
_PAPER_PIXELS = 704 * 496
_LATENT_BYTES_PER_PIXEL = 16 / 64 * 2  # 16 channels of bfloat16 for 8 x 8 pixels


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
            found = tomllib.loads(path.read_text())
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

    def words(self) -> list[str]:
        """Convert the options to command-line arguments, which later arguments replace."""
        words = []
        for name, value in self.options.items():
            if value is True:
                words.append(f"--{name}")
            elif value is not False:
                words += [f"--{name}", str(value)]
        return words

    def of(self, folders: dict[str, int]) -> "Recipe":
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


@dataclass(frozen=True)
class TrainingCost:
    """Sizes that determine the time and disk space of a training."""

    loop: LoopOptions
    size: str
    """Pixels, WIDTHxHEIGHT."""
    parameters: int
    trained: int
    """Number of trained parameters; smaller with a low-rank adaptation."""
    removal: bool = False
    """Whether the object removal is trained instead of FLUX."""

    def hours(self, processes: int) -> float:
        """Estimate the hours of a training on H100 cards."""
        pixels = math.prod(parse_image_size(self.size))
        each = _REMOVAL_SECONDS_PER_PAIR if self.removal else _GPU_SECONDS_PER_PAIR * self.parameters / 11.8e9
        return self.loop.steps * self.loop.batch * each * pixels / _PAPER_PIXELS / processes / 3600

    @property
    def state_bytes(self) -> int:
        """Bytes of three states, two kept and one being written: weights, Adam's moments, the average."""
        return 3 * self.trained * (4 + 8 + 4 * (self.loop.ema > 0))


def say_plan(recipe: Recipe | None, cost: TrainingCost, processes: Any, console: Console) -> None:
    """Print the plan of a training: steps, hours and disk; with a recipe, also data and licences.

    `processes` is accelerate's Accelerator; without a launcher, the plan is for the recipe's number of processes.
    """
    count = recipe.processes if recipe and processes.num_processes == 1 else processes.num_processes
    if processes.is_main_process:
        for line in _plan(recipe, cost, count):
            console.say(line)


def _plan(recipe: Recipe | None, cost: TrainingCost, processes: int) -> list[str]:
    loop, sources = cost.loop, recipe.sources if recipe else ()
    pictures = sum(2 * source.targets + source.composites for source in sources)
    latents = round(pictures * math.prod(parse_image_size(cost.size)) * _LATENT_BYTES_PER_PIXEL)
    basis = "4 x 1.1 TFLOP a pair at 52 TFLOP/s"
    basis = basis if cost.removal else "the paper's two days, scaled by pairs, pixels and weights"
    disk = f"{_size(4 * cost.parameters)} for the model, {_size(cost.state_bytes)} for states"
    lines = [
        f"plan: {loop.steps:,} steps of {loop.batch} pairs at {cost.size}, Adam at {loop.rate:g}, on {processes} GPUs",
        f"hours: about {cost.hours(processes):.2g} on {processes} H100 (an estimate: {basis})",
        f"disk: {disk}, {_size(latents) if sources else 'half a byte a pixel'} for latents",
    ]
    if recipe is None:
        return lines
    total = sum(source.weight for source in sources)
    for source in sources:
        drawn = f"{source.weight / total:.0%} of the drawn pairs"
        counts = f"{source.targets:,} targets and {source.composites:,} composites"
        lines.append(f"data: {source.name} (--{source.option}), {counts}, {drawn}")
    licences = [f"licence: {name}: {licence}" for name, licence in recipe.licences.items()]
    return [f"recipe {recipe.name}: {recipe.title}", *lines, *licences]


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
    return [*recipe.words(), *words]


def _size(count: int) -> str:
    if count >= 1e8:
        return f"{count / 1e9:.{0 if count >= 1e10 else 1}f} GB"
    return f"{count / 1e6:.0f} MB"
