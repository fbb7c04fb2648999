"""What the parts of the page share: the open project, the 3D view, the status line, and the wrapper of events."""

import contextlib
import html
import threading
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import viser

from splatgraft.core.bounds import BoundingSphere
from splatgraft.core.cameras import Cameras
from splatgraft.editor.jobs import JobState
from splatgraft.editor.page.opening import View, look_through, typical_distance
from splatgraft.editor.page.scene_view import SceneView
from splatgraft.editor.page.server import GuardedServer
from splatgraft.editor.project import Project
from splatgraft.editor.session import Session, Stamps, stamps_of
from splatgraft.runtime.files import atomic_write, os_error_line

VIEW_ORDER, STATUS_ORDER, HISTORY_ORDER, MORE_ORDER = 0.5e6, 1e6, 2e6, 3e6
"""Places in the panel of what stands below the phases."""
_UPLOADS_FOLDER = "uploads"
Control = TypeVar("Control")


def note(text: str, *, kind: str = "note", bad: bool = False, faint: bool = False) -> str:
    """HTML of a paragraph of the panel; `text` is HTML, and `kind` names the paragraph for tests."""
    color = ";color:#e8590c" if bad else ""
    style = f"font-size:.85em;line-height:1.5;padding:2px 12px{color}{';opacity:.75' if faint else ''}"
    return f'<div class="sg-{kind}" style="{style}">{text}</div>'


def parse_path(text: str) -> Path:
    """The path that a text field names; ValueError where it is empty."""
    if not text.strip():
        raise ValueError("path: expected one, found nothing")
    return Path.cwd() / Path(text.strip()).expanduser()


class PageContext:
    """The open project on a server; `Page` sets the calls that show its changes."""

    def __init__(self, guarded: GuardedServer, project: Project, *, budget: int, shown: Path | None = None) -> None:
        """Open the project where there is one; `shown` is the scene of which a sample is shown already."""
        self.guarded, self.project = guarded, project
        self.server, self.gui = guarded.viser, guarded.viser.gui
        self.view = SceneView(self.server, budget=budget, coarse=shown)
        self.lock = threading.RLock()
        self.is_open = True
        self.phase = "Open"
        self.session: Session | None = None
        self.problem: str | None = None
        """Why the project could not be opened; None where it could, or where there is none."""
        self.refresh: Callable[[], None] = lambda: None
        """Updates the current phase, the preview, the header and the undo buttons."""
        self.reopened: Callable[[], None] = lambda: None
        """Shows another project, after `open_project`."""
        self.on_close: list[Callable[[], None]] = []
        self.status = self.gui.add_html("", order=STATUS_ORDER)
        self.more = self.gui.add_folder("More", order=MORE_ORDER, expand_by_default=False)
        """Holds what a phase does not show at first."""
        self.more_folders: dict[str, viser.GuiFolderHandle] = {}
        """The folders in `more`, by the name of a phase, or of what all phases share."""
        self._seen: Stamps = ()
        self._is_bad = False
        self.open_session()

    def open_session(self) -> None:
        """Open the project where there is one; what prevents it is kept as `problem`."""
        self.session, self.problem, self._seen = None, None, stamps_of(self.project.file)
        try:
            if self.project.files() is not None:
                self.session = Session(self.project)
                self.session.scenes.on_read = self._scene_read
        except (ValueError, OSError) as error:
            self.problem = " ".join(str(error).split())

    def open_project(self) -> None:
        """Open the project that was just created or corrected, and show it."""
        self.open_session()
        self.reopened()

    def is_corrected(self) -> bool:
        """Whether the files of a project that could not be opened have changed since."""
        return self.problem is not None and stamps_of(self.project.file) != self._seen

    def require_session(self) -> Session:
        """The open project; ValueError where there is none."""
        if self.session is None:
            raise ValueError("project: expected one, found none; name two captures and start")
        return self.session

    def more_of(self, name: str) -> viser.GuiFolderHandle:
        """A new folder in `more`; `with` it, controls are added to it."""
        with self.more:
            self.more_folders[name] = self.gui.add_folder(name)
        return self.more_folders[name]

    # events

    def on(self, control: Control, work: Callable[[], object]) -> Control:
        """Call `work` when a control is clicked or changed by a user; gives the control."""
        connect = next(
            getattr(control, name) for name in ("on_trigger", "on_click", "on_update") if hasattr(control, name)
        )
        connect(self.callback(lambda _: work()))
        return control

    def callback(self, work: Callable[[Any], object]) -> Callable[[Any], None]:
        """Wrap an event handler: errors are shown in the status line, and the page is refreshed afterwards."""

        def call(event: Any) -> None:
            if getattr(event, "client_id", 0) is None:
                return  # the program itself has set a control
            with self.lock:
                if self._is_bad:
                    self.say("")  # an error holds until the next action
                with self.reported():
                    work(event)
                self.refresh()

        return call

    @contextlib.contextmanager
    def reported(self) -> Iterator[None]:
        """Show an error of the block in the status line instead of raising it."""
        try:
            yield
        except OSError as error:
            self.say(os_error_line(error), bad=True)
        except ValueError as error:
            self.say(str(error), bad=True)
        except Exception as error:  # a programming error must be visible and must not end the page
            traceback.print_exc()
            self.say(f"{type(error).__name__}: {error} (traceback in the terminal)", bad=True)

    def say(self, sentence: str, *, bad: bool = False) -> None:
        """Show one sentence in the status line."""
        self._is_bad = bad
        self.status.content = note(html.escape(" ".join(sentence.split())), kind="status", bad=bad)

    def say_error(self, error: Exception) -> None:
        """Show an error in the status line."""
        self.say(str(error), bad=True)

    def run(self, to: str, title: str) -> None:
        """Start a job that runs the stale steps up to `to`."""
        session = self.require_session()
        session.start_job(session.project.run_words(to), title)
        self.say(f"{title}: started; it continues if you close this page")

    # files that users name or upload

    def add_upload(
        self, label: str, suffixes: tuple[str, ...], use: Callable[[Path], object]
    ) -> viser.GuiUploadButtonHandle:
        """Add a button that uploads a file; `use` gets the path of the stored one."""
        button = self.gui.add_upload_button(label, icon=viser.Icon.UPLOAD, color="gray", mime_type=",".join(suffixes))
        button.on_upload(self.callback(lambda event: use(self._stored(event.target.value))))
        return button

    def _stored(self, file: viser.UploadedFile) -> Path:
        """Keep an uploaded file beside the project, under its own name or one with a number."""
        given = Path(Path(file.name.replace("\\", "/")).name)
        if not given.suffix or given.name.startswith("."):
            raise ValueError(f"{file.name}: expected a file with a suffix that names its format, found none")
        folder, number = self.project.file.parent / _UPLOADS_FOLDER, 1
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / given
        while path.is_file() and path.read_bytes() != file.content:
            number += 1
            path = folder / f"{given.stem}_{number}{given.suffix}"
        with atomic_write(path) as stream:
            stream.write(file.content)
        self.say(f"{file.name}: stored as {path}")
        return path

    # scenes and cameras

    @property
    def scene_side(self) -> str:
        """The scene that the phase shows."""
        return "source" if self.phase == "Select" else "target"

    def scene_file(self) -> Path | None:
        """The file of the scene that the phase shows; None where no project is open."""
        if self.session is None:
            return None
        files = self.session.files
        return files.source_scene if self.phase == "Select" else files.target_scene

    def cameras(self) -> Cameras | None:
        """The cameras of the scene that the phase shows; None where there are none yet."""
        if self.session is None:
            return None
        files = self.session.files
        path = files.source_cameras if self.phase == "Select" else files.target_cameras
        return self.session.scenes.cameras(path) if path.is_file() else None

    def scene_scale(self) -> float:
        """Typical distance between cameras and content: the median distance of the cameras from their mean."""
        cameras = self.cameras()
        return 1.0 if cameras is None else typical_distance(cameras.centers.numpy())

    def look_through(self, window: viser.ClientHandle | None, camera: Cameras) -> None:
        """Move a window's view to a camera."""
        if window is not None:
            half_height = camera.height / (2 * float(camera.intrinsics[0, 1, 1]))
            pose, aspect = camera.world_from_camera[0].double().numpy(), camera.width / camera.height
            look_through(window, View(pose, self.scene_scale(), half_height, aspect))

    def frame(self, window: viser.ClientHandle | None, sphere: BoundingSphere) -> None:
        """Let a window look at a sphere, so that it fills two thirds of the height, from the direction that it has."""
        if window is None:
            return
        camera, center = window.camera, sphere.center.double().numpy()
        away = np.asarray(camera.position) - np.asarray(camera.look_at)
        distance = 1.5 * sphere.radius / np.sin(min(camera.fov, camera.fov * camera.aspect) / 2)
        with window.atomic():
            camera.position = center + away / max(float(np.linalg.norm(away)), 1e-9) * distance
            camera.look_at = center

    def show_target(self) -> bool:
        """Show the target and the placed objects in the 3D view, or a sample of a target that is being read.

        Returns whether all of them are shown; False where there is no target.
        """
        session = self.session
        if session is None or not session.files.target_scene.is_file():
            return False
        scenes, state, view, path = session.scenes, session.placed_state(), self.view, session.files.target_scene
        if scenes.at_hand([path]):
            target, erased = scenes.gaussians(path), state.erased
            if erased is not None and len(erased) != target.count:
                raise ValueError(
                    f"erased.npy: expected one flag per Gaussian of the target, {target.count:,}; found "
                    f"{len(erased):,}; restore all erased, or undo"
                )
            view.show_splats(
                "/target/scene", target, which=None if erased is None else scenes.complement("erased", erased)
            )
            view.remove_coarse()
        elif not view.is_shown("/target/scene"):
            sample = scenes.sample(path)
            if sample is not None and state.erased is not None:
                sample = sample.without(state.erased.numpy())
            view.show_coarse(path, sample)
        objects = state.objects or ()
        for index, item in enumerate(objects):
            file = scenes.object_path(item)
            if scenes.at_hand([file]):
                gaussians = scenes.gaussians(file)
                view.show_splats(f"/target/objects/{index}", gaussians, transform=item.target_from_object)
        for name in [name for name in view.shown if name.startswith("/target/objects/")]:
            if int(name.rpartition("/")[2]) >= len(objects):
                view.remove_splats(name)
        return scenes.at_hand(session.placed_scenes())

    def _scene_read(self) -> None:
        if self.is_open and self.session is not None:
            self.refresh()


class SceneClicks:
    """Takes clicks on the scene while they are wanted."""

    def __init__(self, context: PageContext, work: Callable[[viser.SceneClickEvent], object]) -> None:
        """Take none yet; `work` gets each of them."""
        self._scene, self._call = context.server.scene, context.callback(work)
        self.is_listening = False
        """Whether clicks are taken."""

    def listen(self, wanted: bool) -> None:
        """Take clicks from now on, or no more."""
        if wanted and not self.is_listening:
            self._scene.on_click()(self._clicked)
        elif self.is_listening and not wanted:
            self._scene.remove_click_callback(self._clicked)
        self.is_listening = wanted

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        self._call(event)


class Phase:
    """One phase of the editing workflow: its controls and its part of the 3D view."""

    def enter(self) -> None:
        """Begin what holds while the phase is shown."""

    def leave(self) -> None:
        """End it, and hide what belongs to the phase alone."""

    def refresh(self) -> None:
        """Update controls and 3D view to the current state."""
        raise NotImplementedError

    def view_shown(self, camera: Cameras) -> None:
        """Update what depends on the view, after a picture of it was put on the canvas."""

    def job_ended(self, job: JobState) -> None:
        """Update what depends on a job that has ended; called for all phases."""
