"""Open: two captures become a project; scenes are reconstructed. Knows nothing about how."""

from __future__ import annotations

import html
from pathlib import Path
from typing import TYPE_CHECKING

import viser

from splatgraft.editor.uploads import SCENES, SUFFIXES, keep_upload

if TYPE_CHECKING:
    from splatgraft.editor.page.page import Page

_HELP = "A capture is a folder of photos, a video, a COLMAP folder, or a folder with a `transforms.json`."


class OpenPhase:
    """The controls of the first step."""

    def __init__(self, page: Page) -> None:
        """Build them."""
        self._page, gui = page, page.gui
        self._help = gui.add_markdown(_HELP)
        self._source = gui.add_text("Object from", "", hint="The capture with the object: a path")
        self._target = gui.add_text("Place into", "", hint="The capture that receives it: a path")
        self._trained = gui.add_folder("Scenes that are trained already", expand_by_default=False)
        with self._trained:
            self._scenes = (
                gui.add_text("Of the first", "", hint="A .ply, .spz or .splat in the same frame as its capture"),
                gui.add_text("Of the second", "", hint="A .ply, .spz or .splat in the same frame as its capture"),
            )
        self._upload = gui.add_upload_button("Upload a video or a scene", icon=viser.Icon.UPLOAD, color="gray")
        self._start = gui.add_button("Start the project", icon=viser.Icon.PLUS)
        self._facts = gui.add_html("")
        self._build = gui.add_button("Reconstruct both scenes", icon=viser.Icon.PLAYER_PLAY)
        self._start.on_click(page.act(lambda _: self._create()))
        self._upload.on_upload(page.act(self._uploaded))
        self._build.on_click(page.act(lambda _: page.run("reconstruct", "Reconstruct both scenes")))

    def enter(self) -> None:
        """Show what is there of the target."""
        session = self._page.session
        if session is not None and session.files.target_scene.is_file():
            self._page.view.splats("/target/scene", session.scenes.gaussians(session.files.target_scene))

    def leave(self) -> None:
        """Hide it."""
        self._page.view.hide("/target/scene")

    def refresh(self) -> None:
        """Fields before there is a project, facts after."""
        session = self._page.session
        for control in (self._help, self._source, self._target, self._trained, self._upload, self._start):
            control.visible = session is None
        self._facts.visible = self._build.visible = session is not None
        if session is None:
            return
        lines = []
        for side, scene in (("Object from", session.files.source_scene), ("Place into", session.files.target_scene)):
            state = (
                f"{session.scenes.gaussians(scene).count:,} Gaussians" if scene.is_file() else "not reconstructed yet"
            )
            lines.append(f"<b>{side}</b>: {html.escape(state)}")
        for name, shown in self._page.view.shown.items():
            if shown.count < shown.total:
                lines.append(f"{name}: {shown.count:,} of {shown.total:,} shown; files keep all")
        self._facts.content = (
            f'<div style="font-size:.85em;line-height:1.6;padding:2px 12px">{"<br>".join(lines)}</div>'
        )
        both = session.files.source_scene.is_file() and session.files.target_scene.is_file()
        self._build.label = "Reconstruct again what is stale" if both else "Reconstruct both scenes"
        self._build.color = "gray" if both else None

    def _create(self) -> None:
        source, target = (self._page.allowed(field.value) for field in (self._source, self._target))
        scenes = [self._page.allowed(field.value) if field.value.strip() else None for field in self._scenes]
        self._page.project.create((source, target), scenes=(scenes[0], scenes[1]))
        self._page.open_project()
        self._page.say("the project is there; reconstruct both scenes next")

    def _uploaded(self, event: viser.GuiEvent) -> None:
        file = event.target.value
        path = keep_upload(self._page.project.file.parent, file.name, file.content, suffixes=SUFFIXES)
        fields = self._scenes if path.suffix.lower() in SCENES else (self._source, self._target)
        next((field for field in fields if not field.value), fields[-1]).value = str(path)
        self._page.say(f"{Path(file.name).name}: kept as {path}")
