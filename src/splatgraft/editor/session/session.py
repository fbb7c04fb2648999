"""One project while it is edited: its state with history, saved after every step, its scenes and its job.

Knows nothing about browsers; `page/` shows what it holds and calls it.
"""

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
from splatgraft.editor.previews.transfers import Transfers
from splatgraft.editor.session.edit_state import EditState, as_written, read_state, state_files, write_state
from splatgraft.editor.session.history import History
from splatgraft.editor.session.placement_moves import Placeable
from splatgraft.editor.session.project_access import Project, ProjectFiles, Triple
from splatgraft.editor.session.scene_cache import Scenes
from splatgraft.editor.session.state_store import StateStore
from splatgraft.formats.placement import ObjectPlacement, read_placement
from splatgraft.project.results import Side
from splatgraft.segmentation import Box, add_correction, apply_corrections

EDITOR_FOLDER = ".editor"


class Session:
    """What the editor knows of a project that is open."""

    def __init__(self, project: Project) -> None:
        """Open it where it was left, with all steps that led there.

        Raises: ValueError where there is no project.toml, or it is broken.
        """
        files = project.files()
        if files is None:
            raise ValueError(f"{project.file}: expected a project, found none")
        self.project = project
        self.files: ProjectFiles = files
        self.scenes = Scenes(files)
        self.transfers = Transfers(self.scenes)
        self.preview = Preview(self.scenes, self.transfers)
        self.jobs = Jobs(files.root / EDITOR_FOLDER)
        self.notice: str | None = None
        self._store = StateStore(files.root / EDITOR_FOLDER, home=files.file.parent)
        self._state = read_state(files.file)
        self.history: History[str] = self._left_history()
        self._stamps = self._read_stamps()
        self._found: tuple[int, tuple[ObjectPlacement, ...]] = (0, ())
        self._lock = threading.RLock()

    @property
    def state(self) -> EditState:
        """What counts now."""
        return self._state

    def change(self, state: EditState) -> None:
        """One step that can be undone, saved at once.

        Raises: ValueError where the files were changed by someone else (they count then), or cannot be written.
        """
        with self._lock:
            state = as_written(state, self._state)
            name = self._store.keep(state)
            # what changes nothing is no step
            self._go(self.history if name == self.history.present else self.history.then(name), state)

    def amend(self, state: EditState) -> None:
        """A change that is no step of its own: it goes with the one before.

        Raises: ValueError as `change`.
        """
        with self._lock:
            state = as_written(state, self._state)
            self._go(self.history.amended(self._store.keep(state)), state)

    def undo(self) -> bool:
        """Back by one step; False where there is none.

        Raises: ValueError as `change`.
        """
        with self._lock:
            if not self.history.past:
                return False
            history = self.history.undone()
            self._go(history, self._store.read(history.present))
            return True

    def redo(self) -> bool:
        """Forward by one step; False where there is none.

        Raises: ValueError as `change`.
        """
        with self._lock:
            if not self.history.future:
                return False
            history = self.history.redone()
            self._go(history, self._store.read(history.present))
            return True

    def reload(self) -> bool:
        """Take over what someone else wrote into the files, as one step; whether there was anything.

        Raises: ValueError where a file is broken now.
        """
        with self._lock:
            stamps = self._read_stamps()
            if stamps == self._stamps:
                return False
            found = read_state(self.files.file)
            self._stamps, self._state = stamps, found
            name = self._store.keep(found)
            if name != self.history.present:
                self._remember(self.history.then(name))
            self._refresh_files()
            return True

    def _go(self, history: History[str], state: EditState) -> None:
        if history.present == self.history.present:
            self._remember(history)
            return
        if self.reload():
            raise ValueError(f"{self.files.file.name}: changed outside the editor; that counts now, please do it again")
        write_state(self.files.file, self._state, state)
        self._state, self._stamps = state, self._read_stamps()
        self._remember(history)

    def _left_history(self) -> History[str]:
        """The steps up to what the files say now; what was changed while no editor was open is one more."""
        try:
            left = self._store.history()
        except ValueError as error:
            self.notice, left = f"{error}; undo begins anew", None
        now = self._store.keep(self._state)
        history = History(now) if left is None else left if left.present == now else left.then(now)
        self._store.keep_history(history)
        return history

    def _remember(self, history: History[str]) -> None:
        self.history = history
        self._store.keep_history(history)

    def _refresh_files(self) -> None:
        files = self.project.files()
        if files is not None and files != self.files:
            self.files, self.scenes.files = files, files

    def _read_stamps(self) -> dict[Path, tuple[int, int]]:
        paths = [path for path in state_files(self.files.file) if path.is_file()]
        return {path: (path.stat().st_mtime_ns, path.stat().st_size) for path in paths}

    def set_view(self, side: Side, *, up: Triple | None, look: str | None) -> None:
        """Say how a scene without photographs is looked at: it shapes the pictures, and is no step to be undone.

        Raises: ValueError as `change`.
        """
        with self._lock:
            if self.reload():
                raise ValueError(f"{self.files.file.name}: changed outside the editor; please do it again")
            self.project.set_view(side, up=up, look=look)
            self._stamps = self._read_stamps()
            self._refresh_files()

    # what is selected in the source

    def selection(self) -> Bool[Tensor, "n"] | None:
        """The object's Gaussians among the source's: as lifted, or what lies in the box, with corrections."""
        if not self.files.source_scene.is_file():
            return None
        scene = self.scenes.gaussians(self.files.source_scene)
        lifted, state = self.scenes.lifted(), self.state
        inputs = (scene, lifted, state.box, state.corrections)
        return self.scenes.derive("selected", inputs, lambda: self._selected(scene, lifted))

    def _selected(self, scene: Gaussians, lifted: Bool[Tensor, "n"] | None) -> Bool[Tensor, "n"]:
        corrections = self.state.corrections
        if lifted is None:
            box = self.box()
            lifted = torch.zeros(scene.count, dtype=torch.bool) if box is None else box.contains(scene.means)
        # strokes over a scene that is no more say nothing about this one
        fits = corrections is None or len(corrections) == scene.count
        return apply_corrections(lifted, corrections) if fits else lifted

    def box(self) -> Box | None:
        """The box around the object, in the source's world."""
        numbers = self.state.box
        return None if numbers is None else Box(torch.tensor(numbers[:3]), torch.tensor(numbers[3:]))

    def correct(self, touched: Bool[Tensor, "n"], *, add: bool) -> None:
        """Add to the object or remove from it.

        Raises: ValueError as `change`.
        """
        corrections = self.state.corrections
        if corrections is not None and len(corrections) != len(touched):
            corrections = None  # of a scene that is no more
        self.change(replace(self.state, corrections=add_correction(corrections, touched, add=add)))

    # what is placed in the target

    def can_place(self) -> bool:
        """Whether there is an object and a target."""
        return self.files.object.is_file() and self.files.target_scene.is_file()

    def objects(self) -> tuple[ObjectPlacement, ...]:
        """The placed objects: as decided, else as `compose` placed them."""
        if self.state.objects is not None:
            return self.state.objects
        if not self.can_place() or not self.files.placement.is_file():
            return ()
        stamp = self.files.placement.stat().st_mtime_ns
        if self._found[0] != stamp:
            found = read_placement(self.files.placement).objects
            own = [_is(item.object_path, self.files.object) for item in found]
            items = tuple(replace(item, object_path=None) if o else item for item, o in zip(found, own, strict=True))
            self._found = (stamp, items)
        return self._found[1]

    def placed_state(self) -> EditState:
        """The state with its objects named, wherever they come from."""
        return self.state if self.state.objects is not None else replace(self.state, objects=self.objects())

    def placeable(self, index: int) -> Placeable:
        """A placed object with its foot.

        Raises: ValueError where its file is missing or empty.
        """
        return self.scenes.placeable(self.objects()[index])

    def up(self) -> Float[Tensor, "3"]:
        """The target's up."""
        return estimate_up(self.scenes.cameras(self.files.target_cameras))

    def move(self, index: int, move: Similarity) -> None:
        """Another place for one object.

        Raises: ValueError as `change`.
        """
        item = replace(self.objects()[index], target_from_object=move)
        self.change(self.placed_state().with_object(index, item))

    # long work

    def run(self, to: str, title: str) -> None:
        """Start the steps up to `to` in a child process.

        Raises: ValueError where a job is at work.
        """
        command, shown = self.project.run_command(to, title)
        self.jobs.start(command, title=title, shown=shown)

    def job(self) -> JobState | None:
        """The job at work, or the last one."""
        return self.jobs.state()

    def reasons(self) -> Mapping[str, str | None]:
        """Why each step is stale; empty where a file that must be read to know is broken."""
        return self.project.reasons()


def _is(path: Path | None, other: Path) -> bool:
    return path is None or path.resolve() == other.resolve()
