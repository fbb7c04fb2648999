"""Cache of a project's scenes and cameras, invalidated when a file changes, and composites of the placed objects."""

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
from splatgraft.core.posed_images import PosedImages
from splatgraft.editor.session.edit_state import EditState
from splatgraft.editor.session.placement_operations import PlaceableObject, placeable_object
from splatgraft.editor.session.project_access import ProjectFiles
from splatgraft.formats import read_cameras, read_capture, read_gaussians
from splatgraft.formats.placement import ObjectPlacement, read_erased
from splatgraft.relighting import SourceScene
from splatgraft.runtime.memo import Memo


class SceneCache:
    """Contents of a project's files; the same object is returned until the file changes."""

    def __init__(self, files: ProjectFiles) -> None:
        """Start empty."""
        self.files = files
        self._contents: dict[tuple[str, Path], tuple[tuple[int, int], Any]] = {}
        self._derived = Memo()
        self._lock = threading.RLock()

    def gaussians(self, path: Path) -> Gaussians:
        """The scene in a file.

        Raises:
            ValueError: If the file is missing or invalid.
        """
        return self._read("gaussians", path, read_gaussians)

    def cameras(self, path: Path) -> Cameras:
        """The cameras in a file.

        Raises:
            ValueError: If the file is missing or invalid.
        """
        return self._read("cameras", path, read_cameras)

    def capture(self, path: Path) -> PosedImages:
        """The posed images whose cameras are in a file.

        Raises:
            ValueError: If the file or one that it names is missing or invalid.
        """
        return self._read("capture", path, lambda path: read_capture(path.parent))

    def segmented(self) -> Bool[Tensor, "n"] | None:
        """Flags of the source's Gaussians in the last result of `segment`; None where there is none."""
        if not self.files.selection.is_file() or not self.files.source_scene.is_file():
            return None
        found = self._read("selection", self.files.selection, read_erased)
        # flags of another reconstruction do not apply
        return found if len(found) == self.gaussians(self.files.source_scene).count else None

    def object_path(self, item: ObjectPlacement) -> Path:
        """The file of a placed object."""
        return item.object_path or self.files.object

    def placeable_object(self, item: ObjectPlacement) -> PlaceableObject:
        """A placed object with its base.

        Raises:
            ValueError: If its file is missing, invalid or empty.
        """
        path = self.object_path(item)
        gaussians = self.gaussians(path)
        own = path == self.files.object
        cameras = self.cameras(self.files.source_cameras if own else self.files.target_cameras)
        surroundings = self.gaussians(self.files.surroundings) if own and self.files.surroundings.is_file() else None
        return self.derive(
            f"placeable_object {path}",
            (gaussians, cameras, surroundings),
            lambda: placeable_object(gaussians, cameras, surroundings),
        )

    def composite(self, state: EditState) -> Composite:
        """The target with the placed objects.

        Raises:
            ValueError: If a file is missing or invalid, or the erased flags belong to another target.
        """
        target, items = self.gaussians(self.files.target_scene), state.objects or ()
        objects = [self.gaussians(self.object_path(item)) for item in items]
        moves = [item.target_from_object for item in items]
        erased = state.erased
        if erased is None:
            erased = self.derive("none erased", (target,), lambda: torch.zeros(target.count, dtype=torch.bool))
        return compose(target, objects, target_from_objects=moves, erased=erased)

    def complement(self, name: str, flags: Bool[Tensor, "n"]) -> Bool[Tensor, "n"]:
        """The inverted flags; the same tensor for the same flags of that name."""
        return self.derive(f"complement {name}", (flags,), lambda: ~flags)

    def source_scenes(self, state: EditState) -> list[SourceScene | None]:
        """The source scene of each placed object, as in the step `relight`; None for objects from other files."""
        own = [self.object_path(item) == self.files.object for item in state.objects or ()]
        if not any(own) or not self.files.surroundings.is_file():
            return [None] * len(own)
        inputs = (self.gaussians(self.files.surroundings), self.cameras(self.files.source_cameras))
        source = self.derive("source", inputs, lambda: SourceScene(*inputs))
        return [source if flag else None for flag in own]

    def _read(self, kind: str, path: Path, read: Callable[[Path], Any]) -> Any:
        with self._lock:
            stamp = (path.stat().st_mtime_ns, path.stat().st_size) if path.is_file() else (0, 0)
            cached = self._contents.get((kind, path))
            if cached is None or cached[0] != stamp:
                cached = (stamp, read(path))
                self._contents[kind, path] = cached
            return cached[1]

    def derive(self, name: str, inputs: tuple[Any, ...], make: Callable[[], Any]) -> Any:
        """The memoised result of `make`, computed again when one of `inputs` is another object."""
        with self._lock:
            return self._derived.get(name, inputs, make)
