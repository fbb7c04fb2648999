"""The command `init`: a folder with a commented project.toml."""

import json
from dataclasses import dataclass
from pathlib import Path

from splatgraft.folders.input_description import require_input
from splatgraft.formats import has_known_surface, is_scene
from splatgraft.project.layout import PROJECT_FILE
from splatgraft.project.project_file import TEMPLATE
from splatgraft.project.step import Positional
from splatgraft.project.toml_edit import with_keys
from splatgraft.runtime.console import Console
from splatgraft.runtime.files import atomic_write, relative_name
from splatgraft.workflow.project_reference import full_project_text


@dataclass(frozen=True)
class Init:
    """Write a commented project.toml."""

    folder: Positional
    """The project's folder; made if it does not exist."""
    source: Path
    """The capture with the object: photos (a folder or a .zip), a video, a COLMAP folder or a folder with
    transforms.json; or a trained scene (.ply, .spz, .splat, .sog, .glb, .ksplat) without photographs; or a mesh (.glb,
    .gltf, .obj, .stl, .ply)."""
    target: Path
    """The capture or the scene that receives it."""
    full: bool = False
    """List every key of every table, with type, default and meaning."""

    def execute(self, console: Console) -> int:
        """Write the file; an existing one is never replaced."""
        path = self.folder / PROJECT_FILE
        if path.exists():
            raise ValueError(f"{path}: expected no project here yet, found one")
        text = self.text()
        self.folder.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as stream:
            stream.write(text.encode())
        console.result(path)
        return 0

    def text(self) -> str:
        """Return the content of project.toml; raises ValueError if a capture does not exist."""
        for capture in (self.source, self.target):
            require_input(capture)
        source, target = self.sides()
        if self.full:
            text = full_project_text(source=source, target=target)
        else:
            text = TEMPLATE.replace("{source}", source).replace("{target}", target)
        if has_known_surface(self.target):
            raise ValueError(f"{self.target}: expected a capture or a scene that receives the object, found a mesh")
        if is_scene(self.source) and not has_known_surface(self.source):
            # pictures made of a trained scene have no masks
            text = with_keys(text, "segment", {"mask_source": "grabcut"})
        return text

    def sides(self) -> tuple[str, str]:
        """Return the lines that name the captures of [source] and [target]."""
        return self._key(self.source), self._key(self.target)

    def _key(self, capture: Path) -> str:
        # a JSON string is a TOML string
        return f"{'scene' if is_scene(capture) else 'capture'} = {json.dumps(relative_name(capture, self.folder))}"


COMMAND = Init
