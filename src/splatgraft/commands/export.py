"""The command `export`: a scene or a result as a file for other people and other programs."""

from dataclasses import dataclass, field
from pathlib import Path

from splatgraft.exports.export import ExportOptions, export_scene
from splatgraft.folders.export_source import project_of, read_export_source
from splatgraft.project.layout import PROJECT_FILE
from splatgraft.project.step import Positional
from splatgraft.runtime.console import Console
from splatgraft.workflow.projects import stale_steps


@dataclass(frozen=True)
class Export:
    """Write a scene or a project's result as a page to look at, or in the format of another program."""

    scene: Positional
    """A scene file, a folder with scene.ply, or a project: its folder or project.toml."""
    to: Path
    """The file to write; its suffix names the format: .html (one page with a viewer), .sog, .spz, .compressed.ply,
    .ply, .splat, .glb, .usdz."""
    cameras: Path | None = None
    """The capture that a scene was made from: says which way is up and where to look from. Found in a project."""
    options: ExportOptions = field(default_factory=ExportOptions)

    def execute(self, console: Console) -> int:
        """Read, write, and say what was assumed."""
        source = read_export_source(self.scene, cameras=self.cameras)
        self._say_stale(console)
        for sentence in export_scene(source, self.to, self.options):
            console.say(f"{self.to}: {sentence}")
        console.say(f"{self.to}: {self.to.stat().st_size / 1e6:.1f} MB")
        console.result(self.to)
        return 0

    def _say_stale(self, console: Console) -> None:
        folder = self.scene.parent if self.scene.name == PROJECT_FILE else self.scene
        root = project_of(folder) if folder.is_dir() else None
        if root is None or not (root / PROJECT_FILE).is_file():
            return
        try:
            stale = [name for name in stale_steps(root) if name != "evaluate"]
        except ValueError as error:  # the results are there, whatever became of the photos
            console.warn(f"{root}: expected to know whether the result is up to date, found that {error}")
            return
        if stale:
            console.warn(f"{root}: {', '.join(stale)} is out of date; `splatgraft run {root}` renews what is exported")


COMMAND = Export
