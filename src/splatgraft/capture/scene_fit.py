"""Whether a trained scene lies where the points of its capture are, and in which other axes it would."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.formats import SceneFile
from splatgraft.formats.scenes.axes import rdf_from


@dataclass(frozen=True)
class SceneFitOptions:
    """When a scene does not fit its capture; values set by hand."""

    largest_distance: float = 0.1
    """Median distance from a point to the nearest Gaussian, over the points' radius, up to which they fit: scenes that
    were trained with these poses have about 0.01."""
    better: float = 0.3
    """Factor on that distance below which other axes are named."""
    most_points: int = 2000
    """Points that are compared."""
    least_points: int = 20
    """Points below which nothing is said."""
    axes: tuple[str, ...] = ("RDF", "RUB", "LUF", "RFU")
    """Axes that are tried: structure from motion, OpenGL, glTF, z up."""


def misfit_of(
    scene: SceneFile, points: Float[Tensor, "m 3"], *, options: SceneFitOptions = SceneFitOptions()
) -> str | None:
    """One sentence where `scene` does not lie at `points`, with the axes in which it would; None where it does.

    Args:
        scene: As read.
        points: Of its capture, in the same frame if they belong together.
        options: When they do not.
    """
    means = scene.gaussians.means
    means = means[means.isfinite().all(1)]
    points = points[:: max(1, len(points) // options.most_points)]
    if min(len(points), len(means)) < options.least_points:
        return None
    tree = KDTree(means.double().numpy())
    radius = float((points - points.median(0).values).norm(dim=1).median())

    def distance(axes: str) -> float:
        # turning the points back is the same as turning the scene
        matrix = rdf_from(axes) @ rdf_from(scene.axes).T
        near = np.asarray(tree.query((points @ matrix).double().numpy())[0])
        return float(np.median(near)) / max(radius, 1e-9)

    here = distance(scene.axes)
    if here <= options.largest_distance:
        return None
    said = (
        f"half of its capture's points lie more than {here:.2f} times their radius from the nearest Gaussian, "
        f"where scenes of these poses have about 0.01"
    )
    others = {axes: distance(axes) for axes in options.axes if axes != scene.axes}
    best = min(others, key=lambda axes: others[axes])
    if others[best] < options.better * here and others[best] <= options.largest_distance:
        return f'{said}; with --axes {best} it would be {others[best]:.2f}: set axes = "{best}"'
    return f"{said}; give the poses that it was trained with, as nerfstudio's export is in another frame than its poses"
