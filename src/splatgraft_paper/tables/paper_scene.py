"""The values of a published data set: its scenes, and the folders and files of each."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

Kind = Literal["synthetic", "real", "rotation", "syncom"]
KINDS: tuple[Kind, ...] = get_args(Kind)
Dataset = Literal["dot3d", "syncom"]
DATASETS: tuple[Dataset, ...] = get_args(Dataset)
LAYOUT_FILE = "layout.toml"


@dataclass(frozen=True)
class PaperScene:
    """The folders and files of one scene of a data set; what is None was not found."""

    name: str
    kind: Kind
    pose: str = ""
    """P0, P1 or P2 in the rotation experiment."""
    folders: Mapping[str, Path] = field(default_factory=dict)
    """Role of pictures (truth, composite, background, masks) to their folder."""
    files: Mapping[str, Path] = field(default_factory=dict)
    """target_scene, object_scene (trained .ply, the object where it is to stand), cameras, placement, source_capture,
    target_capture."""
    results: Mapping[str, Path] = field(default_factory=dict)
    """Pictures of this scene that are there already: method to folder."""
    taken: tuple[str, ...] = ()
    """What was taken for what, one sentence each."""


@dataclass(frozen=True)
class DataLayout:
    """All scenes of a data set."""

    root: Path
    scenes: tuple[PaperScene, ...]
    held_out_every: int = 8
    """Every n-th view from the first is measured (paper, Sec. 7, after Mip-NeRF 360); 1 for all, of a data set whose
    measured views are none of those that a method is given."""
    dataset: Dataset = "dot3d"


def from_root(path: Path, root: Path) -> str:
    """The path as a layout.toml has it: relative to the data set where it lies in it."""
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path)


def subfolders(folder: Path) -> list[Path]:
    """Folders directly in `folder` that are not hidden, sorted; none where there is no such folder."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
