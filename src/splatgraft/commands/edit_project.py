"""A project of the command line as the editor needs it."""

import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from splatgraft.commands.export_job import export_words
from splatgraft.commands.init import Init
from splatgraft.commands.steps.capture import Capture
from splatgraft.commands.steps.compose import Compose
from splatgraft.commands.steps.relight import Relight
from splatgraft.commands.steps.segment import Segment
from splatgraft.editor.session.project_access import Commands, ExportPage, ProjectFiles, RenderedViews
from splatgraft.editor.session.toml_edit import with_keys
from splatgraft.exports.export import Layer
from splatgraft.folders.input_description import describe_input
from splatgraft.formats import is_scene
from splatgraft.project.layout import (
    CAMERAS_FILE,
    EDITOR_FOLDER,
    LIGHT_FILE,
    PLACEMENT_FILE,
    SCENE_FILE,
    SELECTION_FILE,
    SURROUNDINGS_FILE,
    Side,
)
from splatgraft.runtime.console import Console
from splatgraft.runtime.files import atomic_write
from splatgraft.workflow.flow import Flow, read_flow, reasons


@dataclass(frozen=True)
class FlowProject:
    """A project as the editor needs it (`editor.session.project_access.Project`), implemented by the project's flow."""

    file: Path
    """project.toml; it need not exist yet."""
    out: Path | None = None
    """Folder of all results; None: the folder of project.toml."""
    console: Console = field(default_factory=Console)
    """For messages."""

    def files(self) -> ProjectFiles | None:
        """The project's files; None where project.toml does not exist yet.

        Raises:
            ValueError: If project.toml is invalid.
        """
        if not self.file.is_file():
            return None
        flow = read_flow(self.file, self.out)
        layout = flow.layout
        segment, compose, relight = (flow.steps[name] for name in ("segment", "compose", "relight"))
        assert isinstance(segment, Segment)
        assert isinstance(compose, Compose)
        assert isinstance(relight, Relight)
        return ProjectFiles(
            file=self.file,
            root=layout.root,
            source_scene=segment.scene,
            target_scene=compose.target,
            source_cameras=layout.capture("source") / CAMERAS_FILE,
            target_cameras=layout.capture("target") / CAMERAS_FILE,
            target_capture=layout.capture("target"),
            object=compose.object,
            surroundings=layout.object / SURROUNDINGS_FILE,
            selection=layout.object / SELECTION_FILE,
            composite=layout.composite / SCENE_FILE,
            placement=layout.composite / PLACEMENT_FILE,
            relit=layout.relit / SCENE_FILE,
            light=layout.relit / LIGHT_FILE,
            result=layout.result / SCENE_FILE,
            report=layout.report,
            without_photos=(_has_no_photos(flow, "source"), _has_no_photos(flow, "target")),
            rendered_views=(_rendered_views(flow, "source"), _rendered_views(flow, "target")),
            light_mode=relight.light,
            relight_options=relight.options,
            place_options=compose.options,
        )

    def reasons(self) -> Mapping[str, str | None]:
        """For each step why it is stale, as in `status`; one entry with the error where project.toml is invalid."""
        try:
            return reasons(read_flow(self.file, self.out))
        except ValueError as error:
            return {"project": str(error)}

    def describe(self, path: Path) -> tuple[str, bool]:
        """What is at a path, in one line, and whether a project can be made of it; nothing is changed."""
        found = describe_input(path)
        return found.text, found.is_usable

    def create(self, captures: tuple[Path, Path], *, scenes: tuple[Path | None, Path | None]) -> None:
        """Write project.toml.

        Raises:
            ValueError: If a capture or a scene is missing, or project.toml exists.
        """
        for scene in scenes:
            if scene is not None and not scene.is_file():
                raise ValueError(f"{scene}: expected a trained scene, found no such file")
        Init(folder=self.file.parent, source=captures[0], target=captures[1]).execute(self.console)
        text = self.file.read_text(encoding="utf-8")
        for side, scene in zip(("source", "target"), scenes, strict=True):
            if scene is not None:
                text = with_keys(text, side, {"scene": os.path.relpath(scene, self.file.parent)})
        with atomic_write(self.file) as stream:
            stream.write(text.encode())

    def set_view(self, side: Side, views: RenderedViews) -> None:
        """Set how images of a scene without photographs are rendered."""
        keys = {"up": views.up, "look": "within" if views.is_within else None}
        text = with_keys(self.file.read_text(encoding="utf-8"), side, keys)
        with atomic_write(self.file) as stream:
            stream.write(text.encode())

    def run_command(self, to: str, title: str) -> Commands:
        """Commands that run the stale steps up to `to`."""
        root = self._root()
        arguments = (
            str(root / EDITOR_FOLDER),
            title,
            str(self.file),
            to,
            *(() if self.out is None else (str(self.out),)),
        )
        out = () if self.out is None else ("--out", str(self.out))
        command = (sys.executable, "-m", "splatgraft.workflow.background_job", *arguments)
        return command, ("splatgraft", "run", str(self.file), "--to", to, *out)

    def export_command(self, to: Path, *, page: ExportPage, layer: Layer, title: str) -> Commands:
        """Commands that write the result, or a part of it, as a file whose suffix names the format."""
        root = self._root()
        arguments = (str(root / EDITOR_FOLDER), title, str(root), str(to), page, layer)
        command = (sys.executable, "-m", "splatgraft.commands.export_job", *arguments)
        return command, ("splatgraft", *export_words(root, to, page=page, layer=layer))

    def _root(self) -> Path:
        files = self.files()
        return self.file.parent if files is None else files.root


def _has_no_photos(flow: Flow, side: Side) -> bool:
    step = flow.steps[f"{side}/capture"]
    return isinstance(step, Capture) and is_scene(step.capture)


def _rendered_views(flow: Flow, side: Side) -> RenderedViews:
    step = flow.steps[f"{side}/capture"]
    return RenderedViews(step.look.up, step.look.look == "within") if isinstance(step, Capture) else RenderedViews()
