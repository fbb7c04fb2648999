"""Recipes of trainings: the paper's experiments as TOML, their command-line options, and the plan of a training."""

import argparse
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

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

    def words(self) -> list[str]:
        """Convert the options to command-line arguments, which later arguments replace."""
        words = []
        for name, value in self.options.items():
            if value is True:
                words.append(f"--{name}")
            elif value is not False:
                words += [f"--{name}", str(value)]
        return words

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


def say_plan(recipe: Recipe | None, loop: LoopOptions, size: str, processes: Any, console: Console) -> None:
    """Print the plan of a training: steps, size and GPUs; with a recipe, also data and licences.

    `processes` is accelerate's Accelerator; without a launcher, the plan is for the recipe's number of processes.
    """
    if not processes.is_main_process:
        return
    count = recipe.processes if recipe and processes.num_processes == 1 else processes.num_processes
    lines = [f"plan: {loop.steps:,} steps of {loop.batch} pairs at {size}, Adam at {loop.rate:g}, on {count} GPUs"]
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
