"""The page as a whole: header, phases, undo, job, preview beside the splats; what the phases share.

Knows nothing about how anything is computed or saved.
"""

import html
import math
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import viser

from splatgraft.core.cameras import Cameras
from splatgraft.editor.page.job_panel import JobPanel
from splatgraft.editor.page.light_phase import LightPhase
from splatgraft.editor.page.open_phase import OpenPhase
from splatgraft.editor.page.place_phase import PlacePhase
from splatgraft.editor.page.preview_panel import PreviewPanel
from splatgraft.editor.page.run_phase import RunPhase
from splatgraft.editor.page.scene_view import SceneView
from splatgraft.editor.page.select_phase import SelectPhase
from splatgraft.editor.page.server import GuardedServer
from splatgraft.editor.session.project_access import Project
from splatgraft.editor.session.session import Session

PHASES = ("Open", "Select", "Place", "Light", "Run")
_TICK = 0.4
_HERE = "\u25cf "
_HISTORY = ("Undo", "Redo")


@runtime_checkable
class Phase(Protocol):
    """One stage of a person's work: its controls, and what it shows in 3D."""

    def enter(self) -> None:
        """Show its part of the scene."""
        ...

    def leave(self) -> None:
        """Take it away again."""
        ...

    def refresh(self) -> None:
        """Show what counts now."""
        ...


@dataclass(frozen=True)
class PageOptions:
    """What the command line decides."""

    budget: int
    """Most Gaussians that a browser is given per scene."""
    inside: Path | None
    """Folder outside which no path may be named; None: any, for the person at the machine itself."""


class Page:
    """What all windows show; one of them edits."""

    def __init__(self, guarded: GuardedServer, project: Project, options: PageOptions) -> None:
        """Build the page for a project that is there or about to be."""
        self.guarded, self.project, self.options = guarded, project, options
        self.server = guarded.viser
        self.session: Session | None = None if project.files() is None else Session(project)
        self.view = SceneView(self.server, budget=options.budget)
        self.phase = "Open"
        self._lock = threading.RLock()
        self._notices: dict[int, Any] = {}
        self._open = True
        self.at_end: list[Callable[[], None]] = []
        self._views: dict[str, tuple[Any, ...]] = {}
        self._build()
        guarded.on_seat = self._seats_changed
        guarded.on_large_upload = lambda name, size: self.say(
            f"{name}: expected a smaller file, found {size >> 20} MiB; give its path instead", bad=True
        )
        guarded.files = self._report_file
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(lambda client: self._notices.pop(client.client_id, None))
        self.go(self._first_phase())
        self._say_notice()
        threading.Thread(target=self._ticks, daemon=True).start()

    # for the phases

    @property
    def gui(self) -> viser.GuiApi:
        """Where controls are added."""
        return self.server.gui

    def need(self) -> Session:
        """The open project.

        Raises: ValueError where there is none.
        """
        if self.session is None:
            raise ValueError("project: expected one, found none; name two captures and start")
        return self.session

    def window(self) -> viser.ClientHandle | None:
        """The window that edits."""
        holder = self.guarded.seat.holder
        return None if holder is None else self.server.get_clients().get(holder)

    def act(self, work: Callable[[Any], None]) -> Callable[[Any], None]:
        """A callback: errors become a sentence, and the page shows what counts afterwards. What we set is no click."""

        def call(event: Any) -> None:
            if getattr(event, "client_id", 0) is None:
                return
            with self._lock:
                try:
                    work(event)
                except (ValueError, OSError) as error:
                    self.say(" ".join(str(error).split()), bad=True)
                except Exception as error:  # a fault of ours must be seen, and must not end the page
                    traceback.print_exc()
                    self.say(f"{type(error).__name__}: {error} (the terminal says more)", bad=True)
                self.refresh()

        return call

    def say(self, sentence: str, *, bad: bool = False) -> None:
        """One sentence at the foot of the panel."""
        color = "#e8590c" if bad else "inherit"
        self._status.content = f'<div class="sg-status" style="{_TEXT};color:{color}">{html.escape(sentence)}</div>'

    def refresh(self) -> None:
        """Show what counts now, everywhere."""
        with self._lock:
            try:
                self._phases[self.phase].refresh()
                self.preview.ask()
            except (ValueError, OSError) as error:
                self.say(" ".join(str(error).split()), bad=True)
            self._header.content = self._header_html()
            history = None if self.session is None else self.session.history
            self._back.visible = history is not None and bool(history.past or history.future)

    def open_project(self) -> None:
        """Take up the project that is there now."""
        self.session = Session(self.project)
        self.preview.reset()
        self.go(self._first_phase())
        self._say_notice()

    def go(self, phase: str) -> None:
        """Turn to another phase."""
        with self._lock:
            self._remember_view()
            world = self._world()
            self._phases[self.phase].leave()
            self._folders[self.phase].visible = False
            self.phase = phase
            self._folders[phase].visible = True
            self._turn.options = tuple(f"{_HERE}{name}" if name == phase else name for name in PHASES)
            if self._world() != world:
                self._change_world()
            self._status.content = ""
            try:
                self._phases[phase].enter()
            except (ValueError, OSError) as error:
                self.say(" ".join(str(error).split()), bad=True)
            self.refresh()

    def run(self, to: str, title: str) -> None:
        """Start long work.

        Raises: ValueError where some is at work.
        """
        self.need().run(to, title)
        self.say(f"{title}: started; you may close this page, it goes on")
        self.job.refresh()

    def allowed(self, text: str) -> Path:
        """The path that a person typed.

        Raises: ValueError where it is empty, or outside of what may be named.
        """
        if not text.strip():
            raise ValueError("path: expected one, found nothing")
        path = Path(text.strip()).expanduser()
        path = path if path.is_absolute() else Path.cwd() / path
        if self.options.inside is not None and not path.resolve().is_relative_to(self.options.inside.resolve()):
            raise ValueError(f"{path}: expected a path in the project's folder, found one outside; upload the file")
        return path

    def look_through(self, camera: Cameras) -> None:
        """Bring the editing window to a camera."""
        window = self.window()
        if window is None:
            return
        pose = camera.world_from_camera[0].double().numpy()
        # all of the photograph is in view, however narrow the window
        aspect = camera.width / camera.height
        half = camera.height / (2 * float(camera.intrinsics[0, 1, 1]))
        if window.camera.aspect > 0:
            half *= max(1.0, aspect / window.camera.aspect)
        with window.atomic():
            window.camera.up_direction = -pose[:3, 1]
            window.camera.position = pose[:3, 3]
            window.camera.look_at = pose[:3, 3] + pose[:3, 2] * self.reach()
            window.camera.fov = 2 * math.atan(half)

    def redraw(self) -> None:
        """Files have changed: show the phase anew."""
        self._phases[self.phase].enter()
        self.refresh()

    def light_found(self) -> None:
        """The preview has the light of what is placed now."""
        with self._lock:
            if self.phase == "Light":
                self._phases["Light"].refresh()

    def reach(self) -> float:
        """How far things are from the cameras, roughly: half the median distance of the cameras from their middle."""
        session = self.session
        files = None if session is None else session.files
        path = None if files is None else (files.source_cameras if self.phase == "Select" else files.target_cameras)
        if session is None or path is None or not path.is_file():
            return 1.0
        centers = session.scenes.cameras(path).centers
        return max(1e-6, float((centers - centers.mean(0)).norm(dim=1).median()))

    # the parts

    def _build(self) -> None:
        gui = self.gui
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, brand_color=(224, 122, 46))
        gui.set_panel_label("splatgraft")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(384)
        self.server.scene.world_axes.visible = False
        self._header = gui.add_html("")
        self._turn = gui.add_button_group("Step", PHASES)
        self._turn.on_click(self.act(lambda event: self.go(event.target.value.removeprefix(_HERE))))
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
        self._back = gui.add_button_group("History", _HISTORY)
        self._back.on_click(
            self.act(lambda e: self._step_back() if e.target.value == _HISTORY[0] else self._step_forward())
        )
        undo = gui.add_command("Undo", hotkey="Z", modifier="cmd/ctrl")
        redo = gui.add_command("Redo", hotkey="Z", modifier="cmd/ctrl+shift")
        undo.on_trigger(self.act(lambda _: self._step_back()))
        redo.on_trigger(self.act(lambda _: self._step_forward()))
        self.preview = PreviewPanel(self)

    def _step_back(self) -> None:
        self.say("undone" if self.need().undo() else "nothing to undo")

    def _step_forward(self) -> None:
        self.say("done again" if self.need().redo() else "nothing to do again")

    def _first_phase(self) -> str:
        if self.session is None:
            return "Open"
        files = self.session.files
        if not files.source_scene.is_file() or not files.target_scene.is_file():
            return "Open"
        return "Place" if self.session.can_place() else "Select"

    def _say_notice(self) -> None:
        if self.session is not None and self.session.notice is not None:
            self.say(self.session.notice, bad=True)

    def _header_html(self) -> str:
        where = "no project yet" if self.session is None else str(self.session.files.file.parent.name)
        saved = "all changes are saved" if self.session else ""
        return (
            f'<div class="sg-header" style="{_TEXT}"><b style="font-size:1.1em">{html.escape(where)}</b>'
            f'<span style="opacity:.6;float:right">{saved}</span></div>'
        )

    # windows

    def _world(self) -> str:
        return "source" if self.phase == "Select" else "target"

    def _remember_view(self) -> None:
        window = self.window()
        if window is not None:
            camera = window.camera
            self._views[self._world()] = (camera.position, camera.look_at, camera.up_direction, camera.fov)

    def _change_world(self) -> None:
        """Source and target have nothing in common: each keeps the view it was left with."""
        window, kept = self.window(), self._views.get(self._world())
        self.preview.world_changed()
        if window is None:
            return
        if kept is None:
            self._frame(window)
            return
        with window.atomic():
            window.camera.up_direction = kept[2]
            window.camera.position, window.camera.look_at, window.camera.fov = kept[0], kept[1], kept[3]

    def _connected(self, client: viser.ClientHandle) -> None:
        client.camera.on_update(lambda _: self.preview.camera_moved(client.client_id))
        self._frame(client)
        self._seats_changed()

    def _frame(self, client: viser.ClientHandle) -> None:
        """Begin where a photograph was taken: what is in view there was reconstructed."""
        camera = self.preview.first_camera()
        if camera is not None and client.client_id == self.guarded.seat.holder:
            self.look_through(camera)

    def _seats_changed(self) -> None:
        for number, client in self.server.get_clients().items():
            holds = number == self.guarded.seat.holder
            notice = self._notices.get(number)
            if holds and notice is not None:
                notice.close()
                self._notices.pop(number, None)
            elif not holds and notice is None:
                self._notices[number] = self._show_notice(client)

    def _show_notice(self, client: viser.ClientHandle) -> Any:
        modal = client.gui.add_modal("Open in another window")
        with modal:
            client.gui.add_markdown("This project is being edited in another window. Here you can only look on.")
            take = client.gui.add_button("Edit here instead")
            take.on_click(lambda _: self.guarded.take_seat(client.client_id))
        return modal

    def _report_file(self, name: str) -> Path | None:
        """Files of the report alone are served."""
        if self.session is None:
            return None
        report = self.session.files.report.resolve()
        path = (report / name).resolve()
        return path if path.is_relative_to(report) and path.is_file() and not path.name.startswith(".") else None

    # time

    def close(self) -> None:
        """End the threads."""
        self._open = False
        for end in (self.preview.close, *self.at_end):
            end()

    def _ticks(self) -> None:
        while self._open:
            time.sleep(_TICK)
            with self._lock:
                try:
                    self._tick()
                except (ValueError, OSError) as error:
                    self.say(" ".join(str(error).split()), bad=True)

    def _tick(self) -> None:
        session = self.session
        if session is None:
            return
        if session.reload():
            self.say("the project's files were changed outside the editor; that counts now")
            self.refresh()
        self.job.refresh()


_TEXT = "font-size:.85em;line-height:1.45;padding:2px 12px"
