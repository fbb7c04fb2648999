"""The editor's page: header, phases, undo buttons, job panel and preview panel, and what the phases share."""

import contextlib
import html
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import viser

from splatgraft.editor.jobs.exports import served_file
from splatgraft.editor.page.history_controls import HistoryControls
from splatgraft.editor.page.job_panel import JobPanel
from splatgraft.editor.page.keys import Keys
from splatgraft.editor.page.light_phase import LightPhase
from splatgraft.editor.page.open_phase import OpenPhase
from splatgraft.editor.page.opening import Opening, set_theme
from splatgraft.editor.page.place_phase import PlacePhase
from splatgraft.editor.page.preview_panel import PreviewPanel
from splatgraft.editor.page.run_phase import RunPhase
from splatgraft.editor.page.scene_loading import SceneLoading
from splatgraft.editor.page.scene_view import SceneView
from splatgraft.editor.page.select_phase import SelectPhase
from splatgraft.editor.page.server import GuardedServer
from splatgraft.editor.page.style import style_sheet
from splatgraft.editor.page.upload_forms import UploadForms
from splatgraft.editor.page.windows import Windows
from splatgraft.editor.session.project_access import Project
from splatgraft.editor.session.scene_sample import typical_distance
from splatgraft.editor.session.session import Session, backup_of

PHASES = ("Open", "Select", "Place", "Light", "Run")
_POLL_SECONDS = 0.4
_CURRENT_MARK = "\u25cf "
_TEXT_STYLE = "font-size:.85em;line-height:1.45;padding:2px 12px"


@runtime_checkable
class Phase(Protocol):
    """One phase of the editing workflow: its controls and its part of the 3D view."""

    def enter(self) -> None:
        """Show its part of the 3D view."""
        ...

    def leave(self) -> None:
        """Hide its part of the 3D view."""
        ...

    def refresh(self) -> None:
        """Update controls and 3D view to the current state."""
        ...


@dataclass(frozen=True)
class PageOptions:
    """Options of the command line."""

    budget: int
    """Maximum number of Gaussians per scene that is sent to a browser."""
    inside: Path | None
    """Folder to which typed paths are restricted; None: no restriction."""
    start_page: str | None = None
    """Address of the page that lists all projects; None: there is none."""


class Page:
    """The page; all windows show the same one."""

    def __init__(
        self, guarded: GuardedServer, project: Project, options: PageOptions, *, opening: Opening | None = None
    ) -> None:
        """Build the page for a project that exists or is about to be created; `opening` is what windows show by now."""
        self.guarded, self.project, self.options = guarded, project, options
        self.server = guarded.viser
        self.session: Session | None = None
        self.problem: str | None = None
        """Why project.toml could not be opened; None where it could, or where there is none."""
        self._seen_project: tuple[int, int] | None = None
        if opening is None:
            set_theme(self.server)
        self._try_session()
        self.view = SceneView(self.server, budget=options.budget, coarse=None if opening is None else opening.scene)
        self.loading = SceneLoading(self.scenes_read)
        self.phase = "Open"
        self._lock = threading.RLock()
        self._open = True
        self.on_close: list[Callable[[], None]] = []
        self.windows = Windows(self)
        self.uploads = UploadForms(self)
        self._build()
        self.windows.connect(frozenset() if opening is None else opening.close())
        guarded.files = lambda name: None if self.session is None else served_file(self.session.files, name)
        self.show_phase(self._first_phase())
        self.say_notice()
        self.uploads.open()
        threading.Thread(target=self._poll_loop, daemon=True).start()

    # for the phases

    @property
    def gui(self) -> viser.GuiApi:
        """viser's interface for adding controls."""
        return self.server.gui

    def require_session(self) -> Session:
        """The open project.

        Raises:
            ValueError: If there is none.
        """
        if self.session is None:
            raise ValueError("project: expected one, found none; name two captures and start")
        return self.session

    def callback(self, work: Callable[[Any], None]) -> Callable[[Any], None]:
        """Wrap an event handler: errors are shown in the status line, and the page is refreshed afterwards.

        Events that the program itself causes, by setting a control, are ignored.
        """

        def call(event: Any) -> None:
            if getattr(event, "client_id", 0) is None:
                return
            with self._lock:
                with self.reported():
                    work(event)
                self.refresh()

        return call

    @contextlib.contextmanager
    def reported(self) -> Iterator[None]:
        """Show an error of the block in the status line instead of raising it."""
        try:
            yield
        except (ValueError, OSError) as error:
            self.say(" ".join(str(error).split()), bad=True)
        except Exception as error:  # a programming error must be visible and must not end the page
            traceback.print_exc()
            self.say(f"{type(error).__name__}: {error} (traceback in the terminal)", bad=True)

    def say(self, sentence: str, *, bad: bool = False) -> None:
        """Show one sentence in the status line."""
        color = "#e8590c" if bad else "inherit"
        self._status.content = (
            f'<div class="sg-status" style="{_TEXT_STYLE};color:{color}">{html.escape(sentence)}</div>'
        )

    def say_notice(self) -> None:
        """Show what was found on opening, in the status line; nothing where all is well."""
        if self.session is not None and self.session.notice is not None:
            self.say(self.session.notice, bad=True)
        elif self.problem is not None:
            self.say(self.problem, bad=True)

    def refresh(self) -> None:
        """Update the current phase, the preview, the header and the undo buttons."""
        with self._lock:
            with self.reported():
                self._phases[self.phase].refresh()
                self.preview.update()
            self._header.content = self._header_html()
            self._history.refresh()

    def open_project(self) -> None:
        """Open the project that was just created or corrected."""
        self._try_session()
        self.preview.reset()
        self.show_phase(self._first_phase())
        self.say_notice()

    def show_phase(self, phase: str) -> None:
        """Switch to another phase."""
        with self._lock:
            scene = self._shown_scene()
            self.windows.save_view(scene)
            self._phases[self.phase].leave()
            self._folders[self.phase].visible = False
            self.phase = phase
            self._folders[phase].visible = True
            self._phase_buttons.options = tuple(f"{_CURRENT_MARK}{name}" if name == phase else name for name in PHASES)
            if self._shown_scene() != scene:
                self.preview.scene_changed()
                self.windows.restore_view(self._shown_scene())
            self._status.content = ""
            with self.reported():
                self.view.keep_coarse(self._shown_file())
                self._phases[phase].enter()
            self.refresh()

    def run(self, to: str, title: str) -> None:
        """Start a job that runs the stale steps up to `to`.

        Raises:
            ValueError: If a job is running.
        """
        self.require_session().run(to, title)
        self.say(f"{title}: started; it continues if you close this page")
        self.job.refresh()

    def parse_path(self, text: str) -> Path:
        """The path in a text field.

        Raises:
            ValueError: If it is empty or outside of the permitted folder.
        """
        if not text.strip():
            raise ValueError("path: expected one, found nothing")
        path = Path(text.strip()).expanduser()
        path = path if path.is_absolute() else Path.cwd() / path
        if self.options.inside is not None and not path.resolve().is_relative_to(self.options.inside.resolve()):
            raise ValueError(f"{path}: expected a path in the project's folder, found one outside; upload the file")
        return path

    def redraw(self) -> None:
        """Show the phase again after files have changed."""
        self._phases[self.phase].enter()
        self.refresh()

    def scenes_read(self) -> None:
        """Show scenes that have been read in the background."""
        with self._lock, self.reported():
            if self._open and self.session is not None:
                self.redraw()

    def light_ready(self) -> None:
        """Update the light phase after the preview has estimated the light."""
        with self._lock:
            if self.phase == "Light":
                self._phases["Light"].refresh()

    def scene_scale(self) -> float:
        """Typical distance between cameras and content: the median distance of the cameras from their mean."""
        session = self.session
        files = None if session is None else session.files
        path = None if files is None else (files.source_cameras if self.phase == "Select" else files.target_cameras)
        if session is None or path is None or not path.is_file():
            return 1.0
        return typical_distance(session.scenes.cameras(path).centers.numpy())

    def close(self) -> None:
        """End all threads."""
        self._open = False
        for end in (self.preview.close, *self.on_close):
            end()

    def restore_project(self) -> None:
        """Put the last project.toml that opened back, and open it.

        Raises:
            ValueError: If none was kept.
        """
        backup_of(self.project.file).restore()
        self.open_project()
        if self.session is not None:
            self.say("the last project.toml that opened is back; the other one is in .editor/broken")

    def leave_project(self) -> None:
        """Set the project's edits aside, so that other captures can be named; `return_to_project` puts them back.

        Raises:
            ValueError: If a job is running.
        """
        self.require_session().set_aside()
        self._phases[self.phase].leave()
        self.open_project()

    def return_to_project(self) -> None:
        """Open the project that was set aside.

        Raises:
            ValueError: If there is none.
        """
        backup_of(self.project.file).bring_back()
        self.open_project()

    def _try_session(self) -> None:
        """Open the project where there is one; what prevents it is kept as `problem`."""
        self.session, self.problem = None, None
        self._seen_project = _stamp(self.project.file)
        try:
            if self.project.files() is not None:
                self.session = Session(self.project)
        except (ValueError, OSError) as error:
            self.problem = " ".join(str(error).split())

    # construction

    def _build(self) -> None:
        gui = self.gui
        self._header = gui.add_html("")
        self._phase_buttons = gui.add_button_group("Step", PHASES)
        self._phase_buttons.on_click(
            self.callback(lambda event: self.show_phase(event.target.value.removeprefix(_CURRENT_MARK)))
        )
        gui.add_html(style_sheet(self._phase_buttons._impl.uuid))
        self.job = JobPanel(self)
        self._folders: dict[str, Any] = {}
        self._phases: dict[str, Phase] = {}
        kinds: dict[str, Callable[[Page], Phase]] = {
            "Open": OpenPhase,
            "Select": SelectPhase,
            "Place": PlacePhase,
            "Light": LightPhase,
            "Run": RunPhase,
        }
        for name in PHASES:
            self._folders[name] = gui.add_folder(name, visible=False)
            with self._folders[name]:
                self._phases[name] = kinds[name](self)
        self._status = gui.add_html("")
        self.uploads.add_progress()
        self._history = HistoryControls(self)
        self._keys = Keys(self, PHASES)
        self.preview = PreviewPanel(self)

    def _first_phase(self) -> str:
        if self.session is None:
            return "Open"
        files = self.session.files
        if not files.source_scene.is_file() or not files.target_scene.is_file():
            return "Open"
        return "Place" if self.session.can_place() else "Select"

    def _shown_scene(self) -> str:
        return "source" if self.phase == "Select" else "target"

    def _shown_file(self) -> Path | None:
        if self.session is None:
            return None
        return self.session.files.source_scene if self.phase == "Select" else self.session.files.target_scene

    def _header_html(self) -> str:
        where = "no project yet" if self.session is None else str(self.session.files.file.parent.name)
        saved = "all changes are saved" if self.session else ""
        home = self.options.start_page
        link = f'<a style="color:#ffa94d" href="{home}">All projects</a><br>' if home else ""
        return (
            f'<div class="sg-header" style="{_TEXT_STYLE}">{link}<b style="font-size:1.1em">{html.escape(where)}</b>'
            f'<span style="opacity:.6;float:right">{saved}</span></div>'
        )

    # polling of files and jobs

    def _poll_loop(self) -> None:
        while self._open:
            time.sleep(_POLL_SECONDS)
            with self._lock, self.reported():
                self._poll()

    def _poll(self) -> None:
        session = self.session
        if session is None:
            if self.problem is not None and _stamp(self.project.file) != self._seen_project:
                self.open_project()
            return
        if session.reload():
            self.say("the project's files were changed outside the editor and were loaded again")
            self.refresh()
        self.job.refresh()


def _stamp(file: Path) -> tuple[int, int] | None:
    """Time and size of a file; None where there is none."""
    return (file.stat().st_mtime_ns, file.stat().st_size) if file.is_file() else None
