"""A project's scenes and cameras in memory, read again when a file changes, and composites of the placed objects."""

import json
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from splatgraft.compositing.composite import Composite
from splatgraft.composition import compose, object_base
from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.clock_sun import ClockSun
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.posed_images import PosedImages
from splatgraft.editor.placement import PlaceableObject
from splatgraft.editor.project import ProjectFiles
from splatgraft.editor.state import EditState, stamp_of
from splatgraft.folders.clock_sun import clock_sun_path, read_clock_sun
from splatgraft.formats import read_cameras, read_capture, read_gaussians
from splatgraft.project.gaussian_flags import read_flags
from splatgraft.project.layout import Side
from splatgraft.project.placement import ObjectPlacement, read_placement
from splatgraft.relighting import SourceScene
from splatgraft.runtime.memo import Memo


class SceneCache:
    """Contents of a project's files; the same object is returned until the file changes."""

    def __init__(self, files: ProjectFiles) -> None:
        """Start empty."""
        self.files, self._memo = files, Memo()
        self._locks: dict[str, threading.RLock] = {}

    def gaussians(self, path: Path) -> Gaussians:
        """Read the scene in a file."""
        return self._read("gaussians", path, read_gaussians)

    def scene(self, side: Side) -> Gaussians:
        """Read the reconstruction of a side."""
        return self.gaussians(self.files.scenes[side])

    def cameras(self, side: Side) -> Cameras:
        """Read the cameras of a side."""
        return self._read("cameras", self.files.cameras[side], read_cameras)

    def capture(self) -> PosedImages:
        """Read the posed images of the source."""
        return self._read("capture", self.files.cameras["source"], lambda path: read_capture(path.parent))

    def photo(self, index: int) -> Path:
        """Return the path of a photo of the source, even if `capture` fails because too many masks are missing."""
        path = self.files.cameras["source"]
        return self._read("photos", path, lambda path: _named(path, "file_path"))[index] or path

    def missing_masks(self) -> list[Path]:
        """List the masks that the source's transforms.json names but that do not exist."""
        masks = self._read("masks", self.files.cameras["source"], lambda path: _named(path, "mask_path"))
        return [mask for mask in masks if mask is not None and not mask.is_file()]

    def segmented(self) -> Bool[Tensor, "n"] | None:
        """Return the flags of the source's Gaussians by the last `segment`; None without a valid result."""
        if not self.files.selection.is_file() or not self.files.scenes["source"].is_file():
            return None
        found = self._read("selection", self.files.selection, read_flags)
        # flags of another reconstruction do not apply
        return found if len(found) == self.scene("source").count else None

    def composed_objects(self) -> tuple[ObjectPlacement, ...]:
        """Read the objects as `compose` placed them; the project's own object gets no path."""

        def read(path: Path) -> tuple[ObjectPlacement, ...]:
            own, items = self.files.object.resolve(), read_placement(path).objects
            is_own = [item.object_path is not None and item.object_path.resolve() == own for item in items]
            return tuple(replace(x, object_path=None) if flag else x for x, flag in zip(items, is_own, strict=True))

        return self._read("placement", self.files.placement, read)

    def object_path(self, item: ObjectPlacement) -> Path:
        """Return the file of a placed object."""
        return item.object_path or self.files.object

    def placeable_object(self, item: ObjectPlacement) -> PlaceableObject:
        """Return a placed object with its base."""
        path = self.object_path(item)
        gaussians, own = self.gaussians(path), path == self.files.object
        cameras = self.cameras("source" if own else "target")
        surroundings = self.gaussians(self.files.surroundings) if own and self.files.surroundings.is_file() else None

        def make() -> PlaceableObject:
            base = object_base(gaussians, up=estimate_up(cameras), surroundings=surroundings)
            return PlaceableObject(gaussians, base, cameras, surroundings)

        return self.derive(f"placeable_object {path}", (gaussians, cameras, surroundings), make)

    def composite(self, state: EditState) -> Composite:
        """Compose the target with the placed objects; the same edits give the same object."""
        target = self.scene("target")

        def make() -> Composite:
            items, erased = state.objects or (), state.erased
            if erased is None:
                erased = self.derive("none erased", (target,), lambda: torch.zeros(target.count, dtype=torch.bool))
            objects = [self.gaussians(self.object_path(item)) for item in items]
            moves = [item.target_from_object for item in items]
            return compose(target, objects, target_from_objects=moves, erased=erased)

        return self.derive("composite", (target, state.objects, state.erased), make)

    def source_scenes(self, state: EditState) -> list[SourceScene | None]:
        """List the source scene of each placed object, as in the step `relight`; None for other files' objects."""
        own = [self.object_path(item) == self.files.object for item in state.objects or ()]
        if not any(own) or not self.files.surroundings.is_file():
            return [None] * len(own)
        inputs = (self.gaussians(self.files.surroundings), self.cameras("source"))
        clock = self._clock("source")
        source = self.derive("source", (*inputs, clock), lambda: SourceScene(*inputs, clock=clock))
        return [source if flag else None for flag in own]

    def target_clock(self) -> ClockSun | None:
        """Read the sun by the clock of the target's photos."""
        return self._clock("target")

    def _clock(self, side: Side) -> ClockSun | None:
        return self._read("clock", clock_sun_path(self.files.cameras[side]), read_clock_sun)

    def derive(self, name: str, inputs: tuple[Any, ...], make: Callable[[], Any]) -> Any:
        """Return the memoised result of `make`, computed again when one of `inputs` is another object."""
        # one lock per name, so that nothing else waits for a computation or a large file
        with self._locks.setdefault(name, threading.RLock()):
            return self._memo.get(name, inputs, make)

    def _read(self, kind: str, path: Path, read: Callable[[Path], Any]) -> Any:
        return self.derive(f"{kind} {path}", stamp_of(path), lambda: read(path))


def _named(transforms: Path, key: str) -> list[Path | None]:
    """List the file under a key of each frame of a transforms.json from the step `capture`."""
    content = json.loads(transforms.read_text(encoding="utf-8")) if transforms.is_file() else {"frames": []}
    return [transforms.parent / frame[key] if key in frame else None for frame in content["frames"]]
