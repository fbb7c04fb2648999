"""The command `adopt`: a scene that was trained elsewhere replaces a reconstruction."""

from dataclasses import dataclass
from pathlib import Path

from splatgraft.formats import read_gaussians, write_gaussians
from splatgraft.project.layout import SCENE_FILE
from splatgraft.project.step import Context, Inputs, Positional


@dataclass(frozen=True)
class Adopt:
    """Take over a trained scene unchanged."""

    scene: Positional
    """A .ply, .spz or .splat, in the frame of its capture where there is one."""
    out: Path = Path("scene")
    """Folder for scene.ply."""
    capture: Path | None = None
    """Folder of its cameras, which a project makes first; it is not read."""

    def inputs(self) -> Inputs:
        """The scene."""
        return {"scene": (self.scene,)}

    def write(self, folder: Path, context: Context) -> None:
        """Make scene.ply."""
        scene = read_gaussians(self.scene)
        write_gaussians(folder / SCENE_FILE, scene)
        context.console.say(f"{self.scene}: {scene.count:,} Gaussians, taken over unchanged")


COMMAND = Adopt
