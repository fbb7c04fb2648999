"""The command `adopt`: a scene that was trained elsewhere replaces a reconstruction.

If there is a capture, the scene is compared with the capture's points, in its own axes and in others.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.core.mesh_sampling import DEFAULT_BUDGET
from splatgraft.folders.capture_files import has_poses
from splatgraft.formats import SceneFile, read_capture, read_scene, scene_files, write_gaussians
from splatgraft.formats.scenes.axes import rdf_from
from splatgraft.project.layout import SCENE_FILE
from splatgraft.project.step import Context, Inputs, Positional

_MAX_DISTANCE = 0.1  # median distance from point to Gaussian, over the points' radius; about 0.01 with the right poses
_BETTER = 0.3  # factor on that distance below which other axes are suggested; set by hand
_MAX_POINTS, _MIN_POINTS = 2000, 20  # compared points; fewer than the minimum are not compared
_AXES = ("RDF", "RUB", "LUF", "RFU")  # suggested axes: structure from motion, OpenGL, glTF, z up


@dataclass(frozen=True)
class Adopt:
    """Take over a trained scene; prints the statements of its file and the assumptions about it."""

    scene: Positional
    """A .ply, .spz, .splat, .sog, .glb or .ksplat, in the frame of its capture if there is one; or a mesh: .glb, .gltf,
    .obj, .stl or .ply."""
    out: Path = Path("scene")
    """Folder for scene.ply."""
    capture: Path | None = None
    """Capture folder of the scene, which a project makes first; warns if the scene and its points do not overlap."""
    axes: str | None = None
    """Directions of the file's x, y and z (RDF: right, down, front), if those of its format are wrong."""
    mesh_budget: int = DEFAULT_BUDGET
    """Maximum number of Gaussians that cover a mesh."""

    def inputs(self) -> Inputs:
        """Return the scene's files."""
        return {"scene": scene_files(self.scene)}

    def write(self, folder: Path, context: Context) -> None:
        """Write scene.ply."""
        found = read_scene(self.scene, axes=self.axes, mesh_budget=self.mesh_budget)
        for sentence in found.said():
            context.console.say(f"{self.scene}: {sentence}")
        if self.capture is not None and has_poses(self.capture):
            misfit = misfit_of(found, read_capture(self.capture).points)
            if misfit is not None:
                context.console.say(f"{self.scene}: doubtful: {misfit}")
        write_gaussians(folder / SCENE_FILE, found.gaussians)


def misfit_of(scene: SceneFile, points: Float[Tensor, "m 3"]) -> str | None:
    """Describe why `scene` does not overlap its capture's points, with axes in which it would; None if it does."""
    means = scene.gaussians.means
    means = means[means.isfinite().all(1)]
    points = points[:: max(1, len(points) // _MAX_POINTS)]
    if min(len(points), len(means)) < _MIN_POINTS:
        return None
    tree = KDTree(means.double().numpy())
    radius = float((points - points.median(0).values).norm(dim=1).median())

    def distance(axes: str) -> float:
        # turning the points back is the same as turning the scene
        matrix = rdf_from(axes) @ rdf_from(scene.axes).T
        near = np.asarray(tree.query((points @ matrix).double().numpy())[0])
        return float(np.median(near)) / max(radius, 1e-9)

    here = distance(scene.axes)
    if here <= _MAX_DISTANCE:
        return None
    said = (
        f"half of its capture's points lie more than {here:.2f} times their radius from the nearest Gaussian, "
        f"while scenes trained with these poses have about 0.01"
    )
    others = {axes: distance(axes) for axes in _AXES if axes != scene.axes}
    best = min(others, key=lambda axes: others[axes])
    if others[best] < _BETTER * here and others[best] <= _MAX_DISTANCE:
        return f'{said}; with --axes {best} it would be {others[best]:.2f}: set axes = "{best}"'
    return f"{said}; give the poses that it was trained with: nerfstudio exports scenes in another frame than its poses"


COMMAND = Adopt
