"""The axis-aligned 3D box around an object, and a default from the sparse points near the cameras' focus point."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.core.capture_orientation import estimate_up, focus_point
from splatgraft.core.planes import dominant_level_plane
from splatgraft.core.posed_images import PosedImages


@dataclass(frozen=True)
class Box:
    """All points between two corners."""

    lower: Float[Tensor, "3"]
    """Least x, y, z, world units."""
    upper: Float[Tensor, "3"]
    """Greatest x, y, z, world units."""

    def __post_init__(self) -> None:
        """Raises: ValueError where the corners are not in order."""
        if not bool((self.lower < self.upper).all()):
            raise ValueError(f"box: expected lower < upper, found {self.lower.tolist()} and {self.upper.tolist()}")

    def contains(self, points: Float[Tensor, "*n 3"]) -> Bool[Tensor, "*n"]:
        """Which points lie inside."""
        return ((points >= self.lower.to(points)) & (points <= self.upper.to(points))).all(-1)

    def grown(self, factor: float) -> "Box":
        """The box with edges `factor` times as long and the same centre."""
        centre, half = (self.lower + self.upper) / 2, (self.upper - self.lower) / 2 * factor
        return Box(centre - half, centre + half)

    @property
    def corners(self) -> Float[Tensor, "8 3"]:
        """The eight corners."""
        choice = torch.cartesian_prod(*[torch.arange(2)] * 3).bool()
        return torch.where(choice, self.upper, self.lower)


@dataclass(frozen=True)
class DefaultBoxOptions:
    """How the default box is found; values set by hand."""

    whole_views: float = 0.75
    """Share of the images that show the sphere around the focus point whole."""
    above_plane: float = 2.0
    """Least height of a point above the support, over the support's thickness."""
    least_points: int = 20
    """Fewer points give no box."""
    group_step: float = 0.15
    """Largest distance between neighbours of one group of points, over the sphere's radius."""
    trim: float = 0.01
    """Share of points beyond either end of the box along each axis."""
    margin: float = 0.2
    """Added at each end, over the longest edge: parts without texture have no points."""
    level_normal_z: float = 0.99
    """Least z of the support's normal at which the box ends above the support."""


def default_box(capture: PosedImages, *, options: DefaultBoxOptions = DefaultBoxOptions()) -> Box:
    """A box around the largest group of sparse points near the cameras' focus point, above its support plane.

    The capture is taken to go round one object that fits into most of its images.

    Args:
        capture: Cameras and sparse points.
        options: Which points count, and the margin.

    Raises:
        ValueError: Where the cameras do not look at one place, or too few points are there.
    """
    focus = focus_point(capture.cameras)
    radius = _visible_radius(capture, focus, options.whole_views)
    near = capture.points[(capture.points - focus).norm(dim=1) < radius]
    plane = dominant_level_plane(capture.points, estimate_up(capture.cameras))
    if plane is not None:
        near = near[plane.height(near) > options.above_plane * plane.thickness]
    if len(near) < options.least_points:
        raise ValueError(
            f"box: expected at least {options.least_points} sparse points where the cameras look, found {len(near)}; "
            "name a box"
        )
    kept = near[_largest_group(near, options.group_step * radius)]
    lower, upper = kept.quantile(torch.tensor([options.trim, 1 - options.trim]).to(kept), 0)
    margin = options.margin * (upper - lower).max()
    lower, upper = lower - margin, upper + margin
    if plane is not None and float(plane.normal[2]) > options.level_normal_z:
        # the support stays outside: GrabCut would learn its colour as the object's
        lower[2] = torch.maximum(lower[2], torch.as_tensor(plane.offset + plane.thickness).to(lower))
    return Box(lower, upper)


def _visible_radius(capture: PosedImages, focus: Float[Tensor, "3"], whole_views: float) -> float:
    """Radius of the largest sphere around `focus` that the share `whole_views` of the images shows whole."""
    cameras = capture.cameras
    local = (cameras.camera_from_world[:, :3, :3] @ focus + cameras.camera_from_world[:, :3, 3])[:, :, None]
    pixel = (cameras.intrinsics @ local)[:, :, 0]
    pixel, depth = pixel[:, :2] / pixel[:, 2:], pixel[:, 2]
    room = torch.minimum(pixel, cameras.sizes.to(pixel) - pixel) / cameras.intrinsics[:, [0, 1], [0, 1]]
    radii = room.amin(1) * depth
    return float(radii[depth > 0].clamp_min(0).quantile(1 - whole_views))


def _largest_group(points: Float[Tensor, "m 3"], reach: float) -> Bool[Tensor, "m"]:
    """The largest set of points connected by distances below `reach`."""
    pairs = KDTree(points.numpy()).query_pairs(reach, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(points), len(points)))
    _, label = connected_components(graph, directed=False)
    return torch.from_numpy(label == np.bincount(label).argmax())
