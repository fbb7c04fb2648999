"""The axis-aligned 3D box around an object, and a guess of it. Knows nothing about masks or images."""

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
        """The box with its edges `factor` times as long, about the same centre."""
        centre, half = (self.lower + self.upper) / 2, (self.upper - self.lower) / 2 * factor
        return Box(centre - half, centre + half)

    @property
    def corners(self) -> Float[Tensor, "8 3"]:
        """The eight corners."""
        choice = torch.cartesian_prod(*[torch.arange(2)] * 3).bool()
        return torch.where(choice, self.upper, self.lower)


def default_box(capture: PosedImages) -> Box:
    """A guess for cameras that go round one object: around the points near what they look at, above its support.

    The object is taken to fit into most of the pictures, so its radius is at most that of the sphere around the focus
    that does.

    Raises: ValueError where the cameras do not look at one place, or fewer than 20 points are there.
    """
    focus = focus_point(capture.cameras)
    radius = _visible_radius(capture, focus)
    near = capture.points[(capture.points - focus).norm(dim=1) < radius]
    plane = dominant_level_plane(capture.points, estimate_up(capture.cameras))
    if plane is not None:
        near = near[plane.height(near) > 2 * plane.thickness]
    if len(near) < 20:
        raise ValueError(
            f"box: expected at least 20 sparse points where the cameras look, found {len(near)}; name a box"
        )
    kept = near[_largest_group(near, 0.15 * radius)]
    lower, upper = kept.quantile(torch.tensor([0.01, 0.99]).to(kept), 0)
    # ends without texture have no points
    margin = 0.2 * (upper - lower).max()
    lower, upper = lower - margin, upper + margin
    if plane is not None and float(plane.normal[2]) > 0.99:
        # the support itself stays outside: it would be taken for the object's colour
        lower[2] = torch.maximum(lower[2], torch.as_tensor(plane.offset + plane.thickness).to(lower))
    return Box(lower, upper)


def _visible_radius(capture: PosedImages, focus: Float[Tensor, "3"]) -> float:
    """Of the largest sphere around `focus` that three quarters of the pictures show whole."""
    cameras = capture.cameras
    local = (cameras.camera_from_world[:, :3, :3] @ focus + cameras.camera_from_world[:, :3, 3])[:, :, None]
    pixel = (cameras.intrinsics @ local)[:, :, 0]
    pixel, depth = pixel[:, :2] / pixel[:, 2:], pixel[:, 2]
    room = torch.minimum(pixel, cameras.sizes.to(pixel) - pixel) / cameras.intrinsics[:, [0, 1], [0, 1]]
    radii = room.amin(1) * depth
    return float(radii[depth > 0].clamp_min(0).quantile(0.25))


def _largest_group(points: Float[Tensor, "m 3"], reach: float) -> Bool[Tensor, "m"]:
    """The largest set of points connected by steps shorter than `reach`."""
    pairs = KDTree(points.numpy()).query_pairs(reach, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(points), len(points)))
    _, label = connected_components(graph, directed=False)
    return torch.from_numpy(label == np.bincount(label).argmax())
