"""Virtual cameras for a trained scene that comes without images: its dense part, its up direction, and camera poses.

The dense part is found by trimmed means, up as the normal of the largest plane (RANSAC), the poses on rings around the
dense part or within it (`camera_positions`).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.capture.camera_positions import (
    HALF_FOV,
    LEAST_VIEWS,
    positions_around,
    positions_within,
    unoccluded_poses,
)
from splatgraft.core.cameras import Cameras, pinhole
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.planes import least_squares_normal, sample_planes
from splatgraft.core.spherical_harmonics import rgb_from_dc
from splatgraft.rendering import render
from splatgraft.runtime.progress import Progress, silent


@dataclass(frozen=True)
class SceneOrientationOptions:
    """How dense part and up of a scene are found; lengths over the dense part's radius, values set by hand."""

    least_opacity: float = 0.3
    """Opacity above which a Gaussian counts as solid."""
    largest_scale: float = 20.0
    """Scale over the median one from which a Gaussian counts as backdrop."""
    most_points: int = 20_000
    """Solid Gaussians that are used."""
    least_points: int = 20
    """Solid Gaussians that are needed."""
    trim_rounds: int = 10
    """Means of the nearer half of the points, each around the one before."""
    plane_points: int = 4000
    """Points that planes are fitted to, about the dense part within twice its radius."""
    trials: int = 1000
    """Random planes."""
    thickness: float = 0.02
    """Largest distance of a point that counts as on a plane."""
    aligned_deg: float = 25.0
    """Angle to a customary up direction (y or z of the file) below which a plane is taken for a floor."""
    unaligned_weight: float = 0.6
    """Factor on the points of other planes: walls are as large as floors."""
    least_share: float = 0.1
    """Least share of the points on the plane."""
    side_ratio: float = 3.0
    """Points on one side of the plane over those on the other, above which the first side is up."""
    hollow_share: float = 0.08
    """Share of points within half the radius below which a scene is hollow: a solid ball has 0.06, a table more."""


@dataclass(frozen=True)
class VirtualCameraOptions:
    """Pictures to render of a trained scene that comes without photographs."""

    views: int = 36
    """Of a trained scene: number of pictures to render; fewer where the view is blocked."""
    look: Literal["around", "within"] = "around"
    """Of a trained scene: at its dense part from all around, or outwards from its middle, as in a room."""
    picture_width: int = 640
    """Of these pictures, pixels; their height is three quarters of it."""
    up: tuple[float, float, float] | None = None
    """Of a trained scene: its up direction; found from its largest level surface where not given."""

    def __post_init__(self) -> None:
        """Raises: ValueError where there would be too few views, or up has no length."""
        if self.views < LEAST_VIEWS:
            raise ValueError(f"--views: expected at least {LEAST_VIEWS}, found {self.views}")
        if self.picture_width < 16:
            raise ValueError(f"--picture-width: expected at least 16, found {self.picture_width}")
        if self.up is not None and not math.hypot(*self.up) > 0:
            raise ValueError(f"--up: expected a direction, found {self.up}")


@dataclass(frozen=True)
class VirtualCameras:
    """Cameras placed around or in a scene, and its sparse points."""

    cameras: Cameras
    """Around the dense part, looking at its middle; or within it, looking outwards."""
    points: Float[Tensor, "m 3"]
    """Centres of solid Gaussians, in place of the points of structure from motion."""
    point_colors: Float[Tensor, "m 3"]
    """sRGB in [0, 1]."""
    report: tuple[str, ...]
    """Sentences for the user: what was assumed."""


def place_virtual_cameras(
    scene: Gaussians,
    options: VirtualCameraOptions,
    *,
    stated_up: tuple[float, float, float] | None = None,
    orientation: SceneOrientationOptions = SceneOrientationOptions(),
    progress: Progress = silent,
) -> VirtualCameras:
    """Place rings of cameras around the scene's dense part or within it, without those whose view is blocked.

    Args:
        scene: A trained scene in any frame.
        options: Number, size and kind of the views.
        stated_up: Up direction that the scene's file states; `options.up` goes before it.
        orientation: How dense part and up are found.
        progress: Called after each view.

    Raises:
        ValueError: Where the scene has too few solid Gaussians.
    """
    solid = _solid(scene, orientation)
    centre, radius = dense_part(solid.means, orientation.trim_rounds)
    given = options.up or stated_up
    if given is None:
        up, reason = estimate_scene_up(solid.means, centre, radius, options=orientation)
    else:
        up = torch.nn.functional.normalize(torch.tensor(given), dim=0)
        reason = "as given" if options.up else "as the file's header states; another is named by --up"
    positions = positions_around if options.look == "around" else positions_within
    candidates = positions(centre, radius, up=up, views=options.views)
    poses, dropped = unoccluded_poses(scene, candidates, up=up, progress=progress)
    width = options.picture_width
    focal = 0.5 * width / math.tan(HALF_FOV)
    cameras = pinhole(poses, focal, width=width, height=width * 3 // 4, prefix="look")
    report = [
        f"a scene without photographs: {len(cameras)} pictures are made of it, from {options.look} {_shown(centre)}",
        f"up is taken to be {_shown(up)}{_axis(up, orientation)}: {reason}",
    ]
    if dropped:
        report.append(f"{dropped} of {options.views} views were left out: something stands in their way")
    inner = float(((solid.means - centre).norm(dim=1) < 0.5 * radius).float().mean())
    if options.look == "around" and inner < orientation.hollow_share:
        report.append("it is hollow: where it was seen from within, as a room from its middle, say look = within")
    colors = rgb_from_dc(solid.sh[:, 0]).clamp(0, 1)
    return VirtualCameras(cameras, solid.means, colors, tuple(report))


def render_pictures(
    scene: Gaussians, found: VirtualCameras, *, write: Callable[[str, Tensor], None], progress: Progress = silent
) -> None:
    """Render `scene` from every camera and hand each picture, sRGB, to `write` with the camera's name."""
    for index, camera in enumerate(found.cameras):
        color = render(scene, camera).color
        write(camera.names[0], color[0].clamp(0, 1))
        progress(index + 1, len(found.cameras), "pictures of the scene")


def dense_part(points: Float[Tensor, "m 3"], rounds: int = 10) -> tuple[Float[Tensor, "3"], float]:
    """Centre of the densest half of the points, by iterated trimmed means, and the radius that holds half of them."""
    centre = points.median(0).values
    for _ in range(rounds):
        distance = (points - centre).norm(dim=1)
        centre = points[distance <= distance.median()].mean(0)
    return centre, float((points - centre).norm(dim=1).median())


def estimate_scene_up(
    points: Float[Tensor, "m 3"],
    centre: Float[Tensor, "3"],
    radius: float,
    *,
    options: SceneOrientationOptions = SceneOrientationOptions(),
) -> tuple[Float[Tensor, "3"], str]:
    """Up direction of a scene: the normal of the largest plane in the dense part, on the side with more points.

    The conventions of files decide the sign where the normal is nearly z (+z, since there may be as much below a table
    as on it), and where both sides are alike (-y, as structure from motion leaves it, or +z).

    Args:
        points: Centres of solid Gaussians.
        centre: Of the dense part.
        radius: Of the dense part, world units.
        options: Of the plane.

    Returns:
        A unit vector, and the reason for it, for the user.
    """
    near = points[(points - centre).norm(dim=1) < 2 * radius]
    near = near[:: max(1, len(near) // options.plane_points)]
    normals, on_plane = sample_planes(near, options.trials, seed=0)
    # three points on a line span no plane
    spans = normals.norm(dim=1) > 1e-4 * radius**2
    normals, on_plane = torch.nn.functional.normalize(normals[spans], dim=1), on_plane[spans]
    heights = normals @ near.T - (normals * on_plane).sum(1)[:, None]
    thickness = options.thickness * radius
    aligned = math.cos(math.radians(options.aligned_deg))
    counts = (heights.abs() < thickness).sum(1).float()
    customary = normals[:, 1:].abs().amax(1) > aligned
    best = int((counts * torch.where(customary, 1.0, options.unaligned_weight)).argmax())
    if counts[best] < options.least_share * len(near):
        return torch.tensor([0.0, -1.0, 0.0]), "no level surface was found, and most files have it so"
    inliers = near[heights[best].abs() < thickness]
    middle = inliers.mean(0)
    normal = least_squares_normal(inliers - middle).float()
    height = (near - middle) @ normal
    beside = ((near - centre) - ((near - centre) @ normal)[:, None] * normal).norm(dim=1) < radius
    above = float(((height > 3 * thickness) & (height < radius) & beside).sum())
    below = float(((height < -3 * thickness) & (height > -radius) & beside).sum())
    share = f"the normal of a surface that holds {float(counts[best]) / len(near):.0%} of the dense part"
    if abs(float(normal[2])) < aligned and max(above, below) > options.side_ratio * min(above, below) + 1:
        return normal if above > below else -normal, f"{share}, on whose one side most things stand"
    customary_side = float(normal @ torch.tensor([0.0, -1.0, 1.0])) >= 0
    return normal if customary_side else -normal, f"{share}; which of its sides is a guess by custom"


def _solid(scene: Gaussians, options: SceneOrientationOptions) -> Gaussians:
    """Opaque Gaussians that are not backdrop, at most `options.most_points`, evenly taken."""
    largest = scene.scales.amax(1)
    which = (
        (scene.opacities > options.least_opacity) & (largest < options.largest_scale * largest.median())
    ).nonzero()[:, 0]
    if len(which) < options.least_points:
        least = options.least_points
        raise ValueError(f"scene: expected at least {least} solid Gaussians, found {len(which)} of {scene.count}")
    return scene.select(which[:: math.ceil(len(which) / options.most_points)])


def _axis(up: Float[Tensor, "3"], options: SceneOrientationOptions) -> str:
    """The axis of the file that points up or down, where one does."""
    axis = int(up.abs().argmax())
    if abs(float(up[axis])) < math.cos(math.radians(options.aligned_deg)):
        return ""
    return f", thus {'xyz'[axis]} {'up' if up[axis] > 0 else 'down'}"


def _shown(vector: Float[Tensor, "3"]) -> str:
    return "(" + ", ".join(f"{round(x, 2) + 0.0:.2f}" for x in vector.tolist()) + ")"
