"""The open project with its steps and windows, and the handling of the messages that `Server` receives."""

import contextlib
import filecmp
import json
import queue
import re
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from splatgraft.core.bounds import bounding_sphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.editor.form import Form
from splatgraft.editor.jobs import JobState, seconds_left, seconds_left_in_job
from splatgraft.editor.light_panel import LightPanel
from splatgraft.editor.light_process import LightProcess, Stage
from splatgraft.editor.open_panel import OpenPanel
from splatgraft.editor.orbit import FreeSpace, Orbit, through, typical_distance
from splatgraft.editor.panel import Panel, Pointer
from splatgraft.editor.pictures import Kind
from splatgraft.editor.place_panel import PlacePanel
from splatgraft.editor.project import Project
from splatgraft.editor.relit_preview import Draft
from splatgraft.editor.result_panels import RunPanel, SharePanel, served_file, written_exports
from splatgraft.editor.select_panel import SelectPanel
from splatgraft.editor.server import Server, Window
from splatgraft.editor.session import Session
from splatgraft.editor.state import EditState, Stamp, check_state, stamps_of
from splatgraft.editor.stream import Stream, View
from splatgraft.editor.worker import LatestOnlyWorker
from splatgraft.project.layout import Side
from splatgraft.relighting import Relit
from splatgraft.runtime.files import is_disk_full, os_error_line

KINDS: dict[str, Kind] = {
    "With its new light": "lit",
    "Pasted, unlit": "pasted",
    "Result": "result",
    "Place alone": "place",
}
"""Kinds of pictures of the target, by the label in the menu."""
_POLL_SECONDS = 0.4
_MARK_SECONDS = 1.0  # time without a change before the steps' marks are updated
_PAUSE_SECONDS = 0.2  # time without a move in a drag before the light of its place is requested
_IDLE_SECONDS = 0.5  # time at rest before drafts of the light are prepared
_DRAWN_SECONDS = 0.3  # longest wait of a drag's next move for the picture of the last one
_CURRENT, _DONE, _STALE, _NEXT = "●", "✓", "↻", "›"
_VIEW_KINDS = ("size", "ack", "turn", "pan", "zoom", "split")
"""Kinds of messages about a window's own view."""
_WORDS = {"do": "id", "live": "id", "key": "key", "step": "to"}
"""Kinds of messages about the panel, with the field that must be a string."""
_MAX_ACTIONS = 200  # waiting messages
_UPLOADS_FOLDER = "uploads"
_GREY = 48  # value of a picture that cannot be drawn, 0 to 255
_FULL_DISK = "Disk full: nothing can be saved."


class Editor:
    """A project, shown in all windows of a server."""

    def __init__(self, server: Server, project: Project) -> None:
        """Open the project if it exists, and serve it."""
        self.server, self.project = server, project
        self.lock = threading.RLock()
        self.session: Session | None = None
        self.problem: str | None = None
        """Reason why the project could not be opened; None if it is open or does not exist."""
        self.step = "Open"
        self.live: EditState | None = None
        """State shown during a drag, in place of the saved one."""
        self.kind: Kind = "lit"
        """Kind of the picture of the target."""
        self.before: Kind = "pasted"
        """Kind of the comparison picture."""
        self.status, self.is_bad = "", False
        self.offer: dict[str, Any] | None = None
        """File for the editing window to download."""
        self._light: LightProcess | None = None
        self._form = Form()
        self._seen: tuple[Stamp, ...] = ()
        self._marks: dict[str, str] = {}
        self._last_job = ""
        self._is_open = True
        self._actions: queue.Queue[tuple[Window, dict[str, Any]] | None] = queue.Queue(_MAX_ACTIONS)
        self._moves: dict[str, Any] | None = None
        """Newest waiting move of the pointer; it replaces earlier ones."""
        self.stream = Stream(self, self._drawing_failed)
        self._marker = LatestOnlyWorker(self._failed)
        self.background = LatestOnlyWorker(self._failed)
        """Worker for slow values of the panels, such as an outline, which are shown when they are there."""
        self.panels: dict[str, Panel] = {
            "Open": OpenPanel(self),
            "Select": SelectPanel(self),
            "Place": PlacePanel(self),
            "Light": LightPanel(self),
            "Run": RunPanel(self),
            "Share": SharePanel(self),
        }
        server.attach(self)
        with self.lock:
            self.open_project()
        for name, work in (("actions", self._act), ("poll", self._poll_loop)):
            threading.Thread(target=work, name=f"splatgraft {name}", daemon=True).start()

    def close(self) -> None:
        """End all threads and the light process; jobs continue."""
        self._is_open = False
        self._actions.put(None)
        for closed in (self.stream, self._marker, self.background, self._light):
            if closed is not None:
                closed.close()

    # the project

    def open_project(self) -> None:
        """Open the project, if it exists, at its next step; store an error as `problem`."""
        self.session, self.problem, self._seen = None, None, stamps_of(self.project.file)
        if self._light is not None:
            self._light.close()
        self._light = None
        for view in self.stream.views:
            view.orbits.clear()
        try:
            if self.project.file.is_file():
                self.session = Session(self.project)
                self._light = LightProcess(self.project, self._lit, self._failed)
        except (ValueError, OSError) as error:
            self.problem = " ".join(str(error).split())
        session = self.session
        if session is None or not session.files.have_both_scenes:
            self.show_step("Open")
            return
        if session.files.relit.is_file() and session.why_stale("relight") is None:
            with contextlib.suppress(ValueError, OSError):  # the light is then computed
                session.pictures.lit.adopt(session.placed_state())
        self.show_step("Place" if session.files.object.is_file() else "Select")

    def require_session(self) -> Session:
        """Return the open project; raise ValueError if no project is open."""
        if self.session is None:
            raise ValueError("Start a project first.")
        return self.session

    def shown_state(self) -> EditState:
        """Return the state of the current drag, or the saved state."""
        return self.live or self.require_session().placed_state()

    def show_live(self, state: EditState | None) -> None:
        """Show a state during a drag; None shows the saved one."""
        if state is not None:
            check_state(state)
        self.live = state
        # a dragged object keeps its last colours until it pauses; a dragged light shows by its drafts alone
        if state is None or self.step == "Light":
            self._want_light()
        self.stream.touch(moving=True)

    def run(self, to: str, title: str) -> None:
        """Start a job that runs the stale steps up to `to`."""
        session = self.require_session()
        session.jobs.start(session.project.run_words(to), title)
        self.say(f"{title}: started; it continues if you close this page")

    # the panel and the status line

    def say(self, sentence: str, *, bad: bool = False) -> None:
        """Show one sentence in the status line."""
        self.status, self.is_bad = " ".join(sentence.split()), bad

    def refresh(self) -> None:
        """Rebuild the panel and redraw."""
        with self.lock:
            form = Form()
            with self.reported():
                self.panels[self.step].build(form)
            if self.session is not None and self.step != "Select":
                form.more()
                self._add_view(form)
            form.hidden("cancel_job", self.cancel_job)
            self._form = form
            self._want_light()
            self._send_panel()
            self.stream.touch()
            self._marker.submit(partial(self._find_marks, self.session))

    def _add_view(self, form: Form) -> None:
        """Add the controls of the picture, common to all steps of the target."""
        form.choice("kind", "Picture", self.kind, KINDS, partial(setattr, self, "kind"))
        hint = "Left of the divider, and while Tab is held"
        form.choice("before", "Compare with", self.before, KINDS, partial(setattr, self, "before"), hint=hint)
        self.add_photos(form)

    def add_photos(self, form: Form) -> None:
        """Add the slider that steps through the photos."""
        cameras, view = self.cameras(), self.editing()
        if cameras is not None and len(cameras) > 1 and view is not None:
            shown = view.photo  # another thread may turn the view away from the photo
            photo = 1 if shown is None else shown + 1
            hint = "Look from the place of a photo; also by the arrow keys"
            ends, show = (1, len(cameras), 1), lambda value: self.to_photo(int(value) - 1)
            form.slider("photo", "Photo", photo, ends, show, hint=hint)
            form.while_dragged("photo", show)

    def _send_panel(self) -> None:
        session, status, is_bad = self.session, self.status, self.is_bad
        is_unsaved = session is not None and session.is_unsaved
        if is_unsaved and not status:
            status, is_bad = _FULL_DISK, True
        panel = {
            "t": "panel",
            "project": "no project yet" if session is None else session.files.file.parent.name,
            "saved": "" if session is None else "not saved" if is_unsaved else "saved",
            "steps": [[name, _CURRENT if name == self.step else self._marks.get(name, "")] for name in self.panels],
            "controls": [*self._form.controls, *self._job_controls()],
            "status": status,
            "bad": is_bad,
            "undo": bool(session and session.history.at),
            "redo": bool(session and session.history.undone),
            **self.panels[self.step].tools(),
        }
        for index, view in enumerate(self.stream.views):
            own = {"window": view.window.number, "editing": index == 0, "offer": self.offer if index == 0 else None}
            view.window.send("panel", json.dumps(panel | own))

    def editing(self) -> View | None:
        """Return the editing window's view; None if no window is open."""
        return self.stream.views[0] if self.stream.views else None

    # drawing, in the thread of the stream

    def draw(self, view: View, camera: Cameras) -> tuple[UInt8[np.ndarray, "h w 3"], dict[str, Any]]:
        """Draw a window's view and its overlay."""
        panel, problem = self.panels[self.step], ""
        over: dict[str, Any] = {}
        try:
            if self.session is None:
                raise ValueError("There is nothing to see yet.")
            pixels, caption = panel.picture(view, camera)
            over = panel.overlay(view, camera)
        except (ValueError, OSError) as error:
            problem, caption = " ".join(str(error).split()), ""
            pixels = np.full((camera.height, camera.width, 3), _GREY, np.uint8)
        return pixels, over | {"caption": caption, "problem": problem, "step": self.step}

    def draw_target(self, view: View, camera: Cameras) -> tuple[UInt8[np.ndarray, "h w 3"], str]:
        """Draw the target, with the comparison picture left of the divider, and its caption."""
        session, state = self.require_session(), self.shown_state()
        pictures, column, parts = session.pictures, round(view.split * camera.width), []
        sides: list[tuple[Kind, int, int]] = [(self.before, 0, column), (self.kind, column, camera.width)]
        for kind, left, right in sides:
            if left == right:
                continue
            part = camera if right - left == camera.width else camera.cropped([(left, 0, right, camera.height)])
            parts.append(pictures.draw(kind, state, part))
        caption = "full quality"
        if self.kind == "lit" and state.objects:
            words = {"": "old light: computing", "draft": "draft of the light"}
            caption = words.get(pictures.lit.stage(state), caption)
            caption = caption if session.files.transfers_light else "light transfer off"
        return parts[0] if len(parts) == 1 else np.concatenate(parts, 1), caption

    def orbit(self, view: View) -> Orbit | None:
        """Return a window's view, kept in free space; None if there is no scene to show."""
        side, session = self.side, self.session
        if session is None:
            return None
        found = view.orbits.get(side)
        if found is None:
            cameras = self.cameras()
            if cameras is None:
                return None
            found = view.orbits[side] = through(cameras[0], typical_distance(cameras))
            view.photo = 0
        if view.photo is not None or side == "source":
            return found
        space = self._free_space()
        if space is None:
            return found
        kept = space.kept(found)
        # the stored view keeps its distance, so that the camera moves back when the way is free
        wished = kept.zoomed(found.distance / kept.distance, scale=found.distance) if kept is not found else found
        if view.orbits.get(side) is found:
            view.orbits[side] = wished
        return kept

    @property
    def side(self) -> Side:
        """Scene that the step shows."""
        return "source" if self.step == "Select" else "target"

    def cameras(self) -> Cameras | None:
        """Return the cameras of the shown scene; None if they or the scene do not exist yet."""
        if self.session is None:
            return None
        session, side = self.session, self.side
        is_there = all(paths[side].is_file() for paths in (session.files.cameras, session.files.scenes))
        return session.scenes.cameras(side) if is_there else None

    def up(self) -> np.ndarray:
        """Return the up direction of the shown scene."""
        return self.require_session().up(self.side).double().numpy()

    def _free_space(self) -> FreeSpace | None:
        session, cameras = self.session, self.cameras()
        if session is None or cameras is None:
            return None
        scene, objects = session.scenes.scene("target"), session.objects()

        def make() -> FreeSpace:
            foot = objects[0].target_from_object.points(session.placeable_object(0).base.point) if objects else None
            return FreeSpace.of(scene, cameras, session.up("target"), foot)

        return session.scenes.derive("free space", (scene, objects), make)

    def _want_light(self) -> None:
        session = self.session
        if session is None or self._light is None or self.step == "Select" or not self.stream.views:
            return
        if not session.files.transfers_light or not session.files.scenes["target"].is_file():
            return
        state = self.shown_state()
        stage = session.pictures.lit.stage(state)
        if not state.objects or stage == "final":
            return
        if self.live is not None:
            self._light.want(state, "draft")
        elif stage != "file" or self.step == "Light":
            self._light.want(state, "final")
        elif self.stream.is_at_rest(_IDLE_SECONDS):
            self._light.want(state, "prepared")

    def _lit(self, state: EditState, stage: Stage, layers: Relit | Draft) -> None:
        if self.session is not None and self._is_open:
            self.session.pictures.lit.add(state, stage, layers)
            self.stream.touch()
            if self.live is None:
                self.refresh()

    def _drawing_failed(self, error: Exception) -> None:
        traceback.print_exception(error)
        self._failed(error)

    def _failed(self, error: Exception | str) -> None:
        self.say(str(error), bad=True)
        self._send_panel()

    # messages of windows, in the thread of the server

    def opened(self, window: Window) -> None:
        """Start to draw for a new window."""
        self.stream.add(View(window))
        self._send_panel()
        with contextlib.suppress(queue.Full):
            self._actions.put_nowait((window, {"t": "opened"}))

    def closed(self, window: Window) -> None:
        """Stop drawing for a window; the next oldest one edits."""
        self.stream.remove(window)
        self._send_panel()

    def received(self, window: Window, message: dict[str, Any]) -> None:
        """Handle a message: move views at once and queue all else."""
        view, kind = self.stream.of(window), message["t"]
        if view is None:
            return
        if kind in _VIEW_KINDS:
            self._take_view(view, message)
            return
        if kind == "pointer":
            Pointer.of(message)
        elif not isinstance(message[_WORDS[kind]], str):
            raise ValueError("expected a name")
        if view is self.editing():
            if kind == "pointer" and message["what"] == "move":
                if self.live is not None:
                    view.moved_at = time.monotonic()  # no picture of full size between two slow moves
                waits, self._moves = self._moves is not None, message
                if waits:
                    return
            try:
                self._actions.put_nowait((window, message))
            except queue.Full as error:
                raise ValueError("expected fewer messages") from error

    def _take_view(self, view: View, message: dict[str, Any]) -> None:
        """Handle a message about a window's own view."""
        kind = message["t"]
        if kind == "size":
            width, height = int(message["w"]), int(message["h"])
            if not (0 < width < 1 << 15 and 0 < height < 1 << 15):
                raise ValueError("expected a size of a canvas")
            view.size = (width, height)
            self.stream.touch(view)
        elif kind == "ack":
            self.stream.acknowledge(view, int(message["n"]))
        elif kind == "split":
            view.split = min(1.0, max(0.0, _share(message["x"])))
            self.stream.touch(view, moving=True)
        elif kind == "zoom":
            factor = 2 ** _share(message["by"])
            self._move_view(view, lambda orbit: orbit.zoomed(factor, scale=self.scene_scale()))
        else:
            x, y = _share(message["x"]), _share(message["y"])
            is_turn = kind == "turn"
            self._move_view(view, lambda orbit: orbit.turned(x, y, up=self.up()) if is_turn else orbit.moved(x, y))

    def _move_view(self, view: View, move: Callable[[Orbit], Orbit]) -> None:
        found = view.orbits.get(self.side)
        if found is not None:
            view.orbits[self.side], view.photo = move(found), None
            self.stream.touch(view, moving=True)

    def scene_scale(self) -> float:
        """Return the typical distance of the shown scene."""
        cameras = self.cameras()
        return 1.0 if cameras is None else typical_distance(cameras)

    def to_photo(self, index: int) -> None:
        """Move the editing window's view to one of the scene's cameras."""
        cameras, view = self.cameras(), self.editing()
        if cameras is not None and view is not None:
            index %= len(cameras)
            view.photo, view.orbits[self.side] = index, through(cameras[index], typical_distance(cameras))
            self.stream.touch(view)

    # actions of the editing window, in a thread of their own

    def _act(self) -> None:
        while True:
            try:
                action = self._actions.get(timeout=_PAUSE_SECONDS if self.live is not None else None)
            except queue.Empty:
                with self.lock, self.reported():
                    self._want_light()  # of the place where the drag pauses
                action = self._actions.get()
            if action is None:
                return
            window, message = action
            is_move = message["t"] == "pointer" and message["what"] == "move"
            if is_move:
                message, self._moves = self._moves or message, None
                if self.live is not None and not self._actions.empty():
                    continue  # the release of a drag has its own place
            with self.lock:
                view = self.editing()
                if view is not None and view.window is window:
                    self._take_action(view, message)
            if is_move and view is not None:
                # placements that are never drawn would delay the next picture
                self.stream.wait_drawn(view, _DRAWN_SECONDS)

    def _take_action(self, view: View, message: dict[str, Any]) -> None:
        is_move = message["t"] == "live" or (message["t"] == "pointer" and message["what"] == "move")
        if self.is_bad and not is_move and message["t"] != "opened":
            self.say("")  # an error stays until the next action
        with self.reported():
            self._do(view, message)
        if not is_move:
            self.refresh()

    def _do(self, view: View, message: dict[str, Any]) -> None:
        kind = message["t"]
        if kind in ("do", "live"):
            self.live = self.live if kind == "live" else None  # a control's last value ends its drag
            self._form.take(message["id"], message.get("value"), live=kind == "live")
        elif kind == "pointer":
            self.panels[self.step].pointer(view, Pointer.of(message))
        elif kind == "step" and message["to"] in self.panels:
            self.show_step(message["to"])
        elif kind == "key":
            self._press(view, message["key"])

    def _press(self, view: View, key: str) -> None:
        steps = {"ctrl+z": (-1, "undone"), "ctrl+shift+z": (1, "redone")}
        if key in steps:
            by, word = steps[key]
            self.live = None
            self.say(word if self.require_session().step(by) else f"nothing can be {word}")
        elif key == "f":
            self._look_at_object(view)
        elif key == "home":
            self.to_photo(0)
        elif not self.panels[self.step].key(view, key) and key in ("arrowleft", "arrowright"):
            self.to_photo((view.photo or 0) + (1 if key == "arrowright" else -1))

    def show_step(self, step: str) -> None:
        """Switch to another step."""
        self.panels[self.step].leave()
        self.live, self.step = None, step
        if step in ("Place", "Light") and self.kind == "result":
            self.kind = "lit"
        self.say("")
        for view in self.stream.views:
            view.photo = None if self.side == "target" else 0
            if self.side == "source":
                view.orbits.pop("source", None)  # Select begins at a photo
        with self.reported():
            self.panels[step].enter()
        self.refresh()

    def _look_at_object(self, view: View) -> None:
        scene, orbit = self._object_in_view(), view.orbits.get(self.side)
        if scene is None or not scene.count or orbit is None:
            raise ValueError("There is no object to look at yet.")
        view.orbits[self.side], view.photo = orbit.framing(bounding_sphere(scene), up=self.up()), None
        self.stream.touch(view)

    def _object_in_view(self) -> Gaussians | None:
        session = self.require_session()
        if self.step == "Select":
            which = session.selection()
            return None if which is None else session.scenes.scene("source").select(which)
        pairs = enumerate(session.objects())
        parts = [one.target_from_object.gaussians(session.placeable_object(i).gaussians) for i, one in pairs]
        return concatenate(parts) if parts else None

    @contextlib.contextmanager
    def reported(self) -> Iterator[None]:
        """Show an error of the block in the status line instead of raising it."""
        try:
            yield
        except (ValueError, OSError) as error:
            line = os_error_line(error) if isinstance(error, OSError) else str(error)
            if is_disk_full(error):
                line = _FULL_DISK
                if self.session is not None:
                    self.session.is_unsaved = True
            self.say(line, bad=True)
        except Exception as error:  # a programming error must be visible and must not end the page
            traceback.print_exc()
            self.say(f"{type(error).__name__}: {error} (traceback in the terminal)", bad=True)

    # files

    def file(self, name: str) -> Path | None:
        """Return the file to serve for a name."""
        return None if self.session is None else served_file(self.session.files, name)

    def upload_path(self, name: str) -> Path:
        """Choose a free path for an uploaded file, in a subfolder if its name begins with one."""
        folder, _, given = name.replace("\\", "/").rpartition("/")
        path = Path(given)
        if not path.suffix or path.name.startswith(".") or "\x00" in given or len(given) > 200:
            raise ValueError(f"{given:.60}: expected a file with a suffix that names its format, found none")
        if folder and not re.fullmatch(r"photos_[0-9]{1,13}", folder):
            folder = ""
        place = self.project.file.parent / _UPLOADS_FOLDER / folder
        place.mkdir(parents=True, exist_ok=True)
        number, found = 1, place / path.name
        while found.exists():
            number += 1
            found = place / f"{path.stem}_{number}{path.suffix}"
        return found

    def uploaded(self, path: Path, use: str) -> None:
        """Use an uploaded file, or an identical earlier one."""
        alike = sorted(path.parent.glob(f"{re.sub(r'_[0-9]+$', '', path.stem)}*{path.suffix}"))
        twin = next((one for one in alike if one != path and filecmp.cmp(one, path, shallow=False)), None)
        if twin is not None:
            path.unlink()
        with self.lock:
            with self.reported():
                self.say(f"{path.name}: stored as {twin or path}")
                self.panels[self.step].uploaded(twin or path, use)
            self.refresh()

    # files and jobs that change

    def _poll_loop(self) -> None:
        while self._is_open:
            time.sleep(_POLL_SECONDS)
            with self.lock:
                if self._is_open:
                    self.poll()

    def poll(self) -> None:
        """Load outside changes, retry a failed save, and show the job's progress."""
        session = self.session
        with self.reported():
            if self.problem is not None and stamps_of(self.project.file) != self._seen:
                self.open_project()
            elif session is not None and session.reload():
                session.pictures.lit.forget()
                self.say("the project's files were changed outside the editor and were loaded again")
                self.refresh()
            elif session is not None and session.is_unsaved and session.save_again():
                self.say("saved again")
                self.refresh()
            if self._light is not None and not self._light.is_started:
                self._want_light()  # drafts that are prepared at rest; a process that has ended is not started here
            state = None if session is None else session.jobs.state()
            if state is not None:
                self._show_job(state)

    def _show_job(self, state: JobState) -> None:
        current = f"{state.pid} {state.outcome} {state.step}"
        if current == self._last_job:
            if state.live:
                self._send_panel()
            return
        ended, self._last_job = bool(self._last_job) and not state.live, current
        if ended or state.outcome == "killed":
            sentences = {
                "done": "done",
                "failed": state.error,
                "cancelled": "cancelled; finished steps are kept, and the same run resumes from here",
                "killed": "the process ended unexpectedly; start it again, it resumes from where it was",
            }
            self.say(f"{state.title}: {sentences.get(state.outcome, '')}", bad=state.outcome in ("failed", "killed"))
        if ended:
            for panel in self.panels.values():
                panel.job_ended(state)
        self.refresh()

    def _job_controls(self) -> list[dict[str, Any]]:
        """Describe the running job."""
        form, state = Form(), None if self.session is None else self.session.jobs.state()
        if state is not None and state.live:
            now, step = time.time(), state.step or "starting"
            left = {"left in this step": seconds_left(state, now), "in all": seconds_left_in_job(state, now)}
            known = [f"about {_minutes(seconds)} {what}" for what, seconds in left.items() if seconds is not None]
            form.note(f"{state.title}: {', '.join(known) or 'time left: not measured yet'}", name="job")
            form.progress("job_share", state.fraction)
            planned = [one.name for one in state.plan]
            names = planned if step in planned else [step]
            for number, name in enumerate(names, -names.index(step)):
                mark, message = "✓" if number < 0 else "●" if number == 0 else "·", state.message if number == 0 else ""
                form.note(f"{mark} {name}{message and ': '}{message}", name=f"job_{name}")
            form.button("cancel_job", "Cancel", self.cancel_job)
        return form.controls

    def cancel_job(self) -> None:
        """Interrupt the running job."""
        self.require_session().jobs.cancel()
        self.say("stopping")

    def _find_marks(self, session: Session | None) -> None:
        """Update the marks of the steps when nothing has changed for a moment."""
        if self._marker.wait_idle(_MARK_SECONDS):
            marks = {} if session is None else _marks(session)
            with self.lock:
                if session is self.session and marks != self._marks:
                    self._marks = marks
                    self._send_panel()


def _marks(session: Session) -> dict[str, str]:
    """Mark the steps that are done, out of date, or next."""
    files, reasons = session.files, session.project.reasons()

    def state(exists: bool, *steps: str) -> str | None:
        return None if not exists else _DONE if all(reasons.get(step) is None for step in steps) else _STALE

    exports = written_exports(files)
    result = max((p.stat().st_mtime_ns for p in (files.result, files.relit) if p.is_file()), default=0)
    states = {
        "Open": state(files.have_both_scenes, "source/reconstruct", "target/reconstruct"),
        "Select": state(files.object.is_file(), "segment"),
        "Place": _DONE if session.objects() else None,
        "Light": _DONE if session.state.light is not None or files.relit.is_file() else None,
        "Run": state(files.result.is_file(), "consolidate"),
        "Share": None if not exports else _DONE if exports[0].stat().st_mtime_ns >= result else _STALE,
    }
    # the light is estimated if it is not set
    following = next((name for name, mark in states.items() if mark is None and name != "Light"), None)
    return {name: mark or _NEXT for name, mark in states.items() if mark is not None or name == following}


def _share(value: Any) -> float:
    """Parse a drag or position in units of a canvas's side."""
    number = float(value)
    if isinstance(value, bool) or not -10 < number < 10:
        raise ValueError("expected a place near the canvas")
    return number


def _minutes(seconds: float) -> str:
    return f"{seconds / 60:.0f} min" if seconds >= 90 else f"{seconds:.0f} s"
