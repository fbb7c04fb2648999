"""The command `adopt`: a scene that was trained elsewhere replaces a reconstruction."""

from dataclasses import dataclass
from pathlib import Path

from splatgraft.capture import misfit_of
from splatgraft.folders.capture_files import has_poses
from splatgraft.formats import read_capture, read_scene, scene_files, write_gaussians
from splatgraft.project.layout import SCENE_FILE
from splatgraft.project.step import Context, Inputs, Positional


@dataclass(frozen=True)
class Adopt:
    """Take over a trained scene; what its file says and what is assumed of it is printed."""

    scene: Positional
    """A .ply, .spz, .splat, .sog, .glb or .ksplat, in the frame of its capture where there is one."""
    out: Path = Path("scene")
    """Folder for scene.ply."""
    capture: Path | None = None
    """Folder of its cameras, which a project makes first; a scene that does not lie where its points are is said to."""
    axes: str | None = None
    """Directions of the file's x, y and z (RDF: right, down, front), where those of its format are wrong."""

    def inputs(self) -> Inputs:
        """The scene."""
        return {"scene": scene_files(self.scene)}

    def write(self, folder: Path, context: Context) -> None:
        """Make scene.ply."""
        found = read_scene(self.scene, axes=self.axes)
        for sentence in found.said():
            context.console.say(f"{self.scene}: {sentence}")
        if self.capture is not None and has_poses(self.capture):
            misfit = misfit_of(found, read_capture(self.capture).points)
            if misfit is not None:
                context.console.say(f"{self.scene}: doubtful: {misfit}")
        write_gaussians(folder / SCENE_FILE, found.gaussians)


COMMAND = Adopt
