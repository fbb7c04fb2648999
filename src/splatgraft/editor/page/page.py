"""The editor's page: header, phases, undo buttons, job panel and preview panel, laid out in one panel."""

import html
import threading
import time
from collections.abc import Callable
from typing import Any

import viser

from splatgraft.core.bounds import bounding_sphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import concatenate
from splatgraft.editor.jobs import JobState
from splatgraft.editor.page.context import HISTORY_ORDER, PageContext, Phase, note
from splatgraft.editor.page.job_panel import JobPanel
from splatgraft.editor.page.light_phase import LightPhase
from splatgraft.editor.page.open_phase import OpenPhase
from splatgraft.editor.page.opening import Opening, set_theme
from splatgraft.editor.page.place_phase import PlacePhase
from splatgraft.editor.page.preview_panel import PreviewPanel
from splatgraft.editor.page.run_phase import RunPhase
from splatgraft.editor.page.select_phase import SelectPhase
from splatgraft.editor.page.server import GuardedServer
from splatgraft.editor.page.share_phase import SharePhase
from splatgraft.editor.project import Project
from splatgraft.editor.session import Session
from splatgraft.editor.sharing import served_file, written_exports
from splatgraft.editor.worker import LatestOnlyWorker

_POLL_SECONDS = 0.4
_MARK_SECONDS = 1.0
"""How long nothing must change before the phases are marked anew."""
PHASES = ("Open", "Select", "Place", "Light", "Run", "Share")
_CURRENT, _DONE, _STALE, _NEXT = "\u25cf ", "\u2713 ", "\u21bb ", "\u203a "
"""What stands before the name of a phase: the shown one, and others that are done, out of date, or to be done next."""
_CSS = """<style>
div:has(> * > label[for="{steps}"]) {{ display: none; }}
div:has(> * > * > label[for="{steps}"]) button {{ padding: 0 2px; }}
div:has(> * > * > label[for="{steps}"]) div:has(> button) {{ gap: .2em !important; }}
</style>"""
"""The label of the steps is hidden, so that six buttons fit in one row."""
_WATCH_NOTE = (
    "<b>Read-only:</b> another window edits this project; close it to edit here. The controls below have no effect."
)


class Page:
    """The page; all windows show the same one."""

    def __init__(
        self, guarded: GuardedServer, project: Project, *, budget: int, opening: Opening | None = None
    ) -> None:
        """Build the page for a project that exists or is about to be created, after what the windows show by now."""
        if opening is None:
            set_theme(guarded.viser)
        shown = None if opening is None else opening.scene
        self.context = context = PageContext(guarded, project, budget=budget, shown=shown)
        context.refresh, context.reopened = self.refresh, self._reopened
        gui = context.gui
        self._header = gui.add_html("")
        self._marks: dict[str, str] = {}
        self._marker = LatestOnlyWorker(self._find_marks, context.say_error)
        context.on_close.append(self._marker.close)
        self._notices: dict[int, viser.GuiHtmlHandle] = {}
        # windows open and close in several threads; the context's lock may be held by one that waits for a window
        self._notices_lock = threading.Lock()
        self._views: dict[str, tuple[Any, ...]] = {}
        self._phase_buttons = gui.add_button_group("Step", PHASES)
        gui.add_html(_CSS.format(steps=self._phase_buttons._impl.uuid))
        job = self._job = JobPanel(context)
        preview = self.preview = PreviewPanel(context)
        preview.light_ready = self._light_ready
        makers: dict[str, Callable[[], Phase]] = {
            "Open": lambda: OpenPhase(context),
            "Select": lambda: SelectPhase(context, preview),
            "Place": lambda: PlacePhase(context, preview),
            "Light": lambda: LightPhase(context, preview),
            "Run": lambda: RunPhase(context, preview),
            "Share": lambda: SharePhase(context, preview, job),
        }
        self._folders = {name: gui.add_folder(name, visible=False) for name in makers}
        self.phases: dict[str, Phase] = {}
        for number, (name, make) in enumerate(makers.items(), start=1):
            with self._folders[name]:
                self.phases[name] = make()
            # viser's page takes any key of the browser; its types name letters, digits and a few others
            key: Any = str(number)
            context.on(gui.add_command(f"Step {name}", hotkey=key), lambda name=name: self.show_phase(name))
        self._history = gui.add_button_group("History", ("Undo", "Redo"), order=HISTORY_ORDER)
        undo = gui.add_command("Undo", hotkey="Z", modifier="cmd/ctrl")
        redo = gui.add_command("Redo", hotkey="Z", modifier="cmd/ctrl+shift")
        job.on_end = self._job_ended
        preview.on_shown = self._shown
        context.on(self._phase_buttons, lambda: self.show_phase(self._phase_buttons.value.rpartition(" ")[2]))
        context.on(self._history, lambda: self._undo() if self._history.value == "Undo" else self._redo())
        context.on(gui.add_command("Look at the object", hotkey="F"), self._frame_object)
        context.on(gui.add_command("Back to the first view", hotkey="home"), self._first_view)
        for key, right, away in (("left", -1, 0), ("right", 1, 0), ("up", 0, 1), ("down", 0, -1)):
            arrow: Any = f"arrow{key}"
            command = gui.add_command(f"Move {key}", hotkey=arrow)
            context.on(command, lambda right=right, away=away: self._arrow(right, away))
        context.on(undo, self._undo)
        context.on(redo, self._redo)
        if opening is not None:
            opening.close()
        # windows that have their first view already
        self._placed = frozenset() if opening is None else frozenset(opening.placed)
        guarded.on_windows_changed = self._windows_changed
        context.server.on_client_connect(self._connected)
        guarded.files = lambda name: None if context.session is None else served_file(context.session.files, name)
        self.phases["Open"].enter()
        self._reopened()
        threading.Thread(target=self._poll_loop, daemon=True).start()

    def refresh(self) -> None:
        """Update the current phase, the preview, the header and the undo buttons."""
        context = self.context
        with context.lock:
            with context.reported():
                self.phases[context.phase].refresh()
                self.preview.update()
            session = context.session
            where = "no project yet" if session is None else session.files.file.parent.name
            saved = "" if session is None else '<span class="sg-saved" style="opacity:.6;float:right">saved</span>'
            self._header.content = note(f'<b style="font-size:1.1em">{html.escape(where)}</b>{saved}', kind="header")
            self._history.visible = session is not None and bool(session.history.past or session.history.future)
            self._show_marks()
            self._marker.submit(session)

    def show_phase(self, phase: str) -> None:
        """Switch to another phase."""
        context = self.context
        with context.lock:
            scene = context.scene_side
            self._save_view(scene)
            self.phases[context.phase].leave()
            self._folders[context.phase].visible = False
            context.phase = phase
            self._folders[phase].visible = True
            for name, folder in context.more_folders.items():
                # those of no phase belong to all
                folder.visible = name == phase or name not in self._folders
            if context.scene_side != scene:
                context.view.hide_splats(f"/{scene}")
                self.preview.scene_changed()
                self._restore_view(context.scene_side)
            context.status.content = ""
            with context.reported():
                context.view.keep_coarse(context.scene_file())
                self.phases[phase].enter()
            self.refresh()

    def close(self) -> None:
        """End all threads."""
        self.context.is_open = False
        for end in self.context.on_close:
            end()

    def _reopened(self) -> None:
        """Show a project that has been opened in the phase that comes next, or say what is wrong with it."""
        session, context = self.context.session, self.context
        self.preview.reset()
        context.view.hide_splats("/")
        files = None if session is None else session.files
        if files is None or not files.source_scene.is_file() or not files.target_scene.is_file():
            self.show_phase("Open")
        else:
            self.show_phase("Place" if files.object.is_file() else "Select")
        if context.problem is not None:
            context.say(context.problem, bad=True)

    def _light_ready(self) -> None:
        """Update the light phase after the preview has estimated the light."""
        with self.context.lock:
            if self.context.phase == "Light":
                self.phases["Light"].refresh()

    def _find_marks(self, session: Session | None) -> None:
        """Find which phases are done, out of date, or next, once nothing has changed for a moment: all photos of a
        project are looked at."""
        if not self._marker.wait_idle(_MARK_SECONDS):
            return
        marks = {} if session is None else _marks(session)
        with self.context.lock:
            if session is self.context.session:
                self._marks = marks
                self._show_marks()

    def _show_marks(self) -> None:
        """Mark the shown phase, and the others as was found last."""

        def mark(name: str) -> str:
            return _CURRENT if name == self.context.phase else self._marks.get(name, "")

        options = tuple(f"{mark(name)}{name}" for name in PHASES)
        if tuple(self._phase_buttons.options) != options:
            self._phase_buttons.options = options

    def _arrow(self, right: int, away: int) -> None:
        """Move the object in the phase Place; step through the photos elsewhere."""
        place = self.phases["Place"]
        if self.context.phase == "Place" and isinstance(place, PlacePhase):
            place.nudge(right, away)
        elif right:
            self.preview.step_camera(right)

    def _shown(self, camera: Cameras) -> None:
        """Update what depends on the view, after the preview has put a picture of it on the canvas."""
        self.phases[self.context.phase].view_shown(camera)

    def _job_ended(self, job: JobState) -> None:
        for phase in self.phases.values():
            phase.job_ended(job)

    # undo

    def _undo(self) -> None:
        self._step(Session.undo, "undone", "nothing to undo")

    def _redo(self) -> None:
        self._step(Session.redo, "redone", "nothing to redo")

    def _step(self, move: Callable[[Session], bool], done: str, nothing: str) -> None:
        self.context.say(done if move(self.context.require_session()) else nothing)

    # windows and their views

    def _connected(self, window: viser.ClientHandle) -> None:
        window.camera.on_update(lambda _: self._moved(window))
        camera = self.context.cameras()
        if window.client_id not in self._placed and camera is not None:
            # the reconstruction covers what the first photograph shows
            self.context.look_through(window, camera[0])
        self._windows_changed()

    def _moved(self, window: viser.ClientHandle) -> None:
        editing = self.context.guarded.editing()
        if editing is not None and window.client_id == editing.client_id:
            self.preview.camera_moved()

    def _windows_changed(self) -> None:
        """Say in each window but the oldest that it is read-only, and show the picture in the one that edits."""
        with self._notices_lock:
            watching = {window.client_id: window for window in self.context.guarded.watching()}
            for number in [number for number in self._notices if number not in watching]:
                notice = self._notices.pop(number)
                if number in self.context.server.get_clients():
                    notice.remove()
            for number, window in watching.items():
                if number not in self._notices:
                    self._notices[number] = window.gui.add_html(note(_WATCH_NOTE, kind="watch"), order=-1.0)
        if (editing := self.context.guarded.editing()) is not None:
            self.preview.introduce(editing)
        self.preview.update()

    def _save_view(self, scene: str) -> None:
        window = self.context.guarded.editing()
        if window is not None:
            camera = window.camera
            self._views[scene] = (camera.position, camera.look_at, camera.up_direction, camera.fov)

    def _restore_view(self, scene: str) -> None:
        """Restore the editing window's view of a scene; the first time, look through its first camera."""
        window, view, cameras = self.context.guarded.editing(), self._views.get(scene), self.context.cameras()
        if window is None:
            return
        if view is None and cameras is not None:
            self.context.look_through(window, cameras[0])
        elif view is not None:
            with window.atomic():
                window.camera.up_direction = view[2]
                window.camera.position, window.camera.look_at, window.camera.fov = view[0], view[1], view[3]

    def _frame_object(self) -> None:
        """Turn the editing window's view to the object, as large as it fits, from the direction that it has."""
        context, session = self.context, self.context.require_session()
        if context.phase == "Select":
            which = session.selection()
            scene = None if which is None else session.scenes.gaussians(session.files.source_scene).select(which)
        else:
            objects = session.objects()
            parts = [
                item.target_from_object.gaussians(session.placeable_object(i).gaussians)
                for i, item in enumerate(objects)
            ]
            scene = concatenate(parts) if parts else None
        if scene is None or not scene.count:
            raise ValueError("look at the object: expected one that is cut out or placed, found none")
        context.frame(context.guarded.editing(), bounding_sphere(scene))

    def _first_view(self) -> None:
        cameras = self.context.cameras()
        if cameras is not None:
            self.context.look_through(self.context.guarded.editing(), cameras[0])

    # polling of files and jobs

    def _poll_loop(self) -> None:
        while self.context.is_open:
            time.sleep(_POLL_SECONDS)
            with self.context.lock:
                self.poll()

    def poll(self) -> None:
        """Load what was changed outside the editor, and show how far the job is."""
        context = self.context
        with context.reported():
            if context.is_corrected():
                context.open_project()
            if context.session is not None and context.session.reload():
                context.say("the project's files were changed outside the editor and were loaded again")
                self.refresh()
        with context.reported():
            self._job.refresh()


def _marks(session: Session) -> dict[str, str]:
    """The marks of the phases that are done, out of date, or next."""
    files, reasons = session.files, session.project.reasons()

    def state(exists: bool, *steps: str) -> str | None:
        return None if not exists else _DONE if all(reasons.get(step) is None for step in steps) else _STALE

    have_both = files.source_scene.is_file() and files.target_scene.is_file()
    exports = written_exports(files)
    result = max((p.stat().st_mtime_ns for p in (files.result, files.relit) if p.is_file()), default=0)
    states = {
        "Open": state(have_both, "source/reconstruct", "target/reconstruct"),
        "Select": state(files.object.is_file(), "segment"),
        "Place": _DONE if session.objects() else None,
        "Light": _DONE if session.state.light is not None or files.relit.is_file() else None,
        "Run": state(files.result.is_file(), "consolidate"),
        "Share": None if not exports else _DONE if exports[0].stat().st_mtime_ns >= result else _STALE,
    }
    # a light is found without being set
    following = next((name for name, mark in states.items() if mark is None and name != "Light"), None)
    return {name: mark or _NEXT for name, mark in states.items() if mark is not None or name == following}
