"""Plane sweep over small images: rough surface points as seeds where structure from motion found none.

Each view has a grid of cells. A cell without a sparse point gets a ray:

1. Along the ray, the depth is chosen at which a patch parallel to the image agrees best with the nearest views (Collins
   1996). The cost of a patch is the mean absolute difference of its pixels. The mean over the better half of the views
   allows for occlusion (Kang et al. 2001).
2. Plain surfaces agree at many depths. So inverse depth is interpolated over the Delaunay triangles of the sparse
   points (planar prior of ACMP, Xu and Tao 2020). This depth is taken unless another one agrees clearly better.
3. A point stays if two of the compared views have a point of the same depth there.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import QhullError
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.reconstruction.initialization import SeedPoints

_CELL_PX = 6  # spacing of the rays in the reduced image
_DEPTHS = 32  # hypotheses per ray, evenly spaced in inverse depth
_COMPARED_VIEWS = 4
_PATCH_SPACING_PX = 1.5  # spacing of the 3x3 samples of a patch
_MIN_ANGLE_DEG = 2.0  # smallest parallax between compared views at the focus point
_MIN_COSINE = 0.5  # smallest cosine between the optical axes of compared views
NEAR, _FAR = 0.4, 8.0
"""Depth range, over the cameras' mean distance from their focus point."""
_MIN_KNOWN = 100  # fewest known points that may raise the nearest depth
_KNOWN_QUANTILE = 0.02  # share of the known points nearer than that depth; structure from motion has some outliers
_TIE = 0.015  # insignificant difference in cost, four grey levels; twice as much overrules the prior
_AGREEING_VIEWS = 2  # compared views that confirm a point
_SAME_DEPTH = 0.05  # largest relative difference of depth between views that agree
_MAX_COST = 0.12  # largest mean absolute difference, sRGB, at which a ray gives a point


def sweep(
    cameras: Sequence[Cameras], images: Sequence[Float[Tensor, "_ _ 3"]], *, known: Float[Tensor, "p 3"], reach: float
) -> SeedPoints:
    """Find surface points on the rays through grid cells that hold no known point.

    Args:
        cameras: One batch of 1 per image.
        images: Small images, sRGB in [0, 1].
        known: Sparse points, world units.
        reach: Mean distance of the cameras from their focus point, world units.

    Returns:
        Points with the patch's mean colour, bounded in width by the distance to the neighbouring rays.
    """
    nearest = NEAR * reach
    if len(known) >= _MIN_KNOWN:
        nearest = max(nearest, float(_nearest(known, cameras).quantile(_KNOWN_QUANTILE)))
    depths = 1 / torch.linspace(1 / (_FAR * reach), 1 / nearest, _DEPTHS)
    compared = [_compared_views(view, cameras, reach) for view in range(len(cameras))]
    candidates: list[SeedPoints] = []
    for view, camera in enumerate(cameras):
        cells = _Cells.of(known, camera)
        free = (cells.nearest < 0).nonzero().flip(-1)
        centers = _CELL_PX * free.float() + _CELL_PX / 2 + 0.5
        if not len(centers) or not compared[view]:
            candidates.append(SeedPoints.none())
            continue
        hypotheses = torch.cat([depths[:, None].expand(-1, len(centers)), cells.interpolated_depth(centers)[None]])
        candidates.append(
            _points_of_view(view, centers, compared[view], cameras=cameras, images=images, depths=hypotheses)
        )
    surfaces = [
        _Cells.of(torch.cat([known, points.points]), camera).depth_map()
        for points, camera in zip(candidates, cameras, strict=True)
    ]
    found = SeedPoints.none()
    for points, others in zip(candidates, compared, strict=True):
        votes = sum((_agree(points.points, cameras[j], surfaces[j]).int() for j in others), torch.zeros(len(points)))
        found = found.joined(points.select(votes >= _AGREEING_VIEWS))
    return found


@dataclass(frozen=True)
class _Cells:
    """Points in the cells of one image."""

    pixels: Float[Tensor, "m 2"]
    """Places of the points, pixels."""
    depths: Float[Tensor, "m"]
    """Depths of the points."""
    nearest: Int[Tensor, "rows columns"]
    """Index of the nearest point of each cell; -1 without one."""

    @staticmethod
    def of(points: Float[Tensor, "m 3"], camera: Cameras) -> "_Cells":
        """Sort points into the cells of an image."""
        columns, rows = (len(range(_CELL_PX // 2, n, _CELL_PX)) for n in (camera.width, camera.height))
        pixels, depths = _project(points, camera)
        place = (pixels / _CELL_PX).floor().long()
        inside = (depths > 0) & (place >= 0).all(1) & (place[:, 0] < columns) & (place[:, 1] < rows)
        # written from far to near, so the nearest stays
        far_to_near = depths.argsort(descending=True)
        far_to_near = far_to_near[inside[far_to_near]]
        nearest = torch.full((rows, columns), -1).numpy()
        nearest[place[far_to_near, 1].numpy(), place[far_to_near, 0].numpy()] = far_to_near.numpy()
        return _Cells(pixels, depths, torch.from_numpy(nearest))

    def depth_map(self) -> Float[Tensor, "rows columns"]:
        """Return the depth of the nearest point of each cell; infinite without one."""
        return torch.cat([self.depths, torch.tensor([torch.inf])])[self.nearest]  # -1 is the last

    def interpolated_depth(self, pixels: Float[Tensor, "k 2"]) -> Float[Tensor, "k"]:
        """Interpolate inverse depth over the Delaunay triangles of the nearest points; infinite outside of them."""
        # imported here, because it loads slowly, and all that reads a project imports this module
        from scipy.interpolate import LinearNDInterpolator

        corners = self.nearest[self.nearest >= 0]
        nowhere = torch.full((len(pixels),), torch.inf)
        if len(corners) < 3:
            return nowhere
        try:
            inverse = LinearNDInterpolator(self.pixels[corners].numpy(), 1 / self.depths[corners].numpy(), fill_value=0)
        except QhullError:  # all points lie on one line
            return nowhere
        return 1 / torch.from_numpy(inverse(pixels.numpy())).float()


def _agree(points: Float[Tensor, "m 3"], camera: Cameras, surface: Float[Tensor, "rows columns"]) -> Bool[Tensor, "m"]:
    """Test which points have the depth of `surface` in their cell or a neighbouring one."""
    pixels, depths = _project(points, camera)
    rows, columns = surface.shape
    # a point out of view is taken to the next cell outside, whose neighbours are padded, too
    padded = torch.nn.functional.pad(surface, (2, 2, 2, 2), value=torch.inf)
    x, y = (pixels / _CELL_PX).floor().unbind(-1)
    x, y = x.clamp(-1, columns).long() + 2, y.clamp(-1, rows).long() + 2
    same = torch.zeros(len(points), dtype=torch.bool)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            same |= (depths / padded[y + dy, x + dx] - 1).abs() < _SAME_DEPTH
    return same & (depths > 0)


def _points_of_view(
    view: int,
    centers: Float[Tensor, "m 2"],
    others: list[int],
    *,
    cameras: Sequence[Cameras],
    images: Sequence[Tensor],
    depths: Float[Tensor, "d m"],
) -> SeedPoints:
    """Find points on the rays through `centers` of one view by comparing it with others.

    `depths` fall along each ray; the last one is the prior, which may be infinite.
    """
    camera, ray = cameras[view], torch.arange(len(centers))
    step = _PATCH_SPACING_PX * torch.tensor([-1.0, 0.0, 1.0])
    dy, dx = (grid.flatten() for grid in torch.meshgrid(step, step, indexing="ij"))
    pixels = centers[:, None] + torch.stack([dx, dy], -1)
    own = _sampled(images[view], pixels)
    has_prior = depths[-1].isfinite()
    depths = torch.cat([depths[:-1], torch.where(has_prior, depths[-1], depths[0])[None]])
    patches = camera.centers[0].float() + depths[:, :, None, None] * _rays(camera, pixels)
    costs = torch.stack([_cost(patches, own, cameras[j], images[j]) for j in others])
    costs = costs.sort(0).values[: (len(others) + 1) // 2].mean(0)
    best = costs.min(0).values
    # among depths of equal cost, the farthest hides no surface of another view
    index = (costs <= best + _TIE).int().argmax(0)
    index = torch.where(has_prior & (costs[-1] <= best + 2 * _TIE), len(depths) - 1, index)
    chosen, points = depths[index, ray], patches[index, ray, patches.shape[2] // 2]
    good = (best < _MAX_COST) & (_nearest(points, cameras) > depths[-2])
    spacing = _CELL_PX * chosen / camera.intrinsics[0, 0, 0].float()
    return SeedPoints(points[good], own[good].mean(1), spacing[good])


def _compared_views(view: int, cameras: Sequence[Cameras], reach: float) -> list[int]:
    """Choose the nearest views with a similar direction and another position."""
    centers = torch.cat([camera.centers for camera in cameras]).float()
    forward = torch.cat([camera.world_from_camera[:, :3, 2] for camera in cameras]).float()
    distance, same = (centers - centers[view]).norm(dim=1), forward @ forward[view]
    usable = (distance > reach * math.radians(_MIN_ANGLE_DEG)) & (same > _MIN_COSINE)
    order = torch.where(usable, distance + reach * (1 - same), torch.inf).argsort()
    return [int(j) for j in order[:_COMPARED_VIEWS] if usable[j]]


def _nearest(points: Float[Tensor, "m 3"], cameras: Sequence[Cameras]) -> Float[Tensor, "m"]:
    """Compute the distance of each point to the nearest camera; a point close to any camera would cover its view."""
    return torch.cdist(points, torch.cat([camera.centers for camera in cameras]).float()).min(1).values


def _rays(camera: Cameras, pixels: Float[Tensor, "m k 2"]) -> Float[Tensor, "m k 3"]:
    """Compute the world directions of rays through pixels, at depth 1."""
    k, pose = camera.intrinsics[0].float(), camera.world_from_camera[0].float()
    plane = torch.stack(
        [(pixels[..., 0] - k[0, 2]) / k[0, 0], (pixels[..., 1] - k[1, 2]) / k[1, 1], torch.ones_like(pixels[..., 0])],
        -1,
    )
    return plane @ pose[:3, :3].T


def _project(points: Float[Tensor, "*n 3"], camera: Cameras) -> tuple[Tensor, Tensor]:
    """Project points to pixels and depths."""
    pose, k = camera.camera_from_world[0].float(), camera.intrinsics[0].float()
    x = points @ pose[:3, :3].T + pose[:3, 3]
    z = x[..., 2:]
    pixels = x[..., :2] / z.clamp_min(1e-6) * torch.stack([k[0, 0], k[1, 1]]) + torch.stack([k[0, 2], k[1, 2]])
    return pixels, z[..., 0]


def _sampled(image: Float[Tensor, "h w 3"], pixels: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n 3"]:
    """Sample an image bilinearly."""
    h, w, _ = image.shape
    grid = pixels.reshape(1, 1, -1, 2) * torch.tensor([2 / w, 2 / h]) - 1
    values = torch.nn.functional.grid_sample(
        image.permute(2, 0, 1)[None], grid, padding_mode="border", align_corners=False
    )
    return values[0, :, 0].T.reshape(*pixels.shape[:-1], 3)


def _cost(
    patches: Float[Tensor, "d m k 3"], own: Float[Tensor, "m k 3"], camera: Cameras, image: Tensor
) -> Float[Tensor, "d m"]:
    """Compute the mean absolute difference of patches; 1 if the patch's centre is out of view."""
    pixels, depth = _project(patches, camera)
    difference = (_sampled(image, pixels) - own).abs().mean((2, 3))
    middle = pixels[:, :, pixels.shape[2] // 2]
    inside = (middle >= 0).all(-1) & (middle < torch.tensor([camera.width, camera.height])).all(-1)
    inside &= depth[:, :, depth.shape[2] // 2] > 0
    return torch.where(inside, difference, 1.0)
