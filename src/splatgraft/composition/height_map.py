"""Height map of a scene around a point: depth rendered from straight above, without what lies over a given level.

The mean depth of a pixel lies below a surface that lets some light through, as reconstructed glossy table tops do:
their reflections are Gaussians underneath. There the height is the median over the pixel's blending weights; at edges,
which are as fuzzy as Gaussians are, the mean stands, so that what reaches beyond them does not count as ground.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import Cameras, look_at, pinhole
from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering import RenderOptions, render

_DISTANCE = 24.0
"""Distance of the camera over the radius: rays are vertical within 2.4 degrees."""
_LEVELS, _LEVELS_AT_ONCE = 64, 16
"""Heights between which the median is interpolated, and how many of them are blended at a time, which bounds memory."""
_STEEPEST = 4.0
"""Rise over three pixels, in pixels, from which on the middle one is at an edge."""
_DIFFERENT = 0.25
"""Distance from the mean, over that of two levels, from which on the median is taken: interpolation errs by .1."""


@dataclass(frozen=True)
class HeightMap:
    """s x s heights of the topmost surface around a point."""

    points: Float[Tensor, "s s 3"]
    """Surface points, in the world; meaningless where alpha is 0."""
    heights: Float[Tensor, "s s"]
    """Along `up` above the map's centre, world units."""
    alpha: Float[Tensor, "s s"]
    """Opacity of the scene seen from above, in [0, 1]."""
    offsets: Float[Tensor, "s s 2"]
    """Horizontal position from the map's centre, world units."""
    pixel: float
    """Width of a pixel, world units."""


def height_map(
    scene: Gaussians,
    center: Float[Tensor, "3"],
    *,
    up: Float[Tensor, "3"],
    radius: float,
    top: float,
    size: int = 96,
) -> HeightMap:
    """The height map of the square of half width `radius` around `center`.

    Args:
        scene: What is seen from above.
        center: World units.
        up: Of any length but zero.
        radius: World units.
        top: Gaussians centred more than this above `center` are left out, world units.
        size: Width and height of the map, pixels.
    """
    center, up = center.to(scene.means), torch.nn.functional.normalize(up.to(scene.means), dim=0)
    distance = _DISTANCE * radius
    eye = center + (top + distance) * up
    # any image orientation will do; look_at only needs an axis that is not parallel to the view
    world_axis = torch.eye(3).to(up)[int(up.abs().argmin())]
    pose = look_at(eye[None], center, world_axis)
    focal = size / 2 * distance / radius
    camera = pinhole(pose, focal, width=size, height=size)
    rendered = render(scene, camera, outputs=frozenset({"depth"}), options=RenderOptions(near=distance))
    depth, alpha = rendered.depth[0].detach(), rendered.alpha[0].detach()
    median = _median_depth(scene, camera, depth, alpha, near=distance)
    steepest = _STEEPEST * 2 * radius / size
    depth = torch.where(_range_around(median) < steepest, median, depth)
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
    )


def _range_around(depth: Float[Tensor, "s s"]) -> Float[Tensor, "s s"]:
    """Largest difference within a pixel and its eight neighbours."""
    pool = torch.nn.functional.max_pool2d
    return (pool(depth[None], 3, 1, 1) + pool(-depth[None], 3, 1, 1))[0]


def _median_depth(
    scene: Gaussians, camera: Cameras, mean: Float[Tensor, "s s"], alpha: Float[Tensor, "s s"], *, near: float
) -> Float[Tensor, "s s"]:
    """`mean`, and the median depth where it differs from it by more than interpolation does, world units."""
    solid = alpha > 0.5
    if not bool(solid.any()):
        return mean
    pose = camera.camera_from_world[0]
    across = (scene.means @ pose[:2, :3].T + pose[:2, 3]).abs().amax(1)
    # rays that are all but vertical: what is drawn lies in the square, give or take its own width
    half = 1.2 * near / _DISTANCE
    scene = scene.select(across < half + 4 * scene.scales.amax(1))
    depths = scene.means @ pose[2, :3] + pose[2, 3]
    deepest = float(mean[solid].max())
    step = (deepest - near) / (_LEVELS - 2)
    if not step > 0:
        return mean
    # one level beyond the deepest mean, so that the shares of an even surface reach a half
    levels = near + step * torch.arange(_LEVELS).to(mean)
    options, nearer = RenderOptions(near=near), []
    for part in levels.split(_LEVELS_AT_ONCE):
        # share of each Gaussian that lies nearer than a level, in steps that join
        shares = ((part - depths[:, None]) / step + 0.5).clamp(0, 1)
        drawn = render(scene, camera, outputs=frozenset(), features=shares, options=options)
        nearer.append(drawn.features[0].detach())
    share = torch.cat(nearer, -1) / alpha.clamp_min(1e-6)[..., None]
    reached = share >= 0.5
    after = reached.int().argmax(-1).clamp_min(1)
    low, high = (share.gather(-1, at[..., None])[..., 0] for at in (after - 1, after))
    median = levels[after - 1] + step * ((0.5 - low) / (high - low).clamp_min(1e-6)).clamp(0, 1)
    # a median below the last level is not known
    known = solid & reached.any(-1)
    return torch.where(known & ((median - mean).abs() > _DIFFERENT * step), median, mean)
