"""Names of the files and folders of a project."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

PROJECT_FILE = "project.toml"
SCENE_FILE = "scene.ply"
OBJECT_FILE = "object.ply"
SURROUNDINGS_FILE = "surroundings.ply"
LIGHT_FILE = "light.json"
LIGHT_TEXT_FILE = "light.txt"
LIGHT_PICTURE = "light.png"
SELECTION_FILE = "selection.npy"
IS_OBJECT_FILE = "is_object.npy"
COVERAGE_FILE = "coverage.png"
IS_GUESSED_FILE = "is_guessed.npy"
CAMERAS_FILE = "transforms.json"
CLOCK_SUN_FILE = "clock_sun.json"
PLACEMENT_FILE = "placement.json"
ERASED_FILE = "erased.npy"
REPORT_FILE = "index.html"
METRICS_FILE = "metrics.json"
EXPORTS_FOLDER = "export"
"""Folder of shared files, below the project's results."""
EDITOR_FOLDER = ".editor"
"""Folder of the editor's own files, below the project's results: history, jobs."""

Side = Literal["source", "target"]
SIDES: tuple[Side, ...] = ("source", "target")


@dataclass(frozen=True)
class Layout:
    """The folders of one project, in the order of the flow."""

    root: Path
    """Root folder of all results, by default the folder of project.toml."""

    def capture(self, side: Side) -> Path:
        """Posed images: transforms.json, points.ply."""
        return self.root / side / "capture"

    def scene(self, side: Side) -> Path:
        """The reconstruction: scene.ply."""
        return self.root / side / "scene"

    @property
    def object(self) -> Path:
        """The object alone, and the indices of its Gaussians in the source."""
        return self.root / "object"

    @property
    def composite(self) -> Path:
        """The object placed in the target, with the light of its capture."""
        return self.root / "composite"

    @property
    def relit(self) -> Path:
        """The composite after the light transfer."""
        return self.root / "relit"

    @property
    def views(self) -> Path:
        """The composite from the target's cameras: the input of a harmoniser."""
        return self.root / "views"

    @property
    def harmonized(self) -> Path:
        """One harmonised image per view."""
        return self.root / "harmonized"

    @property
    def result(self) -> Path:
        """The consolidated scene."""
        return self.root / "result"

    @property
    def report(self) -> Path:
        """Figures and pictures: metrics.json, index.html."""
        return self.root / "report"
