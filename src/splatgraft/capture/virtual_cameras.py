"""Virtual cameras for a trained scene without images.

1. The centre and radius of the scene's dense part are found by trimmed means.
2. Up is the normal of the largest plane in the dense part (RANSAC).
3. Cameras are placed on rings around the dense part, or within it.
4. Positions with an occluded view are removed by rendering the scene.

All constants are set by hand. Lengths are over the radius of the dense part.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.capture.usable_views import MIN_VIEWS
from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.directions import perpendicular
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.planes import least_squares_normal, sample_planes
from splatgraft.core.posed_images import PosedImages
from splatgraft.core.spherical_harmonics import rgb_from_dc
from splatgraft.rendering import render
from splatgraft.runtime.note import Note
from splatgraft.runtime.progress import Progress, silent

_HALF_FOV = math.radians(30)  # half the horizontal field of view, radians

# solid Gaussians and floor planes
_MIN_OPACITY = 0.3  # smallest opacity of a solid Gaussian
_MAX_SCALE = 20.0  # largest scale of a solid Gaussian, over the median; larger ones are backdrop
_MAX_POINTS, _MIN_POINTS = 20_000, 20  # most solid Gaussians that are used, and fewest
_TRIM_ROUNDS = 10  # each takes the mean of the half of the points nearest to the mean before
_PLANE_POINTS = 4000  # points to which planes are fitted, within twice the dense part's radius
_TRIALS = 1000  # random planes
_THICKNESS = 0.02  # largest distance of a plane's points from it
_ALIGNED_COS = math.cos(math.radians(25.0))  # smallest cosine between a floor's normal and a usual up (y or z axis)
_UNALIGNED_WEIGHT = 0.6  # factor on the points of other planes, because walls are as large as floors
_MIN_SHARE = 0.1  # smallest share of points on the plane
_SIDE_RATIO = 3.0  # ratio of points on the two sides of the plane above which the fuller side is up
_HOLLOW_SHARE = 0.08  # share of points within half the radius below which a scene is hollow; a table has more

# candidate positions and their occlusion
_DISTANCES = (2.4, 1.7, 3.4, 1.2)  # from the centre, in order of preference; at 2.4 the dense part fills the picture
_ELEVATIONS_DEG = (20.0, 42.0)  # elevations of the rings around the dense part
_CLEAR = 1.1  # distance from the centre; anything nearer to the camera occludes the dense part
_CLEAR_AT_EDGES = 0.35  # distance from the camera, over that of the centre; anything nearer occludes the picture
_HEIGHTS = (0.2, 0.6, 0.0)  # heights of cameras within the scene above the centre, in order of preference
_ELEVATIONS_WITHIN_DEG = (0.0, -25.0)  # elevations of views out of the scene
_STEP_BACK = 0.3  # horizontal distance of cameras within the scene behind the centre
_CLEAR_WITHIN, _CLEAR_AT_EDGES_WITHIN = 0.3, 0.15
"""Distances from a camera within the scene; anything nearer occludes the middle of the picture, and the picture."""
_MIN_SEEN_WITHIN = 0.5  # smallest mean opacity of a picture from within
_OCCLUDED = 0.1  # occluded share from which a position is rejected
_MIDDLE_WEIGHT = 0.3  # weight of the occluded share of the middle against that of the whole picture


@dataclass(frozen=True)
class VirtualCameraOptions:
    """Options of the pictures of a trained scene without photographs."""

    views: int = 36
    """Number of pictures to render of a trained scene; occluded views are left out."""
    look: Literal["around", "within"] = "around"
    """Whether a trained scene is seen from around its dense part, or from its middle outwards, as a room is."""
    picture_width: int = 640
    """Width of these pictures, pixels; their height is three quarters of it."""
    up: tuple[float, float, float] | None = None
    """Up direction of a trained scene; by default the normal of its largest level surface."""

    def __post_init__(self) -> None:
        """Raise a ValueError if there are too few views, pictures are too small, or up has no length."""
        if self.views < MIN_VIEWS:
            raise ValueError(f"--views: expected at least {MIN_VIEWS}, found {self.views}")
        if self.picture_width < 16:
            raise ValueError(f"--picture-width: expected at least 16, found {self.picture_width}")
        if self.up is not None and not math.hypot(*self.up) > 0:
            raise ValueError(f"--up: expected a direction, found {self.up}")


@dataclass(frozen=True)
class _Position:
    """A candidate camera position with the limits of its occlusion test."""

    eye: Float[Tensor, "3"]
    target: Float[Tensor, "3"]
    clear: float
    """Depth below which a surface in the middle of the picture occludes it, world units."""
    clear_at_edges: float
    """Depth below which a surface anywhere in the picture occludes it, world units."""
    min_seen: float
    """Smallest mean opacity of the picture, in [0, 1]."""


def place_virtual_cameras(
    scene: Gaussians,
    options: VirtualCameraOptions,
    *,
    stated_up: tuple[float, float, float] | None = None,
    progress: Progress = silent,
) -> tuple[PosedImages, tuple[Note, ...]]:
    """Place rings of cameras around the scene's dense part or within it, and leave out occluded views.

    Args:
        scene: Trained scene.
        options: Number and direction of the views, size of the pictures, up.
        stated_up: Up direction in the scene's file, used if `options` have none.
        progress: Called with views done, views in all and a short text.

    Returns:
        A capture without pictures, with the centres of solid Gaussians as points, and notes on the assumptions.

    Raises:
        ValueError: The scene has fewer than 20 solid Gaussians.
    """
    solid = _solid(scene)
    centre, radius = dense_part(solid.means)
    given = options.up or stated_up
    if given is None:
        up, reason, is_sure = estimate_scene_up(solid.means, centre, radius)
    else:
        up, is_sure = torch.nn.functional.normalize(torch.tensor(given), dim=0), True
        reason = "as given" if options.up else "stated in the file's header; --up overrides it"
    poses, dropped = _unoccluded_poses(scene, _positions(options, centre, radius, up), up, progress)
    width = options.picture_width
    focal = 0.5 * width / math.tan(_HALF_FOV)
    cameras = pinhole(poses, focal, width=width, height=width * 3 // 4, prefix="look")
    axis = int(up.abs().argmax())
    along = f", so {'xyz'[axis]} is {'up' if up[axis] > 0 else 'down'}" if abs(float(up[axis])) >= _ALIGNED_COS else ""
    text = f"the up direction is {_shown(up)}{along}: {reason}"
    upside_down = f"If the scene is upside down or on its side, set up (up = [{_numbers(-up)}] turns it over)"
    report = [
        Note(
            f"the scene has no photographs: {len(cameras)} pictures are rendered from {options.look} {_shown(centre)}"
        ),
        Note(text) if is_sure else Note(f"{text}. The picture shows this orientation.", "warning", upside_down),
    ]
    if dropped:
        report.append(Note(f"{dropped} of {options.views} views were left out because something occludes them"))
    inner = float(((solid.means - centre).norm(dim=1) < 0.5 * radius).float().mean())
    if options.look == "around" and inner < _HOLLOW_SHARE:
        remedy = "If it is a room or another place captured from within, set look = within"
        report.append(Note("the scene is hollow: pictures from outside may show walls from behind.", "warning", remedy))
    colors = rgb_from_dc(solid.sh[:, 0]).clamp(0, 1)
    return PosedImages((), cameras, solid.means, colors), tuple(report)


def _solid(scene: Gaussians) -> Gaussians:
    """Select opaque Gaussians that are not backdrop; of many, at most `_MAX_POINTS`, evenly spaced in their order."""
    largest = scene.scales.amax(1)
    which = ((scene.opacities > _MIN_OPACITY) & (largest < _MAX_SCALE * largest.median())).nonzero()[:, 0]
    if len(which) < _MIN_POINTS:
        raise ValueError(f"scene: expected at least {_MIN_POINTS} solid Gaussians, found {len(which)} of {scene.count}")
    return scene.select(which[:: math.ceil(len(which) / _MAX_POINTS)])


def dense_part(points: Float[Tensor, "m 3"]) -> tuple[Float[Tensor, "3"], float]:
    """Compute the centre of the densest half of the points by iterated trimmed means, and the radius of that half."""
    centre = points.median(0).values
    for _ in range(_TRIM_ROUNDS):
        distance = (points - centre).norm(dim=1)
        centre = points[distance <= distance.median()].mean(0)
    return centre, float((points - centre).norm(dim=1).median())


def estimate_scene_up(
    points: Float[Tensor, "m 3"], centre: Float[Tensor, "3"], radius: float
) -> tuple[Float[Tensor, "3"], str, bool]:
    """Estimate the up direction of a scene: the normal of the largest plane in the dense part.

    Up points to the side with more points. In two cases, file conventions give the sign. If the normal is nearly z, up
    is +z, because a table may have as many points below as on it. If both sides have similar numbers of points, up is
    +z or, as in structure from motion, -y.

    Returns:
        Unit up direction, its reason for messages, and whether the scene itself decided the sign.
    """
    near = points[(points - centre).norm(dim=1) < 2 * radius]
    near = near[:: max(1, len(near) // _PLANE_POINTS)]
    normals, on_plane = sample_planes(near, _TRIALS, seed=0)
    # three points on a line define no plane
    spans = normals.norm(dim=1) > 1e-4 * radius**2
    normals, on_plane = torch.nn.functional.normalize(normals[spans], dim=1), on_plane[spans]
    heights = normals @ near.T - (normals * on_plane).sum(1)[:, None]
    thickness = _THICKNESS * radius
    counts = (heights.abs() < thickness).sum(1).float()
    customary = normals[:, 1:].abs().amax(1) > _ALIGNED_COS
    best = int((counts * torch.where(customary, 1.0, _UNALIGNED_WEIGHT)).argmax())
    if counts[best] < _MIN_SHARE * len(near):
        return torch.tensor([0.0, -1.0, 0.0]), "no level surface was found, and most files have this up", False
    inliers = near[heights[best].abs() < thickness]
    middle = inliers.mean(0)
    normal = least_squares_normal(inliers - middle).float()
    height = (near - middle) @ normal
    beside = ((near - centre) - ((near - centre) @ normal)[:, None] * normal).norm(dim=1) < radius
    above = float(((height > 3 * thickness) & (height < radius) & beside).sum())
    below = float(((height < -3 * thickness) & (height > -radius) & beside).sum())
    share = f"the normal of a surface that holds {float(counts[best]) / len(near):.0%} of the dense part"
    if abs(float(normal[2])) < _ALIGNED_COS and max(above, below) > _SIDE_RATIO * min(above, below) + 1:
        return normal if above > below else -normal, f"{share}, on the side with most Gaussians", True
    usual_side = float(normal @ torch.tensor([0.0, -1.0, 1.0])) >= 0
    return normal if usual_side else -normal, f"{share}; its side is a guess by the conventions of files", False


def _positions(
    options: VirtualCameraOptions, centre: Float[Tensor, "3"], radius: float, up: Float[Tensor, "3"]
) -> list[list[_Position]]:
    """List the candidate positions of each view, in order of preference.

    Around the scene, they lie along one direction from the centre and look at it. Within the scene, they lie near the
    centre at several heights and look outwards.
    """
    out: list[list[_Position]] = []
    around = options.look == "around"
    for direction in _directions(options.views, up, _ELEVATIONS_DEG if around else _ELEVATIONS_WITHIN_DEG):
        if around:
            distances = [k * radius for k in _DISTANCES]
            clear = [(d - _CLEAR * radius, _CLEAR_AT_EDGES * d) for d in distances]
            out.append(
                [_Position(centre + d * direction, centre, *c, 0.0) for d, c in zip(distances, clear, strict=True)]
            )
            continue
        flat = torch.nn.functional.normalize(direction - (direction @ up) * up, dim=0)
        eyes = [centre - _STEP_BACK * radius * flat + k * radius * up for k in _HEIGHTS]
        clear, edges = _CLEAR_WITHIN * radius, _CLEAR_AT_EDGES_WITHIN * radius
        out.append([_Position(eye, eye + direction, clear, edges, _MIN_SEEN_WITHIN) for eye in eyes])
    return out


def _unoccluded_poses(
    scene: Gaussians, views: Sequence[Sequence[_Position]], up: Float[Tensor, "3"], progress: Progress
) -> tuple[Float[Tensor, "v 4 4"], int]:
    """Choose the first position of each view that is not occluded, by rendering the scene at 48 x 36 pixels.

    If fewer than `MIN_VIEWS` views have one, the least occluded of the others are added.

    Returns:
        Poses, and the number of views without a free position.
    """
    chosen: list[Tensor] = []
    rejected: list[tuple[float, Tensor]] = []
    for index, positions in enumerate(views):
        tried = [_pose_and_occlusion(scene, position, up) for position in positions]
        free = [pose for pose, occluded in tried if occluded < _OCCLUDED]
        if free:
            chosen.append(free[0])
        else:
            rejected.append(min(((occluded, pose) for pose, occluded in tried), key=lambda pair: pair[0]))
        progress(index + 1, len(views), "placing virtual cameras")
    missing = max(0, MIN_VIEWS - len(chosen))
    chosen += [pose for _, pose in sorted(rejected, key=lambda pair: pair[0])[:missing]]
    return torch.stack(chosen), len(rejected)


def _pose_and_occlusion(
    scene: Gaussians, position: _Position, up: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "4 4"], float]:
    """Compute the pose at a position and the occluded share of its picture."""
    pose = look_at(position.eye[None], position.target, up)
    small = pinhole(pose, 24 / math.tan(_HALF_FOV), width=48, height=36)
    rendered = render(scene, small, outputs=frozenset({"depth"}))
    alpha = rendered.alpha[0]
    depth = torch.where(rendered.depth[0] > 0, rendered.depth[0], torch.inf)
    close = float((alpha * (depth < position.clear_at_edges)).mean())
    hidden = float((alpha * (depth < position.clear))[12:24, 16:32].mean())
    unseen = 1.0 if float(alpha.mean()) < position.min_seen else 0.0
    return pose[0], max(close, _MIDDLE_WEIGHT * hidden, unseen)


def _directions(views: int, up: Float[Tensor, "3"], elevations_deg: tuple[float, ...]) -> Float[Tensor, "v 3"]:
    """Compute unit directions from the centre, evenly spaced in azimuth, with alternating elevations."""
    x = -perpendicular(up)
    y = torch.linalg.cross(up, x)
    index = torch.arange(views)
    azimuth = 2 * math.pi * index / views
    elevation = torch.deg2rad(torch.tensor(elevations_deg))[index % len(elevations_deg)]
    flat = azimuth.cos()[:, None] * x + azimuth.sin()[:, None] * y
    return elevation.cos()[:, None] * flat + elevation.sin()[:, None] * up


def _shown(vector: Float[Tensor, "3"]) -> str:
    return "(" + _numbers(vector) + ")"


def _numbers(vector: Float[Tensor, "3"]) -> str:
    return ", ".join(f"{round(x, 2) + 0.0:.2f}" for x in vector.tolist())
