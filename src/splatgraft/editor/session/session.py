"""An open project: its edits with undo history, saved after every change, and its scenes, previews and job."""

import contextlib
import threading
from collections.abc import Callable, Mapping
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
from splatgraft.editor.session.edit_state import EditState
from splatgraft.editor.session.history import History
from splatgraft.editor.session.placement_operations import PlaceableObject
from splatgraft.editor.session.project_access import Commands, ExportPage, Project, ProjectFiles, RenderedViews
from splatgraft.editor.session.project_backup import ProjectBackup
from splatgraft.editor.session.scene_cache import SceneCache
from splatgraft.editor.session.state_checks import check_state
from splatgraft.editor.session.state_files import as_written, find_state, state_files, write_state
from splatgraft.editor.session.state_store import StateStore
from splatgraft.exports.export import Layer
from splatgraft.formats.placement import ObjectPlacement, read_placement
from splatgraft.project.layout import EDITOR_FOLDER, Side
from splatgraft.segmentation import Box, add_correction, apply_corrections

_PROBLEM_STEP = "project"
"""Entry of `Project.reasons` where project.toml is invalid."""
_PROJECT = "project.toml"
"""Name of a problem of the whole project file, beside those of single fields of the state."""


class Session:
    """An open project."""

    def __init__(self, project: Project) -> None:
        """Open the project with the edits and the undo history of the last session.

        Raises:
            ValueError: If project.toml is missing or invalid. Other files may be: `notice` names them then.
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
        self._backup = backup_of(files.file)
        self._backup.keep()
        found = find_state(files.file)
        self._state, self._problems = found.state, dict(found.problems)
        self._opening_is_step = False
        self.history: History[str] = self._read_history()
        if self._problems:
            self.notice = self._problems_text()
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
            ValueError: If a value is out of its range, the files were changed outside the editor, which loads that
                change, or cannot be written.
        """
        check_state(state)
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
        check_state(state)
        with self._lock:
            state = as_written(state, self._state)
            self._apply(self.history.amended(self._store.save(state)), state)

    def has_steps(self) -> bool:
        """Whether there is anything to undo or to redo."""
        return bool(self.history.past or self.history.future or self._problems)

    def undo(self) -> bool:
        """Go back by one step; False where there is none. A file that could not be read is a step: it is written anew.

        Raises:
            ValueError: As `change`.
        """
        with self._lock:
            self._note_outside_problems()
            if self._problems and not self._opening_is_step:
                self._restore_files()
                return True
            return self._step(History.undone)

    def redo(self) -> bool:
        """Go forward by one step; False where there is none.

        Raises:
            ValueError: As `change`.
        """
        with self._lock:
            return self._step(History.redone)

    def set_aside(self) -> None:
        """Move project.toml, all edits and their history aside; results stay. The session must not be used again.

        Raises:
            ValueError: If a job is running.
        """
        job = self.job()
        if job is not None and job.live:
            raise ValueError(f"{job.title}: expected no job at work, found this one; wait or cancel it")
        self._backup.move_aside((*state_files(self.files.file), *self._store.paths()))

    def _step(self, move: Callable[[History[str]], History[str]]) -> bool:
        """Move in the history to the next state that can be read."""
        history = self.history
        while (moved := move(history)) is not history:
            history = moved
            try:
                state = self._store.read(history.present)
            except ValueError as error:
                self.notice = f"{error}; that step is left out"
                continue
            self._apply(history, state)
            return True
        return False

    def reload(self) -> bool:
        """Load changes made outside the editor as one undo step; whether there were any.

        Raises:
            ValueError: If a file is invalid; once for each change of the files.
        """
        with self._lock:
            stamps = self._read_stamps()
            if stamps == self._stamps:
                return False
            self._stamps, self._opening_is_step = stamps, False
            try:
                found = find_state(self.files.file)
                files = self.project.files()
            except ValueError as error:
                self._problems = {_PROJECT: str(error)}
                raise ValueError(self._problems_text()) from None
            self._problems = dict(found.problems)
            if self._problems:
                raise ValueError(self._problems_text())
            self._backup.keep()
            self._state = found.state
            name = self._store.save(found.state)
            if name != self.history.present:
                self._save_history(self.history.pushed(name))
            self._use_files(files)
            return True

    def _apply(self, history: History[str], state: EditState) -> None:
        if history.present == self.history.present and not self._problems:
            self._save_history(history)
            return
        if self.reload():
            raise ValueError(
                f"{self.files.file.name}: changed outside the editor; the change was loaded, please repeat your edit"
            )
        if _PROJECT in self._problems:
            raise ValueError(self._problems_text())
        if self._problems:
            self._backup.set_aside(state_files(self.files.file))
        write_state(self.files.file, None if self._problems else self._state, state)
        self._state, self._problems, self._stamps = state, {}, self._read_stamps()
        self._backup.keep()
        self._save_history(history)

    # files that could not be read

    def _note_outside_problems(self) -> None:
        """Look for files that were made unreadable since the last look; changes that can be read are loaded."""
        with contextlib.suppress(ValueError):
            self.reload()

    def _restore_files(self) -> None:
        """Write the present state over files that could not be read, of which copies are kept."""
        folder = self._backup.set_aside(state_files(self.files.file))
        if _PROJECT in self._problems:
            self._backup.restore()
        write_state(self.files.file, None, self._state)
        self.notice = (
            f"written again as before: {', '.join(sorted(self._problems))}; the unreadable files are in {folder}"
        )
        self._problems, self._stamps = {}, self._read_stamps()
        self._use_files(self.project.files())

    def _problems_text(self) -> str:
        found = "; ".join(dict.fromkeys(self._problems.values()))
        return f"{found}. All else is open; Undo puts back what was there before"

    def _read_history(self) -> History[str]:
        """The saved history, with one more step where the files were changed while no editor was open."""
        try:
            saved = self._store.read_history()
        except ValueError as error:
            self.notice, saved = f"{error}; the undo history is empty now", None
        now = self._store.save(self._state)
        self._opening_is_step = saved is not None and saved.present != now
        history = History(now) if saved is None else saved.pushed(now) if self._opening_is_step else saved
        self._store.save_history(history)
        return history

    def _save_history(self, history: History[str]) -> None:
        self.history = history
        self._store.save_history(history)

    def _use_files(self, files: ProjectFiles | None) -> None:
        if files is not None and files != self.files:
            self.files, self.scenes.files = files, files

    def _read_stamps(self) -> dict[Path, tuple[int, int]]:
        paths = [path for path in state_files(self.files.file) if path.is_file()]
        return {path: (path.stat().st_mtime_ns, path.stat().st_size) for path in paths}

    def set_view(self, side: Side, views: RenderedViews) -> None:
        """Set how images of a scene without photographs are rendered; not an undo step.

        Raises:
            ValueError: As `change`.
        """
        with self._lock:
            if self.reload():
                raise ValueError(f"{self.files.file.name}: changed outside the editor; please repeat your edit")
            self.project.set_view(side, views)
            self._stamps = self._read_stamps()
            self._backup.keep()
            self._use_files(self.project.files())

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

    def placed_scenes(self) -> tuple[Path, ...]:
        """The files of the target and of the placed objects."""
        return (self.files.target_scene, *(self.scenes.object_path(item) for item in self.objects()))

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
        self._start(self.project.run_command(to, title), title)

    def export(self, to: Path, *, page: ExportPage, layer: Layer, title: str) -> JobState | None:
        """Start a child process that writes the result as a file whose suffix names the format; gives its job.

        Raises:
            ValueError: If a job is running.
        """
        to.parent.mkdir(parents=True, exist_ok=True)
        self._start(self.project.export_command(to, page=page, layer=layer, title=title), title)
        return self.job()

    def _start(self, commands: Commands, title: str) -> None:
        command, shown = commands
        self.jobs.start(command, title=title, shown=shown[1:])

    def job(self) -> JobState | None:
        """The running job, else the last one; None where there was none."""
        return self.jobs.state()

    def reasons(self) -> Mapping[str, str | None]:
        """For each step why it is stale; None where it is up to date."""
        return self.project.reasons()

    def why_stale(self, step: str) -> str | None:
        """Why the result of a step is out of date, with the first step that is; None where it is up to date."""
        found = self.reasons()
        if step not in found:
            return found.get(_PROBLEM_STEP)
        name, reason = step, found[step]
        while reason is not None and (before := reason.removeprefix("waits for ")) in found and before != reason:
            name, reason = before, found[before]
        return None if reason is None else f"{name}: {reason}"


def backup_of(project: Path) -> ProjectBackup:
    """The copies that the editor keeps of a project.toml."""
    return ProjectBackup(project, project.parent / EDITOR_FOLDER)


def _same_file(path: Path | None, other: Path) -> bool:
    return path is None or path.resolve() == other.resolve()
