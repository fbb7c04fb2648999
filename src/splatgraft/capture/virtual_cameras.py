"""Cameras around a scene that came without any: where its dense part is, which way is up, from where it can be seen.

Knows nothing about files, and nothing of how the scene was made.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.capture.camera_positions import HALF_FOV, LEAST_VIEWS, best_poses, positions_around, positions_within
from splatgraft.core.cameras import Cameras, pinhole
from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering import render
from splatgraft.runtime.progress import Progress, silent

_HOLLOW = 0.08
"""Of the points within half the radius of the dense part: a filled ball has 0.06 there, a table with things more."""
_POINTS = 20_000
_TRIALS = 1000
_ALIGNED = math.cos(math.radians(25))


@dataclass(frozen=True)
class LookOptions:
    """How a scene without photographs is looked at."""

    views: int = 36
    """Of a trained scene: how many pictures are made of it; fewer where things stand in the way."""
    look: Literal["around", "within"] = "around"
    """Of a trained scene: at its dense part from all around, or out of its middle, as of a room seen from within."""
    picture_width: int = 640
    """Of these pictures, pixels; their height is three quarters of it."""
    up: tuple[float, float, float] | None = None
    """Of a trained scene: its up; found from its largest level surface where not given."""

    def __post_init__(self) -> None:
        """Raises: ValueError where there would be too few views, or up has no length."""
        if self.views < LEAST_VIEWS:
            raise ValueError(f"--views: expected at least {LEAST_VIEWS}, found {self.views}")
        if self.picture_width < 16:
            raise ValueError(f"--picture-width: expected at least 16, found {self.picture_width}")
        if self.up is not None and not math.hypot(*self.up) > 0:
            raise ValueError(f"--up: expected a direction, found {self.up}")


@dataclass(frozen=True)
class Viewpoints:
    """Places from which a scene can be looked at."""

    cameras: Cameras
    """Around the dense part, looking at its middle; or in it, looking out."""
    points: Float[Tensor, "m 3"]
    """Centres of solid Gaussians: what structure from motion would have found."""
    point_colors: Float[Tensor, "m 3"]
    """sRGB in [0, 1]."""
    report: tuple[str, ...]
    """Plain sentences: what was assumed."""


def find_viewpoints(scene: Gaussians, options: LookOptions, *, progress: Progress = silent) -> Viewpoints:
    """Rings of cameras around the scene's dense part or in it, those left out that see only what stands in the way.

    Raises: ValueError where the scene has too few solid Gaussians to tell what it shows.
    """
    solid = _solid(scene)
    centre, radius = dense_part(solid.means)
    if options.up is None:
        up, reason = find_up(solid.means, centre, radius)
    else:
        up, reason = torch.nn.functional.normalize(torch.tensor(options.up), dim=0), "as given"
    stands = positions_around if options.look == "around" else positions_within
    poses, dropped = best_poses(scene, stands(centre, radius, up=up, views=options.views), up=up, progress=progress)
    width = options.picture_width
    focal = 0.5 * width / math.tan(HALF_FOV)
    cameras = pinhole(poses, focal, width=width, height=width * 3 // 4, prefix="look")
    report = [
        f"a scene without photographs: {len(cameras)} pictures are made of it, from {options.look} {_shown(centre)}",
        f"up is taken to be {_shown(up)}: {reason}",
    ]
    if dropped:
        report.append(f"{dropped} of {options.views} views were left out: something stands in their way")
    inner = float(((solid.means - centre).norm(dim=1) < 0.5 * radius).float().mean())
    if options.look == "around" and inner < _HOLLOW:
        report.append("it is hollow: where it was seen from within, as a room from its middle, say look = within")
    return Viewpoints(cameras, solid.means, (0.5 + 0.28209479 * solid.sh[:, 0]).clamp(0, 1), tuple(report))


def photographed(
    scene: Gaussians, found: Viewpoints, *, write: Callable[[str, Tensor], None], progress: Progress = silent
) -> None:
    """Hand a picture of `scene` from every viewpoint to `write`, by the camera's name."""
    for index, camera in enumerate(found.cameras):
        color = render(scene, camera).color
        write(camera.names[0], color[0].clamp(0, 1))
        progress(index + 1, len(found.cameras), "pictures of the scene")


def dense_part(points: Float[Tensor, "m 3"]) -> tuple[Float[Tensor, "3"], float]:
    """Centre of the densest half of the points, and the radius that holds half of them."""
    centre = points.median(0).values
    for _ in range(10):
        distance = (points - centre).norm(dim=1)
        centre = points[distance <= distance.median()].mean(0)
    return centre, float((points - centre).norm(dim=1).median())


def find_up(points: Float[Tensor, "m 3"], centre: Float[Tensor, "3"], radius: float) -> tuple[Float[Tensor, "3"], str]:
    """Unit up, and why: the normal of the largest plane about the dense part, to the side on which things stand.

    The custom of the files decides where z is vertical (+z), since below a table there stands as much as on it, and
    where both sides are alike (-y as structure from motion leaves it, or +z).
    """
    near = points[(points - centre).norm(dim=1) < 2 * radius]
    near = near[:: max(1, len(near) // 4000)]
    generator = torch.Generator().manual_seed(0)
    corners = near[torch.randint(len(near), (_TRIALS, 3), generator=generator)]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # three points in a row span no plane
    spans = normals.norm(dim=1) > 1e-4 * radius**2
    normals, corners = torch.nn.functional.normalize(normals[spans], dim=1), corners[spans]
    heights = normals @ near.T - (normals * corners[:, 0]).sum(1)[:, None]
    thickness = 0.02 * radius
    counts = (heights.abs() < thickness).sum(1).float()
    # walls are as large as floors: those at right angles to the customary ups count less
    customary = normals[:, 1:].abs().amax(1) > _ALIGNED
    best = int((counts * torch.where(customary, 1.0, 0.6)).argmax())
    if counts[best] < 0.1 * len(near):
        return torch.tensor([0.0, -1.0, 0.0]), "no level surface was found, and most files have it so"
    inliers = near[heights[best].abs() < thickness]
    middle = inliers.mean(0)
    normal = torch.linalg.eigh((inliers - middle).double().T @ (inliers - middle).double()).eigenvectors[:, 0].float()
    height = (near - middle) @ normal
    beside = ((near - centre) - ((near - centre) @ normal)[:, None] * normal).norm(dim=1) < radius
    above = float(((height > 3 * thickness) & (height < radius) & beside).sum())
    below = float(((height < -3 * thickness) & (height > -radius) & beside).sum())
    share = f"the normal of a surface that holds {float(counts[best]) / len(near):.0%} of the dense part"
    if abs(float(normal[2])) < _ALIGNED and max(above, below) > 3 * min(above, below) + 1:
        return normal if above > below else -normal, f"{share}, on whose one side most things stand"
    customary_side = float(normal @ torch.tensor([0.0, -1.0, 1.0])) >= 0
    return normal if customary_side else -normal, f"{share}; which of its sides is a guess by custom"


def _solid(scene: Gaussians) -> Gaussians:
    """At most so many Gaussians that stop light and are no backdrop."""
    largest = scene.scales.amax(1)
    which = ((scene.opacities > 0.3) & (largest < 20 * largest.median())).nonzero()[:, 0]
    if len(which) < 20:
        raise ValueError(f"scene: expected at least 20 solid Gaussians, found {len(which)} of {scene.count}")
    return scene.select(which[:: math.ceil(len(which) / _POINTS)])


def _shown(vector: Float[Tensor, "3"]) -> str:
    return "(" + ", ".join(f"{round(x, 2) + 0.0:.2f}" for x in vector.tolist()) + ")"
