"""An open project: its edits with undo history, saved after every change, and its scenes and job."""

import threading
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.similarity import Similarity
from splatgraft.editor.history import History, StateStore
from splatgraft.editor.jobs import Jobs
from splatgraft.editor.pictures import Pictures
from splatgraft.editor.placement import ObjectSize, PlaceableObject
from splatgraft.editor.project import Project, ProjectFiles, in_words
from splatgraft.editor.scene_cache import SceneCache
from splatgraft.editor.state import EditState, check_height_cm, check_state, read_state, stamps_of, write_state
from splatgraft.project.layout import EDITOR_FOLDER, Side
from splatgraft.project.metric_scale import MetricScale, read_scale, write_scale
from splatgraft.project.placement import ObjectPlacement
from splatgraft.relighting import light_from_json, light_to_json
from splatgraft.runtime.files import is_disk_full
from splatgraft.segmentation import Box, add_correction, apply_corrections


class Session:
    """An open project."""

    def __init__(self, project: Project) -> None:
        """Open the project with the edits and the undo history of the last session.

        Raises:
            ValueError: If project.toml is missing or invalid, or one of the files of the edits.
        """
        files, self.project = project.files(), project
        self.scenes = SceneCache(files)
        self.pictures = Pictures(self.scenes)
        self.jobs = Jobs(files.root / EDITOR_FOLDER)
        self._store = StateStore(files.root, project_folder=files.file.parent)
        self._stamps = stamps_of(files.file)
        self.state: EditState = read_state(files.file)
        """The current edits; `change` replaces them."""
        self.is_unsaved = False
        """Whether the disk is full, so that edits cannot be saved."""
        saved, now = self._store.read_history(), self._store.name(self.state)
        # a change of the files while no editor was open is one more step
        self.history = History((now,)) if saved is None else saved if saved.present == now else saved.pushed(now)
        self._lock = threading.RLock()
        self.save_again()

    @property
    def files(self) -> ProjectFiles:
        """Paths and options of the project."""
        return self.scenes.files

    def save_again(self) -> bool:
        """Try to save the state and the history; return whether the disk had room."""
        with self._lock:
            try:
                self._store.save(self.state)
                self._store.save_history(self.history)
            except (ValueError, OSError) as error:
                if not is_disk_full(error):
                    raise
                self.is_unsaved = True
                return False
            self.is_unsaved = False
            return True

    def change(self, state: EditState) -> None:
        """Save a new state in one undo step, unless it is unchanged.

        Raises:
            ValueError: If a value is out of its range, the files cannot be written, or they were changed outside the
                editor. A readable outside change is loaded.
        """
        check_state(state)
        with self._lock:
            if state.light is not None and state.light is not self.state.light:
                # rounded as in light.json; a light that stays is the same object
                state = replace(state, light=light_from_json(light_to_json(state.light)))
            name = self._store.save(state)
            if name != self.history.present:
                self._apply(self.history.pushed(name), state)

    def step(self, by: int) -> bool:
        """Undo the last step (-1) or redo the next one (1); return False if there is none. Raises as `change`."""
        with self._lock:
            history = self.history.moved(by)
            if history is self.history:
                return False
            self._apply(history, self._store.read(history.present))
            return True

    def reload(self) -> bool:
        """Load changes made outside the editor in one undo step; return whether there were any.

        Raise ValueError if a file is invalid; nothing is saved until it is corrected.
        """
        with self._lock:
            stamps = stamps_of(self.files.file)
            if stamps == self._stamps:
                return False
            self.state, self.scenes.files = read_state(self.files.file), self.project.files()
            self._stamps = stamps
            name = self._store.save(self.state)
            if name != self.history.present:
                self._save_history(self.history.pushed(name))
            return True

    def set_view(self, side: Side, **keys: object) -> None:
        """Set `up` or `look` of a scene without photographs, None for the default; not an undo step.

        Raises as `change`.
        """
        with self._lock:
            self._refuse_outside_changes()
            self.project.set_keys(side, keys)
            self._stamps = stamps_of(self.files.file)
            self.scenes.files = self.project.files()

    def _apply(self, history: History, state: EditState) -> None:
        self._refuse_outside_changes()
        write_state(self.files.file, self.state, state)
        self.state, self._stamps = state, stamps_of(self.files.file)
        self._save_history(history)

    def _refuse_outside_changes(self) -> None:
        if self.reload():
            raise ValueError(
                f"{self.files.file.name}: changed outside the editor; the change was loaded, please repeat your edit"
            )

    def _save_history(self, history: History) -> None:
        self.history = history
        self._store.save_history(history)

    # the selection in the source

    def selection(self) -> Bool[Tensor, "n"] | None:
        """Flag the source's Gaussians of the object: segmented, or else in the box, with corrections."""
        if not self.files.scenes["source"].is_file():
            return None
        scene = self.scenes.scene("source")
        segmented, state = self.scenes.segmented(), self.state
        inputs = (scene, segmented, state.box, state.corrections)
        return self.scenes.derive("selected", inputs, lambda: self._selected(scene, segmented))

    def _selected(self, scene: Gaussians, segmented: Bool[Tensor, "n"] | None) -> Bool[Tensor, "n"]:
        corrections = self.state.corrections
        if segmented is None:
            box = self.box()
            segmented = torch.zeros(scene.count, dtype=torch.bool) if box is None else box.contains(scene.means)
        # corrections of another reconstruction do not apply
        fits = corrections is None or len(corrections) == scene.count
        return apply_corrections(segmented, corrections) if fits else segmented

    def box(self) -> Box | None:
        """Return the box around the object, in the source's world."""
        numbers = self.state.box
        return None if numbers is None else Box(torch.tensor(numbers[:3]), torch.tensor(numbers[3:]))

    def correct(self, flags: Bool[Tensor, "n"], *, add: bool) -> None:
        """Add Gaussians to the object or remove them from it."""
        corrections = self.state.corrections
        if corrections is not None and len(corrections) != len(flags):
            corrections = None  # of another reconstruction
        self.change(replace(self.state, corrections=add_correction(corrections, flags, add=add)))

    # the objects in the target

    def objects(self) -> tuple[ObjectPlacement, ...]:
        """Return the placed objects, as edited or as `compose` placed them."""
        if self.state.objects is not None:
            return self.state.objects
        files = self.files
        is_composed = all(path.is_file() for path in (files.object, files.scenes["target"], files.placement))
        return self.scenes.composed_objects() if is_composed else ()

    def placed_state(self) -> EditState:
        """Return the current state with the objects of `compose` filled in."""
        return self.state if self.state.objects is not None else replace(self.state, objects=self.objects())

    def placeable_object(self, index: int) -> PlaceableObject:
        """Return a placed object with its base."""
        return self.scenes.placeable_object(self.objects()[index])

    def up(self, side: Side = "target") -> Float[Tensor, "3"]:
        """Return the up direction of the target, or of the source."""
        cameras = self.scenes.cameras(side)
        return self.scenes.derive(f"up {side}", (cameras,), lambda: estimate_up(cameras))

    def set_placement(self, index: int, target_from_object: Similarity) -> None:
        """Change the placement of one object."""
        item = replace(self.objects()[index], target_from_object=target_from_object)
        self.change(self.placed_state().with_object(index, item))

    # metric sizes

    def size(self, index: int) -> ObjectSize:
        """Return the size of one placed object; raise ValueError if a scale.json cannot be read."""
        item, height = self.objects()[index], self.placeable_object(index).base.height
        is_own = self.scenes.object_path(item) == self.files.object
        own = read_scale(self.files.cameras["source"]) if is_own else None
        true_cm, cm_per_scale = (
            None if known is None else 100 * known.metres_per_unit * height
            for known in (own, read_scale(self.files.cameras["target"]))
        )
        return ObjectSize(item.target_from_object.scale, true_cm, cm_per_scale)

    def set_scale(self, index: int, cm: float, side: Side) -> Path:
        """Store the scale of a capture from the height of a placed object in it; return the file."""
        check_height_cm(cm)
        item, height, by = self.objects()[index], self.placeable_object(index).base.height, "the object's"
        path = self.scenes.object_path(item)
        if side == "target":
            height, by = item.target_from_object.scale * height, "a placed object's"
        elif path != self.files.object:
            raise ValueError(
                f"{path}: expected the object of the project's source, found one that was added from a file"
            )
        found = MetricScale(0.01 * cm / height, f"{by} height of {cm:g} cm")
        return write_scale(self.files.cameras[side], found)

    # stale steps

    def why_stale(self, *steps: str) -> str | None:
        """Return the original reason why one of these steps is out of date; None if all are up to date."""
        try:
            found = self.project.reasons()
        except ValueError as error:
            return str(error)
        name, reason = next(((step, found[step]) for step in steps if found.get(step) is not None), ("", None))
        while reason is not None and (before := reason.removeprefix("waits for ")) in found and before != reason:
            name, reason = before, found[before]
        if reason is None:
            return None
        words = in_words(name, reason)
        return words if words != reason else f"{name}: {reason}"
