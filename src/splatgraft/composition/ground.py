"""The ground around the point that a target's cameras look at, and the plane of the support in it.

The support is the surface on which the captured thing stands, such as a table's top:

1. A height map is drawn from straight above the point. A median filter removes single pixels that stand out, which are
   noise of the reconstruction.
2. The levels are the peaks of its histogram of heights; the support is the highest large one.
3. A plane is fitted to the support by least squares.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor

from splatgraft.composition.support_surface import HeightMap, height_map
from splatgraft.composition.visibility import VIEWS, project, small_cameras, visible_points, visible_share
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering import render

# set by hand; lengths over the half width of the map
_MAP_SIZE_PX = 128  # width and height of the height map
_MEDIAN_PX = 3  # width of the median filter of heights
_MIN_TOP = 0.05  # least height of the mapped space above the focus point
_CENTER_SPREAD = 0.5  # standard deviation of the distance from the focus point in the weights
_MIN_AREA = 0.2
"""Smallest area of the support over that of the largest level, and of the region that it carries over all ground; both
weighted by nearness to the focus point. A disc around that point has this share from a radius of .31 on, .2 of the
cameras' distance: tables are larger, the flat shoulders of figures are smaller."""
_TOLERANCE = 0.05  # largest distance of the support's surface from its plane: noise of a reconstruction
_ABOVE_FOCUS = 0.15
"""Largest height of the support above the focus point. Cameras that look at a bare table may meet below it, by a tenth
of their distance."""
FLAT_SLOPE = 0.08
"""Height difference that counts as level, over the radius of a disc: noise and a slope of a few degrees."""
FLAT_ENOUGH = 0.8
"""Share of a disc that lies at the level of its middle, above which the disc counts as level."""
_PICTURE_PX = 640  # longest side of the picture of free places
_FREE, _TAKEN = (0.20, 0.75, 0.30), (0.85, 0.20, 0.15)  # sRGB


@dataclass(frozen=True)
class Ground:
    """The surface around the point that the cameras look at, and the plane of the support in it."""

    surface: HeightMap
    """Heights of the surface."""
    rise: Float[Tensor, "s s"]
    """Height above the plane, world units; nan where nothing is solid."""
    tolerance: float
    """Largest distance of the support's surface from its plane, world units."""
    clearance: Float[Tensor, "s s"]
    """Horizontal distance to the nearest thing that rises above the plane, world units; infinite if there is none."""
    visible: Float[Tensor, "s s"]
    """Share of the views that show the pixel's point, in [0, 1]."""
    central: Float[Tensor, "s s"]
    """Weight that falls with the horizontal distance from the focus point, in [0, 1]."""

    @property
    def support(self) -> Bool[Tensor, "s s"]:
        """Pixels on the plane."""
        return self.rise.abs() <= self.tolerance

    @property
    def lower(self) -> Bool[Tensor, "s s"]:
        """Pixels below the plane."""
        return self.rise < -self.tolerance

    @property
    def taken(self) -> Bool[Tensor, "s s"]:
        """Pixels above the plane: the captured thing and other things that stand there."""
        return self.clearance == 0


def measure_ground(
    target: Gaussians, focus: Float[Tensor, "3"], reach: float, *, cameras: Cameras, up: Float[Tensor, "3"]
) -> Ground:
    """Measure the ground in the square of half width `reach`, world units, around `focus`.

    Raises:
        ValueError: There is no surface.
    """
    up = torch.nn.functional.normalize(up.to(focus), dim=0)
    # surfaces lie below most cameras; ceilings and lamps do not
    top = max(float(((cameras.centers - focus) @ up).median()), _MIN_TOP * reach)
    surface = height_map(target, focus, up=up, radius=reach, top=top, size=_MAP_SIZE_PX)
    surface = replace(surface, heights=torch.from_numpy(ndimage.median_filter(surface.heights.numpy(), _MEDIAN_PX)))
    solid = surface.alpha > 0.5
    if not bool(solid.any()):
        raise ValueError(
            "placement: expected a surface where the cameras look, found none; name a point (--at or --on)"
        )
    central = torch.exp(-0.5 * (surface.offsets.norm(dim=-1) / (_CENTER_SPREAD * reach)) ** 2)
    tolerance = _TOLERANCE * reach
    # if all of the surface is higher, all of it counts
    below = solid & (surface.heights < _ABOVE_FOCUS * reach)
    counted = below if bool(below.any()) else solid
    rise = _rise_above_support(surface, solid, counted, central, tolerance=tolerance).where(solid, torch.nan)
    taken = rise > tolerance
    clearance = torch.full_like(rise, torch.inf)
    if bool(taken.any()):
        clearance = surface.pixel * torch.from_numpy(ndimage.distance_transform_edt(~taken.numpy())).to(rise)
    visible = visible_share(target, surface.points.reshape(-1, 3), cameras=cameras, slack=3 * surface.pixel)
    return Ground(
        surface=surface,
        rise=rise,
        tolerance=tolerance,
        clearance=clearance,
        visible=visible.reshape(rise.shape),
        central=central,
    )


def draw_ground(target: Gaussians, ground: Ground, *, cameras: Cameras) -> Float[Tensor, "h w 3"]:
    """Draw the camera view with the most visible support; level places are green, things on it red."""
    surface, views = ground.surface, cameras.spread(VIEWS)
    points, slack = surface.points[ground.support], 3 * surface.pixel
    shown = [int(visible_points(target, points, camera=c, slack=slack).sum()) for c in small_cameras(views)]
    camera = views[shown.index(max(shown))].limited(_PICTURE_PX)
    drawn = render(target, camera, outputs=frozenset({"color", "depth"}))
    color, depth = drawn.color[0].detach(), drawn.depth[0].detach()
    below_map, pixels, inside = project(camera.unproject(depth).reshape(-1, 3), surface.camera)
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


def _rise_above_support(
    surface: HeightMap,
    solid: Bool[Tensor, "s s"],
    counted: Bool[Tensor, "s s"],
    central: Float[Tensor, "s s"],
    *,
    tolerance: float,
) -> Float[Tensor, "s s"]:
    """Compute the height above the support's plane, which is the highest large level of the `counted` pixels.

    A level carries the largest connected region that is not lower: things on a table count as parts of the table.
    """
    heights = surface.heights
    lowest, step = heights[counted].min(), 0.5 * tolerance
    area = torch.bincount(((heights[counted] - lowest) / step).long(), weights=central[counted])[None]
    # bins are narrower than a surface is thick: each is taken with its neighbours
    area = torch.nn.functional.avg_pool1d(area, 3, 1, 1)
    is_peak = area == torch.nn.functional.max_pool1d(area, 5, 1, 2)
    levels = lowest + ((is_peak & (area >= _MIN_AREA * area.max()))[0].nonzero()[:, 0] + 0.5) * step
    weight = (central * solid).flatten()
    for level in levels.flip(0).split(1):
        regions, _ = ndimage.label((solid & (heights > level - tolerance)).numpy())  # pyright: ignore[reportGeneralTypeIssues]
        carried = torch.bincount(torch.from_numpy(regions).long().flatten(), weights=weight)[1:]
        if float(carried.max()) >= _MIN_AREA * float(weight.sum()):
            break
    plane = level.expand_as(heights)
    across = torch.cat([surface.offsets, torch.ones_like(heights)[..., None]], -1).double()
    for width in (2 * tolerance, tolerance):
        near = counted & ((heights - plane).abs() < width)
        slopes = torch.linalg.lstsq(across[near], heights[near, None].double()).solution
        plane = (across @ slopes)[..., 0].to(heights)
    return heights - plane


def level_share(
    surface: HeightMap, *, radius: float, tolerance: float, or_higher: bool = False
) -> Float[Tensor, "s s"]:
    """Compute the share of the disc of `radius` around each pixel that lies within `tolerance` of that pixel's level.

    With `or_higher` higher ground counts, too: the share that does not fall away. It is 0 where nothing is solid. Both
    lengths are in world units.
    """
    solid = surface.alpha > 0.5
    pixels = max(1, round(radius / surface.pixel))
    steps = torch.arange(-pixels, pixels + 1)
    stride = max(1, pixels // 6)
    v, u = torch.meshgrid(steps[::stride], steps[::stride], indexing="ij")
    inside = u**2 + v**2 <= pixels**2
    # beyond the map the ground goes on as at its border
    both = torch.stack([surface.heights, solid.float()])
    padded_height, padded_solid = torch.nn.functional.pad(both, (pixels,) * 4, mode="replicate")
    size = len(surface.heights)
    level, bound = torch.zeros_like(surface.heights), tolerance + 0.5 * surface.pixel
    for dv, du in zip(v[inside].tolist(), u[inside].tolist(), strict=True):
        rows, columns = slice(pixels + dv, pixels + dv + size), slice(pixels + du, pixels + du + size)
        rise = padded_height[rows, columns] - surface.heights
        same = (rise > -bound) & ((rise < bound) | or_higher)
        level += same * padded_solid[rows, columns]
    return level / float(inside.sum()) * solid
