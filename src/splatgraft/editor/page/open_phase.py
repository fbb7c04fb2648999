"""The phase `Open`: create a project of two captures or scenes, and reconstruct the scenes that are missing."""

import html
from functools import partial
from pathlib import Path

import viser

from splatgraft.core.capture_orientation import estimate_up
from splatgraft.editor.page.context import PageContext, Phase, note, parse_path
from splatgraft.editor.placement import Triple
from splatgraft.editor.project import RenderedViews
from splatgraft.editor.session import Session
from splatgraft.editor.worker import LatestOnlyWorker
from splatgraft.folders.input_description import describe_input
from splatgraft.formats import SCENE_SUFFIXES
from splatgraft.project.layout import Side

_HELP = (
    "A capture is a folder of photos, a video, a COLMAP folder, or a folder with a `transforms.json`. "
    "A trained scene (`.ply`, `.spz`, `.sog`, ...) works as well: its images are rendered from cameras around it."
)
_SIDES: tuple[tuple[Side, str], ...] = (("source", "Object from"), ("target", "Place into"))
_VIDEOS = (".mp4", ".mov", ".mkv", ".avi", ".webm")
_UPS: dict[str, Triple | None] = {
    "as found": None,
    "+z": (0.0, 0.0, 1.0),
    "-y": (0.0, -1.0, 0.0),
    "+y": (0.0, 1.0, 0.0),
    "-z": (0.0, 0.0, -1.0),
    "+x": (1.0, 0.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
}
_LOOKS: dict[str, bool] = {"from around": False, "from within": True}
_TRAINED_HINT = "A trained scene (.ply, .spz, .sog, ...) in the same frame as its capture"


class OpenPhase(Phase):
    """The controls of the phase."""

    def __init__(self, context: PageContext) -> None:
        """Build the controls."""
        self._context, gui = context, context.gui
        self._problem = gui.add_html("", visible=False)
        self._help = gui.add_markdown(_HELP)
        self._source = gui.add_text("Object from", "", hint="The capture or scene with the object: a path")
        self._found_source = gui.add_html("")
        self._target = gui.add_text("Place into", "", hint="The capture or scene that receives it: a path")
        self._found_target = gui.add_html("")
        self._is_usable = [False, False]
        self._looker = LatestOnlyWorker(self._look, context.say_error)
        context.on_close.append(self._looker.close)
        # viser shows an upload button always: its folder can be hidden
        self._upload = gui.add_folder("From this device")
        with self._upload:
            context.add_upload("Upload a video or a scene", (*SCENE_SUFFIXES, *_VIDEOS), self._uploaded)
        self._start = context.on(gui.add_button("Start the project", icon=viser.Icon.PLUS), self._create)
        self._facts = gui.add_html("")
        with context.more_of("Open"):
            self._scenes = tuple(
                gui.add_text(f"Scene {of}", "", hint=_TRAINED_HINT) for of in ("of the object", "of the place")
            )
            self._looks = {s: gui.add_dropdown(f"Cameras: {s}", tuple(_LOOKS), visible=False) for s, _ in _SIDES}
            self._ups = {s: gui.add_dropdown(f"Up: {s}", tuple(_UPS), visible=False) for s, _ in _SIDES}
        self._other_ups: dict[Side, dict[str, Triple | None]] = {side: {} for side, _ in _SIDES}
        self._build = gui.add_button("Reconstruct both scenes", icon=viser.Icon.PLAYER_PLAY)
        for field in (self._source, self._target):
            context.on(field, self._look_later)
        for side, _ in _SIDES:
            for control in (self._looks[side], self._ups[side]):
                context.on(control, partial(self._set_view, side))
        context.on(self._build, lambda: context.run("reconstruct", "Reconstruct both scenes"))

    def refresh(self) -> None:
        """Show the fields of a new project, or the facts of the open one."""
        session, problem = self._context.session, self._context.problem
        self._problem.visible = problem is not None
        if problem is not None:
            self._problem.content = note(
                f"<b>This project cannot be opened:</b><br>{html.escape(problem)}<br>"
                "Correct the file; the page opens it as soon as it is saved.",
                kind="problem",
                bad=True,
            )
        is_new = session is None and problem is None
        fields = (self._source, self._found_source, self._target, self._found_target, *self._scenes)
        for control in (self._help, *fields, self._upload, self._start):
            control.visible = is_new
        self._start.disabled = not all(self._is_usable)
        self._facts.visible = self._build.visible = session is not None
        for index, (side, _) in enumerate(_SIDES):
            without_photos = session is not None and session.files.without_photos[index]
            self._looks[side].visible = self._ups[side].visible = without_photos
            if session is not None:
                self._show_views(side, session.files.rendered_views[index])
        if session is None:
            return
        self._context.show_target()
        lines = [self._line(session, index) for index in range(len(_SIDES))]
        have_both = session.files.source_scene.is_file() and session.files.target_scene.is_file()
        why = session.why_stale(*(f"{side}/reconstruct" for side, _ in _SIDES)) if have_both else None
        if why is not None:
            lines.append(f"Out of date: {html.escape(why)}")
        self._facts.content = note("<br>".join(lines))
        self._build.visible = not have_both or why is not None
        self._build.label = "Update both scenes" if have_both else _title(session)
        self._build.color = "gray" if have_both else None

    # a new project

    def _look_later(self) -> None:
        self._looker.submit((self._source.value, self._target.value))

    def _look(self, paths: tuple[str, str]) -> None:
        """Say what the paths are, before anything is made of them."""
        for index, (path, shown) in enumerate(zip(paths, (self._found_source, self._found_target), strict=True)):
            found = describe_input(parse_path(path)) if path.strip() else None
            self._is_usable[index] = found is not None and found.is_usable
            text = "" if found is None else html.escape(found.text)
            shown.content = note(text, kind="found", bad=not self._is_usable[index])
        self._start.disabled = not all(self._is_usable)

    def _create(self) -> None:
        source, target = (parse_path(field.value) for field in (self._source, self._target))
        scenes = [parse_path(field.value) if field.value.strip() else None for field in self._scenes]
        self._context.project.create((source, target), scenes=(scenes[0], scenes[1]))
        self._context.open_project()
        session = self._context.require_session()
        if all(session.files.without_photos):
            # importing two scenes takes no training, so it starts at once
            self._context.run("reconstruct", _title(session))
            return
        self._context.say("the project is made; reconstruct both scenes next")

    def _uploaded(self, path: Path) -> None:
        fields = (self._source, self._target, *(self._scenes if path.suffix.lower() in SCENE_SUFFIXES else ()))
        next((field for field in fields if not field.value), fields[-1]).value = str(path)
        self._look_later()

    # the open project

    def _line(self, session: Session, index: int) -> str:
        files, name = session.files, _SIDES[index][1]
        scene = (files.source_scene, files.target_scene)[index]
        cameras = (files.source_cameras, files.target_cameras)[index]
        if not scene.is_file():
            return f"<b>{name}</b>: not reconstructed yet"
        sample = session.scenes.sample(scene)
        if sample is None and not session.scenes.at_hand([scene]):
            return f"<b>{name}</b>: being read"
        text = f"<b>{name}</b>: ready"
        if files.without_photos[index] and cameras.is_file():
            made = session.scenes.cameras(cameras)
            up = ", ".join(f"{round(x, 2) + 0.0:.2f}" for x in estimate_up(made).tolist())
            text += f", without photographs: {len(made)} pictures were rendered of it, with ({up}) as up"
        return text

    def _show_views(self, side: Side, views: RenderedViews) -> None:
        """Show what project.toml says; an up direction along no axis is an option of its own."""
        known = views.up in _UPS.values()
        self._other_ups[side] = {} if known else {f"({', '.join(f'{x:g}' for x in views.up or ())})": views.up}
        ups = _UPS | self._other_ups[side]
        if tuple(self._ups[side].options) != tuple(ups):
            self._ups[side].options = tuple(ups)
        self._ups[side].value = next(name for name, up in ups.items() if up == views.up)
        self._looks[side].value = next(name for name, is_within in _LOOKS.items() if is_within == views.is_within)

    def _set_view(self, side: Side) -> None:
        session, ups = self._context.require_session(), _UPS | self._other_ups[side]
        session.set_view(side, RenderedViews(ups[self._ups[side].value], _LOOKS[self._looks[side].value]))
        self._context.run("reconstruct", "Render the scene again")


def _title(session: Session) -> str:
    return "Import both scenes" if all(session.files.without_photos) else "Reconstruct both scenes"
