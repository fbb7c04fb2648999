"""TranSplat's irradiance ratio as a step of the benchmark: the object relit, no shadow cast."""

from dataclasses import dataclass
from pathlib import Path

from splatgraft.folders.composite_folder import placement_files, read_composite
from splatgraft.formats import read_cameras, read_gaussians, write_gaussians
from splatgraft.project.layout import SCENE_FILE
from splatgraft.project.step import Context, Inputs
from splatgraft.relighting import SourceScene
from splatgraft.relighting.irradiance_ratio import relight_by_irradiance_ratio


@dataclass(frozen=True)
class RelightByIrradianceRatio:
    """Multiply the object's colours by irradiance at its new place over that at its old one, both from the scenes."""

    target: Path
    """The target scene, a .ply."""
    placement: Path
    """Of the composite."""
    surroundings: Path
    """The source without the object."""
    object_cameras: Path
    """The source's cameras."""
    out: Path
    """Folder for scene.ply."""

    def inputs(self) -> Inputs:
        """All files that are read."""
        scenes = (self.target, self.surroundings)
        return {"scenes": scenes, "placement": placement_files(self.placement), "cameras": (self.object_cameras,)}

    def write(self, folder: Path, context: Context) -> None:
        """Make the relit composite."""
        source = SourceScene(read_gaussians(self.surroundings), read_cameras(self.object_cameras))
        composite = read_composite(self.target, self.placement)
        relit, report = relight_by_irradiance_ratio(composite, sources=[source])
        write_gaussians(folder / SCENE_FILE, relit.bake()[0])
        for sentence in report:
            context.console.say(sentence)
