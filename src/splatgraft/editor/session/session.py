"""An open project: its edits with undo history, saved after every change, and its scenes, previews and job."""

import threading
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.similarity import Similarity
from splatgraft.editor.jobs.jobs import Jobs, JobState
from splatgraft.editor.previews.preview import Preview
from splatgraft.editor.previews.preview_relighting import PreviewRelighting
from splatgraft.editor.session.edit_state import EditState, as_written, read_state, state_files, write_state
from splatgraft.editor.session.history import History
from splatgraft.editor.session.placement_operations import PlaceableObject
from splatgraft.editor.session.project_access import Project, ProjectFiles, Triple
from splatgraft.editor.session.scene_cache import SceneCache
from splatgraft.editor.session.state_store import StateStore
from splatgraft.formats.placement import ObjectPlacement, read_placement
from splatgraft.project.layout import Side
from splatgraft.segmentation import Box, add_correction, apply_corrections

EDITOR_FOLDER = ".editor"


class Session:
    """An open project."""

    def __init__(self, project: Project) -> None:
        """Open the project with the edits and the undo history of the last session.

        Raises:
            ValueError: If project.toml is missing or invalid.
        """
        files = project.files()
        if files is None:
            raise ValueError(f"{project.file}: expected a project, found none")
        self.project = project
        self.files: ProjectFiles = files
        self.scenes = SceneCache(files)
        self.relighting = PreviewRelighting(self.scenes)
        self.preview = Preview(self.scenes, self.relighting)
        self.jobs = Jobs(files.root / EDITOR_FOLDER)
        self.notice: str | None = None
        self._store = StateStore(files.root / EDITOR_FOLDER, project_folder=files.file.parent)
        self._state = read_state(files.file)
        self.history: History[str] = self._read_history()
        self._stamps = self._read_stamps()
        self._composed_objects: tuple[int, tuple[ObjectPlacement, ...]] = (0, ())
        self._lock = threading.RLock()

    @property
    def state(self) -> EditState:
        """The current edits."""
        return self._state

    def change(self, state: EditState) -> None:
        """Save a new state as one undo step.

        Raises:
            ValueError: If the files were changed outside the editor, which loads that change, or cannot be written.
        """
        with self._lock:
            state = as_written(state, self._state)
            name = self._store.save(state)
            # an unchanged state adds no undo step
            self._apply(self.history if name == self.history.present else self.history.pushed(name), state)

    def amend(self, state: EditState) -> None:
        """Save a changed state as a part of the present undo step.

        Raises:
            ValueError: As `change`.
        """
        with self._lock:
            state = as_written(state, self._state)
            self._apply(self.history.amended(self._store.save(state)), state)

    def undo(self) -> bool:
        """Go back by one step; False where there is none.

        Raises:
            ValueError: As `change`.
        """
        with self._lock:
            if not self.history.past:
                return False
            history = self.history.undone()
            self._apply(history, self._store.read(history.present))
            return True

    def redo(self) -> bool:
        """Go forward by one step; False where there is none.

        Raises:
            ValueError: As `change`.
        """
        with self._lock:
            if not self.history.future:
                return False
            history = self.history.redone()
            self._apply(history, self._store.read(history.present))
            return True

    def reload(self) -> bool:
        """Load changes made outside the editor as one undo step; whether there were any.

        Raises:
            ValueError: If a file is invalid.
        """
        with self._lock:
            stamps = self._read_stamps()
            if stamps == self._stamps:
                return False
            found = read_state(self.files.file)
            self._stamps, self._state = stamps, found
            name = self._store.save(found)
            if name != self.history.present:
                self._save_history(self.history.pushed(name))
            self._refresh_files()
            return True

    def _apply(self, history: History[str], state: EditState) -> None:
        if history.present == self.history.present:
            self._save_history(history)
            return
        if self.reload():
            raise ValueError(
                f"{self.files.file.name}: changed outside the editor; the change was loaded, please repeat your edit"
            )
        write_state(self.files.file, self._state, state)
        self._state, self._stamps = state, self._read_stamps()
        self._save_history(history)

    def _read_history(self) -> History[str]:
        """The saved history, with one more step where the files were changed while no editor was open."""
        try:
            saved = self._store.read_history()
        except ValueError as error:
            self.notice, saved = f"{error}; the undo history is empty now", None
        now = self._store.save(self._state)
        history = History(now) if saved is None else saved if saved.present == now else saved.pushed(now)
        self._store.save_history(history)
        return history

    def _save_history(self, history: History[str]) -> None:
        self.history = history
        self._store.save_history(history)

    def _refresh_files(self) -> None:
        files = self.project.files()
        if files is not None and files != self.files:
            self.files, self.scenes.files = files, files

    def _read_stamps(self) -> dict[Path, tuple[int, int]]:
        paths = [path for path in state_files(self.files.file) if path.is_file()]
        return {path: (path.stat().st_mtime_ns, path.stat().st_size) for path in paths}

    def set_view(self, side: Side, *, up: Triple | None, look: str | None) -> None:
        """Set how images of a scene without photographs are rendered; not an undo step.

        Raises:
            ValueError: As `change`.
        """
        with self._lock:
            if self.reload():
                raise ValueError(f"{self.files.file.name}: changed outside the editor; please repeat your edit")
            self.project.set_view(side, up=up, look=look)
            self._stamps = self._read_stamps()
            self._refresh_files()

    # the selection in the source

    def selection(self) -> Bool[Tensor, "n"] | None:
        """Flags of the source's Gaussians that are the object: segmented, else in the box, with corrections."""
        if not self.files.source_scene.is_file():
            return None
        scene = self.scenes.gaussians(self.files.source_scene)
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
        """The box around the object, in the source's world."""
        numbers = self.state.box
        return None if numbers is None else Box(torch.tensor(numbers[:3]), torch.tensor(numbers[3:]))

    def correct(self, flags: Bool[Tensor, "n"], *, add: bool) -> None:
        """Add Gaussians to the object or remove them from it.

        Raises:
            ValueError: As `change`.
        """
        corrections = self.state.corrections
        if corrections is not None and len(corrections) != len(flags):
            corrections = None  # of another reconstruction
        self.change(replace(self.state, corrections=add_correction(corrections, flags, add=add)))

    # the objects in the target

    def can_place(self) -> bool:
        """Whether the files of the object and the target exist."""
        return self.files.object.is_file() and self.files.target_scene.is_file()

    def objects(self) -> tuple[ObjectPlacement, ...]:
        """The placed objects: as edited, else as `compose` placed them."""
        if self.state.objects is not None:
            return self.state.objects
        if not self.can_place() or not self.files.placement.is_file():
            return ()
        stamp = self.files.placement.stat().st_mtime_ns
        if self._composed_objects[0] != stamp:
            found = read_placement(self.files.placement).objects
            # the project's own object is stored without a path
            items = tuple(
                replace(item, object_path=None) if _same_file(item.object_path, self.files.object) else item
                for item in found
            )
            self._composed_objects = (stamp, items)
        return self._composed_objects[1]

    def placed_state(self) -> EditState:
        """The current state with the objects that `compose` placed filled in."""
        return self.state if self.state.objects is not None else replace(self.state, objects=self.objects())

    def placeable_object(self, index: int) -> PlaceableObject:
        """A placed object with its base.

        Raises:
            ValueError: If its file is missing or empty.
        """
        return self.scenes.placeable_object(self.objects()[index])

    def up(self) -> Float[Tensor, "3"]:
        """Up direction of the target."""
        return estimate_up(self.scenes.cameras(self.files.target_cameras))

    def set_placement(self, index: int, target_from_object: Similarity) -> None:
        """Change the placement of one object.

        Raises:
            ValueError: As `change`.
        """
        item = replace(self.objects()[index], target_from_object=target_from_object)
        self.change(self.placed_state().with_object(index, item))

    # jobs

    def run(self, to: str, title: str) -> None:
        """Start a child process that runs the stale steps up to `to`.

        Raises:
            ValueError: If a job is running.
        """
        command, shown = self.project.run_command(to, title)
        self.jobs.start(command, title=title, shown=shown)

    def job(self) -> JobState | None:
        """The running job, else the last one; None where there was none."""
        return self.jobs.state()

    def reasons(self) -> Mapping[str, str | None]:
        """For each step why it is stale; None where it is up to date."""
        return self.project.reasons()


def _same_file(path: Path | None, other: Path) -> bool:
    return path is None or path.resolve() == other.resolve()
