"""Height map of a scene around a point: depth rendered from straight above, without what lies over a given level."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering import RenderOptions, render

_DISTANCE = 24.0
"""Distance of the camera over the radius: rays are vertical within 2.4 degrees."""


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
