"""Folders of pictures below a folder, what their names say that they show, and which pictures show the same view."""

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import torch

from splatgraft.core.images import IMAGE_SUFFIXES
from splatgraft.core.posed_images import held_out

Role = Literal["masks", "truth", "composite", "background"]
ROLES: tuple[Role, ...] = get_args(Role)

_WORDS: dict[Role, frozenset[str]] = {
    "masks": frozenset({"mask", "masks", "alpha", "alphas", "seg", "segmentation"}),
    "truth": frozenset({"gt", "truth", "groundtruth", "gts", "reference"}),
    "composite": frozenset({"composite", "composites", "composited", "naive", "pasted", "paste", "copypaste"}),
    "background": frozenset({"background", "backgrounds", "bg", "empty", "target"}),
}
"""Words of a folder's name from which its role is taken."""
_DEEPEST = 5
"""Levels of folders that are searched."""


@dataclass(frozen=True)
class PictureFolder:
    """A folder with pictures directly in it."""

    path: Path
    parts: tuple[str, ...]
    """Names of the folders from the one that was searched down to this one."""

    @property
    def role(self) -> Role | None:
        """What its own name says, or that of the nearest folder above; None where none says anything."""
        return next((role for part in reversed(self.parts) if (role := role_of(part)) is not None), None)


def role_of(name: str) -> Role | None:
    """The role that one folder's name says: "object_masks" is masks, "gt_images" the truth."""
    words = set(re.split(r"[^a-z0-9]+", name.lower()))
    return next((role for role in ROLES if words & _WORDS[role]), None)


def picture_folders(folder: Path) -> list[PictureFolder]:
    """All folders at or below `folder` with pictures in them, in the order of their paths."""
    found = []
    for path, below, files in os.walk(folder):
        here = Path(path)
        parts = here.relative_to(folder).parts
        below[:] = [] if len(parts) >= _DEEPEST else sorted(name for name in below if not name.startswith("."))
        if any(_is_picture(name) for name in files):
            found.append(PictureFolder(here, parts))
    return found


def pictures(folder: Path) -> dict[str, Path]:
    """Pictures directly in `folder` by the stem of their name, numbers in their order.

    Raises:
        ValueError: There is no such folder, or it has no pictures.
    """
    names = [entry.name for entry in folder.iterdir() if _is_picture(entry.name)] if folder.is_dir() else []
    if not names:
        raise ValueError(f"{folder}: expected pictures, found {'none' if folder.is_dir() else 'no such folder'}")
    return {Path(name).stem: folder / name for name in sorted(names, key=_in_order)}


def held_out_stems(stems: Sequence[str], every: int) -> list[str]:
    """Every `every`th view from the first, in the order of the names (as Mip-NeRF 360 and 3DGS hold out)."""
    chosen = torch.nonzero(held_out(len(stems), every)).flatten().tolist()
    return [stems[int(index)] for index in chosen]


def match_views(wanted: Sequence[str], found: dict[str, Path], every: int) -> tuple[dict[str, Path], str]:
    """Which picture of a method shows which view.

    Args:
        wanted: Names of all views, in their order.
        found: The method's pictures by stem, in their order.
        every: Which views are held out.

    Returns:
        The views that the method has pictures of, and how they were matched: by name; or, as 3DGS's render.py numbers
        its pictures, by order where there are as many as views or as held-out views. Empty where neither fits.
    """
    if same := {stem: found[stem] for stem in wanted if stem in found}:
        return same, f"{len(same)} of {len(wanted)} views by name"
    paths = list(found.values())
    numbered = all(stem.isdigit() for stem in found)
    for views, what in ((list(wanted), "all"), (held_out_stems(wanted, every), "the held-out")):
        if numbered and len(paths) == len(views):
            return dict(zip(views, paths, strict=True)), f"{what} {len(views)} views by order, as pictures are numbered"
    return {}, f"none of {len(found)} pictures fits {len(wanted)} views, neither by name nor by number"


def _is_picture(name: str) -> bool:
    return Path(name).suffix.lower() in IMAGE_SUFFIXES and not name.startswith(".")


def _in_order(name: str) -> list[tuple[int, str | int]]:
    return [(0, int(part)) if part.isdigit() else (1, part) for part in re.split(r"(\d+)", Path(name).stem)]
