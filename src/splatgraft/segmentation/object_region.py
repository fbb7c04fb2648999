"""The part of space in which an object is looked for: a 3D box above what carries the object, a table or a wall.

The box is guessed around the largest group of surface points near the point where the cameras' optical axes meet (least
squares), or around the groups that a user pointed at.
"""

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import estimate_up, focus_point
from splatgraft.core.planes import LevelPlane, LevelPlaneOptions, dominant_level_plane
from splatgraft.core.posed_images import PosedImages
from splatgraft.segmentation.box import Box


@dataclass(frozen=True)
class RegionOptions:
    """How the region is found; values set by hand."""

    whole_views: float = 0.75
    """Share of the images that show the sphere around the middle whole."""
    far_radius: float = 0.25
    """Radius of that sphere over the median distance of the cameras, where they show none whole."""
    support: LevelPlaneOptions = field(default_factory=lambda: LevelPlaneOptions(thickness=0.03, inlier_share=0.12))
    """Of the plane near the middle: noise of a reconstruction over the distances of a table instead of a room."""
    facing_deg: float = 60.0
    """Largest angle between the normal of a wall and the mean direction to the cameras."""
    cameras_in_front: float = 0.95
    """Least share of the cameras in front of the support."""
    above_support: float = 1.5
    """Least height of a point above the support, over the support's thickness."""
    least_points: int = 20
    """Fewer points give a cube around the middle."""
    cube: float = 0.5
    """Half the edge of that cube, over the sphere's radius."""
    spheres: tuple[float, ...] = (1.0, 1.5, 2.0, 3.0)
    """Radii in which the group is looked for, over that of the sphere, until one holds all of it."""
    rim: float = 0.05
    """Outermost part of a sphere whose points may go on beyond it, over its radius."""
    group_step: float = 0.15
    """Largest distance between neighbours of one group of points, over the sphere's radius."""
    most_points: int = 20_000
    """Points that are grouped; of more, as many are drawn."""
    trim: float = 0.01
    """Share of points beyond either end of the box along each axis."""
    margin: float = 0.2
    """Added at each end, over the longest edge: parts without texture have no points."""
    reach: float = 0.1
    """Largest distance of a Gaussian of the object from the group of points, over the box's longest edge."""
    beyond: float = 1.2
    """Edges of the box that nothing of the object lies beyond, over those of the box."""
    level_normal_z: float = 0.99
    """Least z of the support's normal at which the box ends above the support."""


@dataclass(frozen=True)
class ObjectRegion:
    """A box, without what lies on or below the support."""

    box: Box
    """Contains the object, world units."""
    support: LevelPlane | None
    """The surface that carries the object; None where none is clear."""
    least_height: float
    """Least height above the support of a point of the object, world units."""
    reason: str
    """How the box was found, for messages."""
    is_whole: bool = True
    """False where the surface points that were found go on beyond the box."""
    group: Float[Tensor, "k 3"] | None = None
    """Surface points that belong together and are likely the object's; None where the box says it all."""

    def contains(self, points: Float[Tensor, "n 3"], *, options: RegionOptions = RegionOptions()) -> Bool[Tensor, "n"]:
        """Which points lie in the box, above the support, and near the group: what else is in the box is not it."""
        inside = self.box.contains(points) & points_above(points, self.support, self.least_height)
        if self.group is None:
            return inside
        reach = options.reach * float((self.box.upper - self.box.lower).max())
        apart, _ = KDTree(self.group.cpu().numpy()).query(points.cpu().numpy(), distance_upper_bound=reach)
        return inside & torch.from_numpy(np.isfinite(apart)).to(inside.device)

    def allows(self, points: Float[Tensor, "n 3"], *, options: RegionOptions = RegionOptions()) -> Bool[Tensor, "n"]:
        """Which points may be the object's whatever the pictures say: not behind the support, nor far from the box."""
        inside = points_above(points, self.support, 0.0)
        return inside & self.box.grown(options.beyond).contains(points) if self.is_whole else inside


def default_box(capture: PosedImages) -> Box:
    """A box around the object that a capture goes round, from its cameras and sparse points alone.

    Args:
        capture: Cameras and sparse points; without points the box is a cube where the optical axes meet.

    Raises:
        ValueError: Where the cameras do not look at one place.
    """
    return guess_region(capture.cameras, capture.points).box


def guess_region(
    cameras: Cameras,
    points: Float[Tensor, "m 3"],
    *,
    pointed_at: Float[Tensor, "k 3"] | None = None,
    options: RegionOptions = RegionOptions(),
) -> ObjectRegion:
    """The region of the object that the cameras look at, or that a user pointed at.

    Args:
        cameras: Of the capture.
        points: Surface points, world units; may be empty.
        pointed_at: Points on the object, world units; None where nobody pointed.
        options: Which points count, and the margin.

    Raises:
        ValueError: Where nobody pointed and the cameras do not look at one place.
    """
    middle = focus_point(cameras) if pointed_at is None else pointed_at.median(0).values.to(cameras.centers)
    source = "the cameras look at" if pointed_at is None else "the points name"
    points = _drawn(points.to(middle), options.most_points)
    radius = _visible_radius(cameras, middle, options)
    if pointed_at is not None:
        radius = max(radius, 1.5 * float((pointed_at.to(middle) - middle).norm(dim=1).max()))
    search = _Search(cameras, points, middle, radius, pointed_at, options)
    found = search.group(radius)
    if found.points is not None and found.sphere > radius:
        # the support again, of a sphere as large as the group: a small part of a plane says little of its tilt
        found = search.group(found.sphere)
    support, least_height, kept = found.support, found.least_height, found.points
    if kept is None:
        half = options.cube * radius
        why = f"a cube where {source} one place, as hardly any surface points are known there"
        return ObjectRegion(Box(middle - half, middle + half), support, least_height, why)
    lower, upper = kept.quantile(torch.tensor([options.trim, 1 - options.trim]).to(kept), 0)
    margin = options.margin * (upper - lower).max() + 1e-6
    lower, upper = lower - margin, upper + margin
    if support is not None and float(support.normal[2]) > options.level_normal_z:
        # the support stays outside, also where the box is used without the plane
        lower[2] = torch.maximum(lower[2], torch.as_tensor(support.offset + support.thickness).to(lower))
    why = f"the group of surface points that {source}"
    return ObjectRegion(Box(lower, upper), support, least_height, why, found.is_whole, kept)


def region_of_box(
    cameras: Cameras, points: Float[Tensor, "m 3"], box: Box, *, options: RegionOptions = RegionOptions()
) -> ObjectRegion:
    """The region of a box that a user gave, without the support that it may cut.

    Args:
        cameras: Of the capture.
        points: Surface points, world units.
        box: As given.
        options: What counts as a support.
    """
    middle, radius = (box.lower + box.upper) / 2, 0.75 * float((box.upper - box.lower).norm())
    support = find_support(cameras, _drawn(points, options.most_points), middle, radius=radius, options=options)
    if support is not None:
        heights = support.height(box.corners)
        # a plane in the upper half of the box is the object's own top
        if float(heights.max()) < -float(heights.min()):
            support = None
    least_height = 0.0 if support is None else options.above_support * support.thickness
    return ObjectRegion(box, support, least_height, "the box that was given")


def find_support(
    cameras: Cameras,
    points: Float[Tensor, "m 3"],
    middle: Float[Tensor, "3"],
    *,
    radius: float,
    options: RegionOptions = RegionOptions(),
) -> LevelPlane | None:
    """The largest plane near `middle` on which an object there can stand or hang; None where none is clear.

    A level plane comes first, a table; then one that faces the cameras, a wall. All cameras are in front of it.
    """
    near = points[(points - middle.to(points)).norm(dim=1) < radius]
    towards = torch.nn.functional.normalize((cameras.centers - middle.to(cameras.centers)).mean(0), dim=0)
    facing = replace(options.support, tilt_deg=options.facing_deg)
    for direction, wanted in ((estimate_up(cameras), options.support), (towards, facing)):
        plane = dominant_level_plane(near, direction.to(near), options=wanted)
        if plane is None or float(plane.height(middle)) < -0.5 * radius:
            continue
        if float((plane.height(cameras.centers) > 0).float().mean()) >= options.cameras_in_front:
            return plane
    return None


def _drawn(points: Float[Tensor, "m 3"], most: int) -> Float[Tensor, "k 3"]:
    if len(points) <= most:
        return points
    return points[torch.randperm(len(points), generator=torch.Generator().manual_seed(0))[:most].to(points.device)]


def _visible_radius(cameras: Cameras, middle: Float[Tensor, "3"], options: RegionOptions) -> float:
    """Radius of the largest sphere around `middle` that the share `whole_views` of the images shows whole."""
    local = (cameras.camera_from_world[:, :3, :3] @ middle + cameras.camera_from_world[:, :3, 3])[:, :, None]
    pixel = (cameras.intrinsics @ local)[:, :, 0]
    pixel, depth = pixel[:, :2] / pixel[:, 2:], pixel[:, 2]
    room = torch.minimum(pixel, cameras.sizes.to(pixel) - pixel) / cameras.intrinsics[:, [0, 1], [0, 1]]
    radii = (room.amin(1) * depth)[depth > 0].clamp_min(0)
    radius = float(radii.quantile(1 - options.whole_views)) if len(radii) else 0.0
    least = options.far_radius * float((cameras.centers - middle).norm(dim=1).median())
    return radius if radius > 0.1 * least else least


def points_above(points: Float[Tensor, "*n 3"], support: LevelPlane | None, least_height: float) -> Bool[Tensor, "*n"]:
    """Which points lie more than `least_height`, world units, above the support; all where there is none."""
    if support is None:
        return torch.ones(points.shape[:-1], dtype=torch.bool, device=points.device)
    return support.height(points) > least_height


@dataclass(frozen=True)
class _Group:
    """Surface points that belong together, above their support."""

    points: Float[Tensor, "k 3"] | None
    sphere: float
    is_whole: bool
    support: LevelPlane | None
    least_height: float


@dataclass(frozen=True)
class _Search:
    """What a group is searched with."""

    cameras: Cameras
    points: Float[Tensor, "m 3"]
    middle: Float[Tensor, "3"]
    radius: float
    pointed_at: Float[Tensor, "k 3"] | None
    options: RegionOptions

    def group(self, support_radius: float) -> _Group:
        """The group around the middle, from the smallest sphere that holds all of it."""
        options, middle = self.options, self.middle
        support = find_support(self.cameras, self.points, middle, radius=support_radius, options=options)
        least_height = 0.0 if support is None else options.above_support * support.thickness
        points = self.points[points_above(self.points, support, least_height)]
        pointed_at = None if self.pointed_at is None else self.pointed_at.to(points)
        first = _Group(None, self.radius, False, support, least_height)
        for factor in options.spheres:
            sphere = factor * self.radius
            near = points[(points - middle).norm(dim=1) < sphere]
            if len(near) < options.least_points:
                continue
            chosen = near[_group(near, options.group_step * self.radius, pointed_at, middle)]
            first = replace(first, points=chosen, sphere=sphere) if first.points is None else first
            reaching = (chosen - middle).norm(dim=1) > (1 - options.rim) * sphere
            if float(reaching.float().mean()) < options.trim:
                return _Group(chosen, sphere, True, support, least_height)
        return first


def _group(
    points: Float[Tensor, "m 3"], reach: float, pointed_at: Float[Tensor, "k 3"] | None, middle: Float[Tensor, "3"]
) -> Bool[Tensor, "m"]:
    """The set of points connected by distances below `reach` that counts most near `middle`, or was pointed at."""
    tree = KDTree(points.cpu().numpy())
    pairs = tree.query_pairs(reach, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(points), len(points)))
    _, label = connected_components(graph, directed=False)
    if pointed_at is not None:
        _, nearest = tree.query(pointed_at.cpu().numpy())
        return torch.from_numpy(np.isin(label, label[nearest]))
    distance = (points - middle).norm(dim=1)
    weight = torch.exp(-0.5 * (distance / distance.median()) ** 2).double().cpu().numpy()
    return torch.from_numpy(label == np.bincount(label, weights=weight).argmax())
