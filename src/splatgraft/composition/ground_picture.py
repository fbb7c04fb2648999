"""A picture of the free places on the support: a view of the target with level places green and things on it red."""

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.composition.ground import FLAT_ENOUGH, FLAT_SLOPE, Ground, level_share
from splatgraft.composition.visibility import VIEWS, project, small_cameras, visible_points
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering import render

_LONGEST_PX = 640  # longest side of the picture
_FREE, _TAKEN = (0.20, 0.75, 0.30), (0.85, 0.20, 0.15)  # sRGB


def draw_ground(target: Gaussians, ground: Ground, *, cameras: Cameras) -> Float[Tensor, "h w 3"]:
    """Draw the view of the camera that shows most of the support; level places are green, things on it red."""
    surface, views = ground.surface, cameras.spread(VIEWS)
    points, slack = surface.points[ground.support], 3 * surface.pixel
    shown = [int(visible_points(target, points, camera=c, slack=slack).sum()) for c in small_cameras(views)]
    camera = views[shown.index(max(shown))].limited(_LONGEST_PX)
    drawn = render(target, camera, outputs=frozenset({"color", "depth"}))
    color, depth = drawn.color[0].detach(), drawn.depth[0].detach()
    pose = camera.world_from_camera[0].to(depth)
    points = (camera.rays().to(depth) * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]
    below_map, pixels, inside = project(points.reshape(-1, 3), surface.camera)
    last = len(surface.heights) - 1
    at = (pixels[:, 1].long().clamp(0, last), pixels[:, 0].long().clamp(0, last))
    plane_below_map = project(surface.points.reshape(-1, 3), surface.camera)[0].view_as(ground.rise) + ground.rise
    rise = plane_below_map[at] - below_map
    small = 2 * surface.pixel
    level = level_share(surface, radius=small, tolerance=FLAT_SLOPE * small) > FLAT_ENOUGH
    free = (ground.support & level & (ground.visible > 0))[at] & (rise.abs() <= ground.tolerance)
    taken = ground.taken[at] & (rise > -ground.tolerance)
    for marked, tint in ((free, _FREE), (taken, _TAKEN)):
        part = (marked & inside).view(depth.shape) & (depth > 0)
        color = torch.where(part[..., None], 0.5 * color + 0.5 * torch.tensor(tint), color)
    return color
