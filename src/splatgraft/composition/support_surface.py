"""Finds the level surface below a point of a scene: the most frequent height of a height map, with a fitted plane.

The height map is the median depth from straight above, without Gaussians above a given level. The plane is fitted by
least squares to points that are ever nearer to it.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras, look_at, pinhole
from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering import RenderOptions, render

_CAMERA_DISTANCE = 24.0  # distance of the camera over the radius: rays are vertical within 2.4 degrees


@dataclass(frozen=True)
class HeightMap:
    """Heights of the topmost surface around a point, s x s pixels."""

    points: Float[Tensor, "s s 3"]
    """Surface points, world units; undefined where alpha is 0."""
    heights: Float[Tensor, "s s"]
    """Heights along `up` above the map's centre, world units."""
    alpha: Float[Tensor, "s s"]
    """Opacity of the scene seen from above, in [0, 1]."""
    offsets: Float[Tensor, "s s 2"]
    """Horizontal position from the map's centre, world units."""
    pixel: float
    """Width of a pixel, world units."""
    camera: Cameras
    """The camera straight above, by which the map was drawn."""


def height_map(
    scene: Gaussians,
    center: Float[Tensor, "3"],
    *,
    up: Float[Tensor, "3"],
    radius: float,
    top: float,
    size: int = 96,
) -> HeightMap:
    """Compute the height map, `size` x `size` pixels, of the square of half width `radius` around `center`.

    Gaussians whose centre is more than `top` above `center`, along `up`, are left out; all lengths are in world units.
    """
    center, up = center.to(scene.means), torch.nn.functional.normalize(up.to(scene.means), dim=0)
    distance = _CAMERA_DISTANCE * radius
    eye = center + (top + distance) * up
    # any image orientation will do; look_at only needs an axis that is not parallel to the view
    world_axis = torch.eye(3).to(up)[int(up.abs().argmin())]
    pose = look_at(eye[None], center, world_axis)
    focal = size / 2 * distance / radius
    camera = pinhole(pose, focal, width=size, height=size)
    rendered = render(scene, camera, outputs=frozenset({"depth"}), options=RenderOptions(near=distance))
    depth, alpha = rendered.depth[0], rendered.alpha[0].detach()
    x = (torch.arange(size).to(depth) + 0.5 - size / 2) / focal
    v, u = torch.meshgrid(x, x, indexing="ij")
    in_camera = torch.stack([u * depth, v * depth, depth], -1)
    points = in_camera @ pose[0, :3, :3].T + pose[0, :3, 3]
    relative = points - center
    right, down = pose[0, :3, 0], pose[0, :3, 1]
    return HeightMap(
        points=points,
        heights=relative @ up,
        alpha=alpha,
        offsets=torch.stack([relative @ right, relative @ down], -1),
        pixel=2 * radius / size,
        camera=camera,
    )


# lengths over the radius of the disc, set by hand
_MAX_SLOPE = 0.35  # sine of the largest slope that counts as level: 20 degrees, mainly for errors of the estimated up
_CLEARANCE = 0.25  # height above the point from which the surface is searched downwards, if none is given
_DISC_SIZE_PX = 64  # width and height of the height map
_MIN_PIXELS = 8  # solid pixels of the height map below which there is no surface
_WIDENED = (1.0, 2.0, 4.0)  # radii of the discs, over the given one, tried in turn: the point may lie over a hole
_LEVEL_STEP = 0.05  # width of a bin of the histogram of heights
_TOLERANCES = (0.3, 0.2, 0.12, 0.08, 0.06, 0.06)
"""Largest distance from the plane of the points in each fit: from a slope of 20 degrees down to surface noise."""
_ON_SURFACE = _TOLERANCES[-1]  # largest distance of a point from the level plane that is fitted to it
_LEVEL = 0.15  # distance from the plane within which ground is level, folds of a cloth included; higher things obstruct
_MAX_ERROR = 0.12  # bound on the distance of a point in the comparison of a sloped plane with a level one
_AROUND = 6.0  # radius of the disc whose slope counts if the smaller one's differs, as at the edge of a cloth
_SAME_SLOPE = math.cos(math.radians(4.0))  # smallest cosine between two normals that count as the same slope
_SLOPE_GAIN = 0.7  # largest error of the sloped plane over that of the level one; a slope that explains less is noise


@dataclass(frozen=True)
class Support:
    """A level plane that can carry an object."""

    point: Float[Tensor, "3"]
    """Point of the plane straight below the given point, world units."""
    normal: Float[Tensor, "3"]
    """Unit normal, upwards."""
    flat_fraction: float
    """Share of the disc around it that lies at the plane's level, in [0, 1]."""
    obstructed_fraction: float
    """Share of the disc that rises above the plane, in [0, 1]."""


def support_below(
    scene: Gaussians,
    point: Float[Tensor, "3"],
    *,
    up: Float[Tensor, "3"],
    radius: float,
    clearance: float | None = None,
) -> Support:
    """Find the level surface that fills most of a horizontal disc below a point.

    On a heap of things or a steep slope the surface is poor, and its `flat_fraction` low. A slope that the ground
    around the disc does not share, such as that of a cloth's edge, does not tilt the plane.

    Args:
        scene: The scene with the surface.
        point: Point above the surface, world units.
        up: The scene's up direction.
        radius: Radius of the disc, world units; doubled at most twice if there is a hole below the point.
        clearance: Height above the point, world units, over which things such as a lamp are ignored. None takes a
            quarter of the radius, so that a point on a noisy surface finds it.

    Raises:
        ValueError: No surface lies below the point.
    """
    up = torch.nn.functional.normalize(up.to(scene.means), dim=0)
    point = point.to(scene.means)
    top = _CLEARANCE * radius if clearance is None else clearance
    for factor in _WIDENED:
        ground = height_map(scene, point, up=up, radius=factor * radius, top=top, size=_DISC_SIZE_PX)
        disc = ground.offsets.norm(dim=-1) <= factor * radius
        # half transparent pixels are floaters or edges
        solid = disc & (ground.alpha > 0.5)
        if int(solid.sum()) >= _MIN_PIXELS:
            break
    else:
        where = ", ".join(f"{x:.3g}" for x in point.tolist())
        raise ValueError(f"placement: expected a surface below ({where}), found none; name another point")
    points = ground.points[solid] - point
    normal, height = _fit_level_plane(points, ground.heights[solid], up=up, radius=radius)
    if float(normal @ up) < _SAME_SLOPE:
        wide = height_map(scene, point, up=up, radius=_AROUND * radius, top=top, size=_DISC_SIZE_PX)
        held = wide.alpha > 0.5
        around, _ = _fit_level_plane(wide.points[held] - point, wide.heights[held], up=up, radius=radius)
        if float(around @ normal) < _SAME_SLOPE:
            height = (points[(points @ normal - height).abs() < _ON_SURFACE * radius] @ around).median()
            normal = around
    rise = (points @ normal - height) / radius
    return Support(
        point=point + up * height / (normal @ up),
        normal=normal,
        flat_fraction=float((rise.abs() < _LEVEL).sum() / disc.sum()),
        obstructed_fraction=float((rise > _LEVEL).sum() / disc.sum()),
    )


def _fit_level_plane(
    points: Float[Tensor, "m 3"],
    heights: Float[Tensor, "m"],
    *,
    up: Float[Tensor, "3"],
    radius: float,
) -> tuple[Float[Tensor, "3"], Float[Tensor, ""]]:
    """Fit a plane to the most frequent level; gives its normal and its distance from the origin along the normal."""
    step = _LEVEL_STEP * radius
    # a moving sum of five bins: noise and a slight slope spread one surface over several
    counts = torch.bincount(((heights - heights.min()) / step).long())
    smooth = torch.nn.functional.conv1d(counts[None, None].float(), torch.ones(1, 1, 5), padding=2)[0, 0]
    level = heights.min() + (float(smooth.argmax()) + 0.5) * step
    normal, distance = up, level
    for tolerance in _TOLERANCES:
        near = (points @ normal - distance).abs() < tolerance * radius
        if int(near.sum()) < 8:
            break
        chosen = points[near].double()
        middle = chosen.mean(0)
        _, _, axes = torch.linalg.svd(chosen - middle, full_matrices=False)
        candidate = axes[2] * torch.sign(axes[2] @ up.double())
        if float(candidate @ up.double()) < (1 - _MAX_SLOPE**2) ** 0.5:
            break
        normal = candidate.to(points)
        distance = (middle @ candidate).to(points)
    height = heights[(heights - level).abs() < _ON_SURFACE * radius].median()
    cap = _MAX_ERROR * radius
    errors = [(points @ n - d).abs().clamp_max(cap).mean() for n, d in ((normal, distance), (up, height))]
    if errors[0] > _SLOPE_GAIN * errors[1]:
        normal, distance = up, height
    return normal, distance
