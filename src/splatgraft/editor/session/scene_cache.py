"""Scenes and cameras of a project, read once and kept until their file changes; composites of what is placed.

Knows nothing about browsers and pictures.
"""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from splatgraft.composition import compose
from splatgraft.core.cameras import Cameras
from splatgraft.core.composite import Composite
from splatgraft.core.gaussians import Gaussians
from splatgraft.editor.session.edit_state import EditState
from splatgraft.editor.session.placement_moves import Placeable, placeable
from splatgraft.editor.session.project_access import ProjectFiles
from splatgraft.formats import read_cameras, read_gaussians
from splatgraft.formats.placement import ObjectPlacement, read_erased
from splatgraft.relighting import SourceScene


class Scenes:
    """What the files of a project hold, by path; the same object until the file is another one."""

    def __init__(self, files: ProjectFiles) -> None:
        """Nothing read yet."""
        self.files = files
        self._kept: dict[tuple[str, Path], tuple[tuple[int, int], Any]] = {}
        self._derived: dict[str, tuple[tuple[Any, ...], Any]] = {}
        self._lock = threading.RLock()

    def gaussians(self, path: Path) -> Gaussians:
        """The scene in a file.

        Raises: ValueError where it is missing or broken.
        """
        return self._read("gaussians", path, read_gaussians)

    def cameras(self, path: Path) -> Cameras:
        """The cameras in a file.

        Raises: ValueError where it is missing or broken.
        """
        return self._read("cameras", path, read_cameras)

    def lifted(self) -> Bool[Tensor, "n"] | None:
        """Which Gaussians of the source the last `segment` took, corrections included; None before the first."""
        if not self.files.selection.is_file() or not self.files.source_scene.is_file():
            return None
        found = self._read("selection", self.files.selection, read_erased)
        # of another reconstruction: it says nothing about this one
        return found if len(found) == self.gaussians(self.files.source_scene).count else None

    def object_path(self, item: ObjectPlacement) -> Path:
        """The file of a placed object."""
        return item.object_path or self.files.object

    def placeable(self, item: ObjectPlacement) -> Placeable:
        """A placed object with its foot.

        Raises: ValueError where its file is missing, broken or empty.
        """
        path = self.object_path(item)
        gaussians = self.gaussians(path)
        own = path == self.files.object
        cameras = self.cameras(self.files.source_cameras if own else self.files.target_cameras)
        surroundings = self.gaussians(self.files.surroundings) if own and self.files.surroundings.is_file() else None
        return self.derive(
            f"placeable {path}", (gaussians, cameras, surroundings), lambda: placeable(gaussians, cameras, surroundings)
        )

    def composite(self, state: EditState) -> Composite:
        """The target with the placed objects.

        Raises: ValueError where a file is missing or broken, or what is erased belongs to another target.
        """
        target, items = self.gaussians(self.files.target_scene), state.objects or ()
        objects = [self.gaussians(self.object_path(item)) for item in items]
        moves = [item.target_from_object for item in items]
        erased = state.erased
        if erased is None:
            erased = self.derive("nothing", (target,), lambda: torch.zeros(target.count, dtype=torch.bool))
        return compose(target, objects, target_from_objects=moves, erased=erased)

    def others(self, name: str, flags: Bool[Tensor, "n"]) -> Bool[Tensor, "n"]:
        """All but those; the same tensor for the same flags of that name."""
        return self.derive(f"others {name}", (flags,), lambda: ~flags)

    def source_scenes(self, state: EditState) -> list[SourceScene | None]:
        """What each object was taken from, as the step `relight` knows it: of the project's own and its copies."""
        own = [self.object_path(item) == self.files.object for item in state.objects or ()]
        if not any(own) or not self.files.surroundings.is_file():
            return [None] * len(own)
        parts = (self.gaussians(self.files.surroundings), self.cameras(self.files.source_cameras))
        source = self.derive("source", parts, lambda: SourceScene(*parts))
        return [source if flag else None for flag in own]

    def _read(self, kind: str, path: Path, read: Callable[[Path], Any]) -> Any:
        with self._lock:
            stamp = (path.stat().st_mtime_ns, path.stat().st_size) if path.is_file() else (0, 0)
            kept = self._kept.get((kind, path))
            if kept is None or kept[0] != stamp:
                kept = (stamp, read(path))
                self._kept[kind, path] = kept
            return kept[1]

    def derive(self, name: str, inputs: tuple[Any, ...], make: Callable[[], Any]) -> Any:
        """What `make` gives; the same object until one of `inputs` is another one."""
        with self._lock:
            kept = self._derived.get(name)
            if kept is None or any(a is not b for a, b in zip(kept[0], inputs, strict=True)):
                kept = (inputs, make())
                self._derived[name] = kept
            return kept[1]
