"""The phase `Open`: create a project of two captures or scenes, and reconstruct the scenes that are missing."""

from __future__ import annotations

import html
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import viser

from splatgraft.core.capture_orientation import estimate_up
from splatgraft.editor.page.place_phase import hide_target, show_target
from splatgraft.editor.previews.latest_only_worker import LatestOnlyWorker
from splatgraft.editor.session.project_access import RenderedViews, Triple
from splatgraft.editor.session.session import Session, backup_of
from splatgraft.editor.uploads.upload_checks import SCENES, SUFFIXES
from splatgraft.project.layout import Side

if TYPE_CHECKING:
    from splatgraft.editor.page.page import Page

_HELP = (
    "A capture is a folder of photos, a video, a COLMAP folder, or a folder with a `transforms.json`. "
    "A trained scene (`.ply`, `.spz`, `.sog`, ...) works as well: its images are rendered from cameras around it."
)
_NOTE_STYLE = "font-size:.8em;line-height:1.4;padding:0 12px 4px"
_SIDES: tuple[tuple[Side, str], ...] = (("source", "Object from"), ("target", "Place into"))
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


class OpenPhase:
    """The controls of the phase."""

    def __init__(self, page: Page) -> None:
        """Build the controls."""
        self._page, gui = page, page.gui
        self._problem = gui.add_html("", visible=False)
        self._restore = gui.add_button("Put the last good project.toml back", icon=viser.Icon.HISTORY, visible=False)
        self._restore.on_click(page.callback(lambda _: page.restore_project()))
        self._help = gui.add_markdown(_HELP)
        self._source = gui.add_text("Object from", "", hint="The capture or scene with the object: a path")
        self._found_source = gui.add_html("")
        self._target = gui.add_text("Place into", "", hint="The capture or scene that receives it: a path")
        self._found_target = gui.add_html("")
        self._is_usable = [False, False]
        self._looker = LatestOnlyWorker(self._look, lambda error: page.say(" ".join(str(error).split()), bad=True))
        page.on_close.append(self._looker.close)
        self._trained = gui.add_folder("Scenes trained on these captures", expand_by_default=False)
        with self._trained:
            self._scenes = (
                gui.add_text(
                    "Of the object", "", hint="A trained scene (.ply, .spz, .sog, ...) in the same frame as its capture"
                ),
                gui.add_text(
                    "Of the place", "", hint="A trained scene (.ply, .spz, .sog, ...) in the same frame as its capture"
                ),
            )
        self._uploads = gui.add_folder("From this computer")
        with self._uploads:
            page.uploads.add("Upload a video or a scene", SUFFIXES, self._uploaded)
        self._start = gui.add_button("Start the project", icon=viser.Icon.PLUS)
        self._facts = gui.add_html("")
        self._looks = {side: gui.add_dropdown(f"Cameras: {side}", tuple(_LOOKS), visible=False) for side, _ in _SIDES}
        self._ups = {side: gui.add_dropdown(f"Up: {side}", tuple(_UPS), visible=False) for side, _ in _SIDES}
        self._other_ups: dict[Side, dict[str, Triple | None]] = {side: {} for side, _ in _SIDES}
        self._back = gui.add_button("Back: choose other captures", icon=viser.Icon.ARROW_LEFT, color="gray")
        self._confirm = gui.add_button("Yes, set this project aside", color="red", visible=False)
        self._again = gui.add_button(
            "Back to the project that was set aside", icon=viser.Icon.ARROW_LEFT, color="gray", visible=False
        )
        self._build = gui.add_button("Reconstruct both scenes", icon=viser.Icon.PLAYER_PLAY)
        for field in (self._source, self._target):
            field.on_update(page.callback(lambda _: self._looker.submit((self._source.value, self._target.value))))
        self._back.on_click(page.callback(lambda _: self._ask_back()))
        self._confirm.on_click(page.callback(lambda _: self._leave_project()))
        self._again.on_click(page.callback(lambda _: page.return_to_project()))
        self._start.on_click(page.callback(lambda _: self._create()))
        for side, _ in _SIDES:
            for control in (self._looks[side], self._ups[side]):
                control.on_update(page.callback(partial(self._set_view, side)))
        self._build.on_click(page.callback(lambda _: page.run("reconstruct", "Reconstruct both scenes")))

    def enter(self) -> None:
        """Show the target, where it is reconstructed."""
        session = self._page.session
        if session is not None and session.files.target_scene.is_file():
            show_target(self._page)

    def leave(self) -> None:
        """Hide the target."""
        hide_target(self._page)

    def refresh(self) -> None:
        """Show the fields of a new project, or the facts of the open one."""
        session, problem = self._page.session, self._page.problem
        self._problem.visible = problem is not None
        self._restore.visible = problem is not None and backup_of(self._page.project.file).has_good()
        if problem is not None:
            self._problem.content = (
                f'<div class="sg-problem" style="font-size:.85em;line-height:1.5;padding:2px 12px">'
                f"<b>This project cannot be opened:</b><br>{html.escape(problem)}<br>"
                f"Correct the file; the page opens it as soon as it is saved.</div>"
            )
        is_new = session is None and problem is None
        controls = (self._help, self._source, self._target, self._trained, self._uploads, self._start)
        for control in (*controls, self._found_source, self._found_target):
            control.visible = is_new
        self._start.disabled = not all(self._is_usable)
        self._again.visible = is_new and backup_of(self._page.project.file).has_aside()
        self._back.visible = session is not None
        self._confirm.visible = self._confirm.visible and session is not None
        self._facts.visible = self._build.visible = session is not None
        for index, (side, _) in enumerate(_SIDES):
            without_photos = session is not None and session.files.without_photos[index]
            self._looks[side].visible = self._ups[side].visible = without_photos
            if session is not None:
                self._show_views(side, session.files.rendered_views[index])
        if session is None:
            return
        lines = [self._line(session, index) for index in range(len(_SIDES))]
        for name, shown in self._page.view.shown.items():
            if shown.count < shown.total:
                lines.append(f"{name}: {shown.count:,} of {shown.total:,} shown; the files contain all")
        self._facts.content = (
            f'<div style="font-size:.85em;line-height:1.6;padding:2px 12px">{"<br>".join(lines)}</div>'
        )
        have_both = session.files.source_scene.is_file() and session.files.target_scene.is_file()
        self._build.label = "Bring both scenes up to date" if have_both else self._title(session)
        self._build.color = "gray" if have_both else None

    def _look(self, paths: tuple[str, str]) -> None:
        """Say what the paths are, before anything is made of them."""
        for index, (path, note) in enumerate(zip(paths, (self._found_source, self._found_target), strict=True)):
            text, usable = "", False
            if path.strip():
                try:
                    text, usable = self._page.project.describe(self._page.parse_path(path))
                except ValueError as error:
                    text = " ".join(str(error).split())
            self._is_usable[index] = usable
            color = "inherit" if usable else "#e8590c"
            note.content = f'<div class="sg-found" style="{_NOTE_STYLE};color:{color}">{html.escape(text)}</div>'
        self._start.disabled = not all(self._is_usable)

    def _ask_back(self) -> None:
        self._confirm.visible = True
        self._page.say(
            "the project and its edits are set aside, and its results stay in the folder: nothing is deleted"
        )

    def _leave_project(self) -> None:
        self._confirm.visible = False
        self._page.leave_project()

    def _line(self, session: Session, index: int) -> str:
        files, name = session.files, _SIDES[index][1]
        scene = (files.source_scene, files.target_scene)[index]
        cameras = (files.source_cameras, files.target_cameras)[index]
        if not scene.is_file():
            return f"<b>{name}</b>: not reconstructed yet"
        count = session.scenes.count(scene)
        if count is None and not self._page.loading.has(session, [scene]):
            return f"<b>{name}</b>: being read"
        text = f"<b>{name}</b>: {count or session.scenes.gaussians(scene).count:,} Gaussians"
        if files.without_photos[index] and cameras.is_file():
            made = session.scenes.cameras(cameras)
            up = ", ".join(f"{round(x, 2) + 0.0:.2f}" for x in estimate_up(made).tolist())
            text += f"; without photographs: {len(made)} images were rendered of it, with ({up}) as up"
        return text

    def _title(self, session: Session) -> str:
        return "Import both scenes" if all(session.files.without_photos) else "Reconstruct both scenes"

    def _show_views(self, side: Side, views: RenderedViews) -> None:
        """Show what project.toml says; an up direction along no axis is an option of its own."""
        self._other_ups[side] = {} if views.up in _UPS.values() else {_name_of(views.up): views.up}
        ups = _UPS | self._other_ups[side]
        if tuple(self._ups[side].options) != tuple(ups):
            self._ups[side].options = tuple(ups)
        self._ups[side].value = next(name for name, up in ups.items() if up == views.up)
        self._looks[side].value = next(name for name, is_within in _LOOKS.items() if is_within == views.is_within)

    def _set_view(self, side: Side, _: viser.GuiEvent) -> None:
        session, ups = self._page.require_session(), _UPS | self._other_ups[side]
        session.set_view(side, RenderedViews(ups[self._ups[side].value], _LOOKS[self._looks[side].value]))
        self._page.run("reconstruct", "Render the scene again")

    def _create(self) -> None:
        source, target = (self._page.parse_path(field.value) for field in (self._source, self._target))
        scenes = [self._page.parse_path(field.value) if field.value.strip() else None for field in self._scenes]
        self._page.project.create((source, target), scenes=(scenes[0], scenes[1]))
        self._page.open_project()
        session = self._page.require_session()
        if all(session.files.without_photos):
            # importing two scenes takes no training, so it starts at once
            self._page.run("reconstruct", self._title(session))
            return
        self._page.say("the project was created; reconstruct both scenes next")

    def _uploaded(self, path: Path) -> None:
        fields = (self._source, self._target, *(self._scenes if path.suffix.lower() in SCENES else ()))
        next((field for field in fields if not field.value), fields[-1]).value = str(path)
        self._looker.submit((self._source.value, self._target.value))
        self._page.say(f"{path.name}: stored as {path}")


def _name_of(up: Triple | None) -> str:
    return "as found" if up is None else f"({', '.join(f'{x:g}' for x in up)})"
