"""Region of the object in a scene, and the first selection of its Gaussians.

1. A user's points in pictures are moved to the surface by the rendered depth.
2. The region is a 3D box above the support, a table or a wall. It encloses the largest group of surface points near the
   cameras' focus point, or the groups that the user pointed at.
3. If a user pointed at the object, each Gaussian of the region joins the object or the background, to whichever its
   path is shorter. Paths across a change of colour are longer (geodesic segmentation, Bai and Sapiro 2007, here on the
   graph of neighbouring Gaussians).

All constants are set by hand.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import estimate_up, focus_point
from splatgraft.core.directions import tangents
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.planes import LevelPlane, LevelPlaneOptions, dominant_level_plane
from splatgraft.core.posed_images import PosedImages
from splatgraft.core.prompts import ViewPrompt
from splatgraft.core.spherical_harmonics import rgb_from_dc
from splatgraft.rendering import surface_points
from splatgraft.segmentation.selection import SURFACE_OPACITY, Box

_WHOLE_VIEWS = 0.75  # share of the images that show the whole sphere around the middle
_FAR_RADIUS = 0.25  # radius of that sphere over the cameras' median distance, if they show no whole sphere
_SUPPORT = LevelPlaneOptions(thickness=0.03, inlier_share=0.12)  # noise of a reconstruction at a table's scale
_WALL = replace(_SUPPORT, tilt_deg=60.0)  # largest angle between a wall's normal and the mean direction to the cameras
_CAMERAS_IN_FRONT = 0.95  # smallest share of the cameras in front of the support
_ABOVE_SUPPORT = 1.5  # smallest height of the object's points above the support, over the support's thickness
_NEAR_SUPPORT = -3.0  # smallest height allowed if the pictures say object; keeps the foot if the support is too high
_MIN_POINTS = 20  # fewest points of a group; otherwise the region is a cube around the middle
_CUBE = 0.5  # half the edge of that cube, over the sphere's radius
_SPHERES = (1.0, 1.5, 2.0, 3.0)  # search radii over the sphere's, in turn until one contains the whole group
_RIM = 0.05  # width of the outer rim of a search sphere, over its radius; a group that reaches it may continue
_GROUP_STEP = 0.15  # largest distance between neighbours in a group of points, over the sphere's radius
_MAX_POINTS = 20_000  # most points that are grouped; drawn at random from more
_TRIM = 0.01  # share of points outside the box at either end of each axis
_MARGIN = 0.2  # margin at each end, over the longest edge: parts without texture have no points
_REACH = 0.1  # largest distance of the object's Gaussians from the group of points, over the box's longest edge
_BEYOND = 1.2  # factor on the box's edges that contains all of the object
_FOOT = 0.25  # largest height of a foot over the object's; also the part of the object that gives the foot's outline
_FOOT_WIDTH = 1.15  # largest width of a foot over that outline's; a reconstruction's noise widens it
_FOOT_TRIM = 0.05  # share of that end's points outside each side of the polygon: the support's, selected wrongly
_FOOT_SIDES = 24  # sides of the polygon around that outline
_LEVEL_NORMAL_Z = 0.99  # smallest z of the support's normal at which the box ends above the support
_COLOR_STEP = 2.0  # colour difference that doubles a path's length, over the median of neighbours (texture, noise)
_NEIGHBOURS = 10  # nearest Gaussians to which paths lead
_TOUCHED = 6  # Gaussians nearest to a user's point, which certainly belong to its side


@dataclass(frozen=True)
class ObjectRegion:
    """Region of the object: a box, its support, and the object's surface points."""

    box: Box
    """Box around the object, world units."""
    support: LevelPlane | None
    """Surface that carries the object; None if none is clear."""
    reason: str
    """Origin of the box, for messages."""
    is_whole: bool = True
    """Whether the group of surface points ends inside the box."""
    group: Float[Tensor, "k 3"] | None = None
    """Connected surface points that are probably the object's; None if there is only the box."""

    def contains(self, points: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
        """Test which points lie in the box, above the support, and near the group of surface points."""
        inside = self.box.contains(points) & _above(points, self.support, _ABOVE_SUPPORT)
        if self.group is None:
            return inside
        reach = _REACH * float((self.box.upper - self.box.lower).max())
        apart, _ = KDTree(self.group.cpu().numpy()).query(points.cpu().numpy(), distance_upper_bound=reach)
        return inside & torch.from_numpy(np.isfinite(apart)).to(inside.device)

    def allows(self, points: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
        """Test which points the pictures may add to the object: not far below the support, nor far from the box."""
        inside = _above(points, self.support, _NEAR_SUPPORT)
        return inside & self.box.grown(_BEYOND).contains(points) if self.is_whole else inside

    def foot(self, scene: Gaussians, share: Float[Tensor, "n"]) -> Bool[Tensor, "n"]:
        """Select what stands between an object and its support, such as a ring of another colour.

        These are opaque Gaussians above the support, at most a quarter of the object's height, within the horizontal
        outline of the object's lower quarter. A cut by colour may leave them out.

        Args:
            scene: n Gaussians.
            share: Share of each Gaussian in the object, in [0, 1].
        """
        opaque = scene.opacities > SURFACE_OPACITY
        chosen = opaque & (share > 0.5)
        if self.support is None or not bool(chosen.any()):
            return torch.zeros_like(opaque)
        heights = self.support.height(scene.means)
        low, high = heights[chosen].quantile(torch.tensor([_TRIM, 1 - _TRIM]).to(heights)).tolist()
        if low > _FOOT * high:  # the object hangs, or stands on something else
            return torch.zeros_like(opaque)
        is_low = (heights > _ABOVE_SUPPORT * self.support.thickness) & (heights < low + _FOOT * (high - low))
        end = scene.means[chosen & is_low]
        if not len(end):  # a flat object has no foot
            return torch.zeros_like(opaque)
        turns = torch.arange(_FOOT_SIDES).to(heights) * 2 * math.pi / _FOOT_SIDES
        tangent, bitangent = tangents(self.support.normal.to(scene.means))
        sides = turns.cos()[:, None] * tangent + turns.sin()[:, None] * bitangent
        middle = end.median(0).values
        rank = math.ceil((1 - _FOOT_TRIM) * len(end))  # not torch.quantile, which takes 16 million numbers at most
        widths = ((end - middle) @ sides.T).kthvalue(rank, dim=0).values
        within = ((scene.means - middle) @ sides.T < _FOOT_WIDTH * widths).all(1)
        return opaque & within & is_low


def seed_selection(
    scene: Gaussians,
    cameras: Cameras,
    *,
    box: Box | None = None,
    prompts: Mapping[int, ViewPrompt] | None = None,
    known: Bool[Tensor, "n"] | None = None,
) -> tuple[Bool[Tensor, "n"], ObjectRegion]:
    """Select the Gaussians that probably belong to the object, and return them with the region of the search.

    Args:
        scene: n Gaussians.
        cameras: Cameras of the capture, on the device of `scene`.
        box: Box around the object, world units; None estimates it.
        prompts: The user's points and rectangles by index of the camera, pixels of its picture.
        known: Gaussians that the masks of some pictures assign to the object; None without masks.

    Raises:
        ValueError: The region has no solid Gaussian.
    """
    prompts = prompts or {}
    opaque = scene.opacities > SURFACE_OPACITY
    inside, outside = (_points_on_surface(scene, cameras, prompts, which) for which in ("inside", "outside"))
    framed = _framed(scene.means, cameras, prompts)
    if box is not None:
        region = region_of_box(cameras, scene.means[opaque], box)
    else:
        pointed_at = inside if known is None else torch.cat([inside, scene.means[known & opaque]])
        region = guess_region(cameras, scene.means[opaque & framed], pointed_at if len(pointed_at) else None)
    selection = region.contains(scene.means) & framed
    if known is not None:
        selection = selection & known
    if any(len(prompt.inside) for prompt in prompts.values()) and len(inside):
        selection = selection & _nearer_inside(scene, region, inside, outside)
    if not bool((selection & opaque).any()):
        raise ValueError(
            f"object: expected something solid in {region.reason}, found nothing; give its --box, or --prompts with "
            "clicks in two or three pictures"
        )
    return selection, region


def default_box(capture: PosedImages) -> Box:
    """Estimate a box around the object of a capture from cameras and sparse points.

    Without points, the box is a cube around the focus point of the cameras.
    """
    return guess_region(capture.cameras, capture.points).box


def guess_region(
    cameras: Cameras, points: Float[Tensor, "m 3"], pointed_at: Float[Tensor, "k 3"] | None = None
) -> ObjectRegion:
    """Estimate the region of the object that the cameras look at, or that a user pointed at.

    Args:
        cameras: Cameras of the capture.
        points: Surface points, world units.
        pointed_at: Surface points on the object, world units; None takes the cameras' focus point.
    """
    middle = focus_point(cameras) if pointed_at is None else pointed_at.median(0).values.to(cameras.centers)
    source = "the cameras look at" if pointed_at is None else "the points name"
    points = _drawn(points.to(middle))
    radius = _visible_radius(cameras, middle)
    if pointed_at is not None:
        pointed_at = pointed_at.to(middle)
        radius = max(radius, 1.5 * float((pointed_at - middle).norm(dim=1).max()))
    support = _find_support(cameras, points, middle, radius)
    found = _find_group(points, middle, radius, support, pointed_at)
    if found is not None and found[1] > radius:
        # find the support again in a sphere as large as the group: a small part of a plane does not determine its tilt
        support = _find_support(cameras, points, middle, found[1])
        found = _find_group(points, middle, radius, support, pointed_at)
    if found is None:
        half = _CUBE * radius
        why = f"a cube where {source} one place, because hardly any surface points are known there"
        return ObjectRegion(Box(middle - half, middle + half), support, why)
    group, _, is_whole = found
    lower, upper = group.quantile(torch.tensor([_TRIM, 1 - _TRIM]).to(group), 0)
    margin = _MARGIN * (upper - lower).max() + 1e-6
    lower, upper = lower - margin, upper + margin
    if support is not None and float(support.normal[2]) > _LEVEL_NORMAL_Z:
        # the box excludes the support, because it may be used without the plane
        lower[2] = torch.maximum(lower[2], torch.as_tensor(support.offset + support.thickness).to(lower))
    return ObjectRegion(Box(lower, upper), support, f"the group of surface points that {source}", is_whole, group)


def region_of_box(cameras: Cameras, points: Float[Tensor, "m 3"], box: Box) -> ObjectRegion:
    """Return the region of a user's box, with the support that the box may intersect."""
    middle, radius = (box.lower + box.upper) / 2, 0.75 * float((box.upper - box.lower).norm())
    support = _find_support(cameras, _drawn(points), middle, radius)
    if support is not None:
        heights = support.height(box.corners)
        # a plane in the upper half of the box is the object's own top
        if float(heights.max()) < -float(heights.min()):
            support = None
    return ObjectRegion(box, support, "the box that was given")


def _find_support(
    cameras: Cameras, points: Float[Tensor, "m 3"], middle: Float[Tensor, "3"], radius: float
) -> LevelPlane | None:
    """Find the largest plane near `middle` that can carry the object: a level one, else a wall that faces the cameras.

    Nearly all cameras must be in front of the plane. None if no plane is clear.
    """
    near = points[(points - middle.to(points)).norm(dim=1) < radius]
    towards = torch.nn.functional.normalize((cameras.centers - middle.to(cameras.centers)).mean(0), dim=0)
    for direction, wanted in ((estimate_up(cameras), _SUPPORT), (towards, _WALL)):
        plane = dominant_level_plane(near, direction.to(near), options=wanted)
        if plane is None or float(plane.height(middle)) < -0.5 * radius:
            continue
        if float((plane.height(cameras.centers) > 0).float().mean()) >= _CAMERAS_IN_FRONT:
            return plane
    return None


def _drawn(points: Float[Tensor, "m 3"]) -> Float[Tensor, "k 3"]:
    if len(points) <= _MAX_POINTS:
        return points
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))
    return points[order[:_MAX_POINTS].to(points.device)]


def _visible_radius(cameras: Cameras, middle: Float[Tensor, "3"]) -> float:
    """Compute the radius of the largest sphere around `middle` that lies inside most of the images."""
    local = (cameras.camera_from_world[:, :3, :3] @ middle + cameras.camera_from_world[:, :3, 3])[:, :, None]
    pixel = (cameras.intrinsics @ local)[:, :, 0]
    pixel, depth = pixel[:, :2] / pixel[:, 2:], pixel[:, 2]
    room = torch.minimum(pixel, cameras.sizes.to(pixel) - pixel) / cameras.intrinsics[:, [0, 1], [0, 1]]
    radii = (room.amin(1) * depth)[depth > 0].clamp_min(0)
    radius = float(radii.quantile(1 - _WHOLE_VIEWS)) if len(radii) else 0.0
    least = _FAR_RADIUS * float((cameras.centers - middle).norm(dim=1).median())
    return radius if radius > 0.1 * least else least


def _above(points: Float[Tensor, "*n 3"], support: LevelPlane | None, thicknesses: float) -> Bool[Tensor, "*n"]:
    """Test which points are higher above the support than a multiple of its thickness; all without a support."""
    if support is None:
        return torch.ones(points.shape[:-1], dtype=torch.bool, device=points.device)
    return support.height(points) > thicknesses * support.thickness


def _find_group(
    points: Float[Tensor, "m 3"],
    middle: Float[Tensor, "3"],
    radius: float,
    support: LevelPlane | None,
    pointed_at: Float[Tensor, "k 3"] | None,
) -> tuple[Float[Tensor, "p 3"], float, bool] | None:
    """Find the group of points around the middle and above the support.

    The search takes growing spheres until one contains the whole group. If none does, the group is that of the smallest
    sphere.

    Returns:
        The group, the radius of its sphere, and whether the group ends inside it; None if hardly any points are known.
    """
    points, first = points[_above(points, support, _ABOVE_SUPPORT)], None
    for factor in _SPHERES:
        sphere = factor * radius
        near = points[(points - middle).norm(dim=1) < sphere]
        if len(near) < _MIN_POINTS:
            continue
        chosen = near[_connected(near, _GROUP_STEP * radius, pointed_at, middle)]
        first = first or (chosen, sphere, False)
        reaching = (chosen - middle).norm(dim=1) > (1 - _RIM) * sphere
        if float(reaching.float().mean()) < _TRIM:
            return chosen, sphere, True
    return first


def _connected(
    points: Float[Tensor, "m 3"], reach: float, pointed_at: Float[Tensor, "k 3"] | None, middle: Float[Tensor, "3"]
) -> Bool[Tensor, "m"]:
    """Select the connected components that were pointed at, or the one with most weight near `middle`.

    Points closer than `reach` are connected.
    """
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


def _points_on_surface(
    scene: Gaussians, cameras: Cameras, prompts: Mapping[int, ViewPrompt], which: str
) -> Float[Tensor, "k 3"]:
    """Move the user's points `inside` or `outside` to the surface; a rectangle without points gives its centre."""
    found = [torch.zeros(0, 3, device=scene.device)]
    for index, prompt in prompts.items():
        pixels = prompt.inside if which == "inside" else prompt.outside
        if which == "inside" and not len(pixels) and prompt.box is not None:
            left, top, right, bottom = prompt.box
            pixels = torch.tensor([[(left + right) / 2, (top + bottom) / 2]])
        if len(pixels):
            found.append(surface_points(scene, cameras[index], pixels))
    return torch.cat(found)


def _framed(points: Float[Tensor, "n 3"], cameras: Cameras, prompts: Mapping[int, ViewPrompt]) -> Bool[Tensor, "n"]:
    """Test which points lie in the user's rectangle in every picture that has one."""
    inside = torch.ones(len(points), dtype=torch.bool, device=points.device)
    for index, prompt in prompts.items():
        if prompt.box is not None:
            pixels, depth = cameras[index].project(points)
            corners = torch.tensor(prompt.box).to(points)
            inside &= ((pixels >= corners[:2]) & (pixels <= corners[2:])).all(1) & (depth > 0)
    return inside


def _nearer_inside(
    scene: Gaussians, region: ObjectRegion, inside: Float[Tensor, "k 3"], outside: Float[Tensor, "m 3"]
) -> Bool[Tensor, "n"]:
    """Test which Gaussians have a shorter path to the points on the object than to the background.

    The background is the points outside and everything beyond the region.
    """
    around = torch.nonzero(region.box.grown(1.5).contains(scene.means)).flatten()
    near = scene.select(around)
    means = near.means.detach().double().cpu().numpy()
    if len(means) <= _NEIGHBOURS:
        return torch.ones(scene.count, dtype=torch.bool, device=scene.device)
    tree = KDTree(means)
    distance, neighbour = tree.query(means, k=_NEIGHBOURS + 1)
    colors = rgb_from_dc(near.sh[:, 0]).detach().double().cpu().numpy()
    change = np.linalg.norm(colors[:, None] - colors[neighbour], axis=-1)
    step = _COLOR_STEP * max(float(np.median(change[:, 1:])), 1e-3)
    cost = distance * (1 + change / step) + 1e-12
    rows = np.broadcast_to(np.arange(len(means))[:, None], cost.shape)
    graph = coo_array((cost.ravel(), (rows.ravel(), np.asarray(neighbour).ravel())), shape=(len(means),) * 2).tocsr()

    def touched(points: Tensor) -> np.ndarray:
        return np.unique(np.asarray(tree.query(points.reshape(-1, 3).cpu().numpy(), k=_TOUCHED)[1]))

    def path_from(sources: np.ndarray) -> np.ndarray:
        if not len(sources):
            return np.full(len(means), np.inf)
        return dijkstra(graph, directed=False, indices=sources, min_only=True)

    beyond = np.flatnonzero(~region.contains(near.means).cpu().numpy())
    from_object, from_rest = path_from(touched(inside)), path_from(np.union1d(touched(outside), beyond))
    chosen = torch.zeros(scene.count, dtype=torch.bool, device=scene.device)
    nearer = (from_object <= from_rest) & np.isfinite(from_object)
    chosen[around] = torch.from_numpy(nearer).to(scene.device)
    return chosen
