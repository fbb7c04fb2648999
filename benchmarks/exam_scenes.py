"""Rendered scenes for benchmarks/fit_*.py, in the folders that `splatgraft paper exam` writes."""

import argparse
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from splatgraft.reconstruction import ReconstructOptions
from splatgraft.runtime.console import Console
from splatgraft_paper.exam.scenes import ExamScene, read_scene
from splatgraft_paper.synthesis.places import OUTDOORS

RECONSTRUCTION = ReconstructOptions(iterations=1000, budget=20_000)


def scene_arguments(description: str | None) -> argparse.ArgumentParser:
    """Add the arguments that name scenes."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("scenes", type=Path, nargs="+", help="folders of scenes with known light")
    parser.add_argument("--work", type=Path, nargs="+", required=True, help="their reconstructions, in the same order")
    return parser


def scenes_in(options: argparse.Namespace) -> Iterator[tuple[str, Callable[[], ExamScene]]]:
    """Yield EXAM-SCENE and a reader of each scene with known light, which is reconstructed first if necessary."""
    for folder, work in zip(options.scenes, options.work, strict=True):
        for path in sorted(p for p in folder.iterdir() if (p / "probe.npy").is_file()):
            name = f"{folder.resolve().parent.name}-{path.name}"
            yield name, partial(read_scene, path, work / path.name, RECONSTRUCTION, Console())


def is_outdoors(name: str) -> bool:
    """Return whether a scene with this name is out of doors."""
    return any(kind in name for kind in OUTDOORS)
