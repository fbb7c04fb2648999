"""The command `export`: a scene or a result as a file for other people and other programs."""

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from splatgraft.commands.light import LightAt
from splatgraft.exports.export import ExportOptions, export_scene
from splatgraft.exports.pages import write_report_file
from splatgraft.folders.export_source import project_of, read_export_source
from splatgraft.project.layout import PROJECT_FILE, REPORT_FILE, Layout
from splatgraft.project.step import Positional
from splatgraft.runtime.console import Console
from splatgraft.runtime.files import room_on_disk
from splatgraft.runtime.note import Note
from splatgraft.workflow.run import stale_steps


@dataclass(frozen=True)
class Export:
    """Write a scene or a project's result as a page to look at, or in the format of another program."""

    scene: Positional
    """A scene file, a folder with scene.ply, or a project: its folder or project.toml."""
    to: Path
    """The file to write; its suffix names the format: .html (one page with a viewer), .sog, .spz, .compressed.ply,
    .ply, .splat, .glb; .png or .jpg (the page's first view); .mp4, .gif or .webp (a turntable)."""
    page: Literal["viewer", "report"] = "viewer"
    """Content of an .html: the scene with a viewer, or the project's report with all its pictures."""
    cameras: Path | None = None
    """The capture that a scene was made from; gives the up direction and the first view. Found in a project."""
    title: str | None = None
    """Title of the page; the name of the scene's file or folder if not given."""
    options: ExportOptions = field(default_factory=ExportOptions)

    @property
    def folder(self) -> Path:
        """The scene's folder or file; the project's folder if its project.toml was given."""
        return self.scene.parent if self.scene.name == PROJECT_FILE else self.scene

    def execute(self, console: Console) -> int:
        """Write the file and print the assumptions, its size and the time; with the layer scene-with-shadow also the
        light at the object."""
        self._say_stale(console)
        for sentence in self.write(console):
            console.say(sentence)
        if self.options.layer == "scene-with-shadow" and (self.folder / PROJECT_FILE).is_file():
            in_world = self.options.frame == "world" or (self.options.frame == "auto" and self.to.suffix == ".glb")
            light = self.to.with_name(f"{self.to.stem}_light.hdr")
            LightAt(self.folder, out=light, frame="world" if in_world else "capture").execute(console)
        console.result(self.to)
        return 0

    def write(self, console: Console) -> tuple[str, ...]:
        """Write the file with a progress bar; returns sentences with the assumptions, size and seconds."""
        began, said = time.monotonic(), ()
        if self.page == "report":
            write_report_file(self.to, self._report())
        else:
            source = read_export_source(self.scene, cameras=self.cameras)
            source = source if self.title is None else replace(source, title=self.title)
            with console.bar("export") as progress, room_on_disk(self.to):
                said = export_scene(source, self.to, self.options, progress=progress)
        size, seconds = self.to.stat().st_size / 1e6, time.monotonic() - began
        return (*(f"{self.to}: {sentence}" for sentence in said), f"{self.to}: {size:.1f} MB in {seconds:.1f} s")

    def _report(self) -> Path:
        """Return the report's page, for a project or for its folder report."""
        if self.to.suffix.lower() != ".html":
            raise ValueError(f"--page report: expected a file that ends in .html, found {self.to.name}")
        own = self.folder / REPORT_FILE
        return own if own.is_file() else Layout(self.folder).report / REPORT_FILE

    def _say_stale(self, console: Console) -> None:
        root = project_of(self.folder) if self.folder.is_dir() else None
        if root is None or not (root / PROJECT_FILE).is_file():
            return
        try:
            stale = [name for name in stale_steps(root) if self.page == "report" or name != "evaluate"]
        except ValueError as error:  # results can be exported even if the photos are gone
            console.tell(
                Note(f"{root}: the result may be out of date, because an input cannot be read: {error}", "warning")
            )
            return
        if stale:
            console.tell(
                Note(
                    f"{root}: {', '.join(stale)} is out of date; `splatgraft run {root}` renews what is exported",
                    "warning",
                )
            )


COMMAND = Export
