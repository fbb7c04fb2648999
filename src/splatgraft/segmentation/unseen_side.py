"""Closing of the side of an object that no photograph shows, by flat Gaussians on the visual hull of its masks.

1. The masks carve the visual hull out of a grid of voxels (Laurentini 1994); silhouettes from one side also give the
   outline from the other.
2. Flat opaque Gaussians are placed on the parts of the hull that no camera sees, unless the object has a surface there.
3. Their colours continue hue and saturation at the border of the seen surface (Laplace's equation on the surface).
4. Gaussians that would show in a photograph are removed.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.core.directions import frames_along
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.rotations import quaternion_from_rotation, rotation_from_quaternion
from splatgraft.rendering import RenderOptions, view_operator
from splatgraft.segmentation.selection import SURFACE_OPACITY

# all set by hand
_GRID = 96  # voxels along each axis
_ROOM = 1.0  # margin around the object's Gaussians in which its unseen side may lie, over their extent
_TRIMMED = 0.005  # share of the Gaussians outside that extent at either end
_AGREEING = 0.94  # smallest share of masks that contain a voxel of the hull: one of sixteen may be wrong
_SHOWN = 0.25  # smallest share of photographs that frame a voxel of the hull; close-ups frame only parts
_PIECE = 0.02  # smallest share of the object's surface in a piece of the hull; other pieces come from too few masks
_FACING = 0.2  # smallest cosine between a surface's normal and the direction to a camera that sees it
_MAX_VIEWS = 40  # most photographs that are used, evenly spaced in their order
_BIAS = 2.5  # voxels between a point of the hull's surface and the hull's first voxel that may hide it
_INSET = 2.0  # depth of the new Gaussians inside the hull, voxels; unseen outlines make the hull wider than the object
_OVERLAP = 4.0  # overlap of the new Gaussians with the seen surface, voxels; closes gaps
_HIDDEN = 0.005  # largest share of a new Gaussian's area that may show in a photograph
_RIM_PX = 1  # rim of a mask without new Gaussians
_WIDTH, _THICKNESS = 0.7, 0.15  # standard deviations of the new Gaussians, over a voxel's side
_LOGIT = 4.0  # opacity .98
_UNDERSIDE = -0.3  # largest upward component of a normal of the underside, which photographs cannot show
_NEIGHBOURS = 8
_ROUNDS = 400  # iterations of Jacobi's method; each carries colours one neighbour farther
_MAX_SATURATION = 4.0  # largest factor on a continued colour's saturation; opposite hues leave none to increase
_LEAST = 0.02  # unseen share of the surface below which an object counts as seen from all sides


@dataclass(frozen=True)
class ClosedObject:
    """An object with a closed unseen side."""

    gaussians: Gaussians
    """Gaussians of the object, unchanged, followed by those of its unseen side."""
    is_guessed: Bool[Tensor, "n"]
    """Whether a Gaussian belongs to the unseen side."""
    guessed_share: float
    """Unseen share of the object's surface without its underside, in [0, 1]."""


@dataclass(frozen=True)
class _Hull:
    """Voxels of the visual hull and m points on its surface."""

    occupied: Bool[Tensor, "g g g"]
    low: Float[Tensor, "3"]
    """Lower corner of the grid, world units."""
    voxel: Float[Tensor, "3"]
    """Sides of a voxel, world units."""
    points: Float[Tensor, "m 3"]
    normals: Float[Tensor, "m 3"]
    """Outward unit normals."""


def close_unseen_side(object_: Gaussians, cameras: Cameras, masks: Sequence[Float[Tensor, "_ _"]]) -> ClosedObject:
    """Close the side of an object that no photograph shows, including its underside.

    Args:
        object_: The object's Gaussians.
        cameras: Cameras of the photographs with masks.
        masks: Masks of the object, 1 inside, one per camera at its size.

    Returns:
        The closed object on the CPU; unchanged if all of it was seen, or if its masks have no common hull.
    """
    object_, cameras = object_.to("cpu"), cameras.to("cpu")
    up = estimate_up(cameras).to(object_.means)
    asked = torch.linspace(0, len(cameras) - 1, min(_MAX_VIEWS, len(cameras))).round().long()
    cameras, masks = cameras[asked], [masks[i].cpu() for i in asked.tolist()]
    nothing = ClosedObject(object_, torch.zeros(object_.count, dtype=torch.bool), 0.0)
    opaque = object_.opacities > SURFACE_OPACITY
    hull = _carved(object_, cameras, masks, up) if bool(opaque.any()) else None
    if hull is None:
        return nothing
    seen = _seen(hull, cameras)
    below = hull.normals @ up < _UNDERSIDE
    share = float((~seen & ~below).sum() / (~below).sum().clamp_min(1))
    if share < _LEAST:
        return nothing
    side = float(hull.voxel.max())
    bare = ~seen & _is_bare(hull, object_.select(opaque))
    if not bool(bare.any()) or not bool(seen.any()):
        return replace(nothing, guessed_share=share)
    distance, _ = KDTree(hull.points[bare].numpy()).query(hull.points.numpy())
    within = hull.points - _INSET * side * hull.normals
    back = (torch.from_numpy(distance) < _OVERLAP * side) & _inside_masks(within, cameras, [_eroded(m) for m in masks])
    colors = _continued(hull, seen, object_.select(opaque))[back]
    count, width = int(back.sum()), torch.tensor([_WIDTH, _WIDTH, _THICKNESS]) * side
    sh = torch.zeros(count, *object_.sh.shape[1:])
    sh[:, 0] = colors
    closing = Gaussians(
        means=within[back],
        log_scales=width.log().repeat(count, 1),
        quaternions=quaternion_from_rotation(frames_along(-hull.normals[back]).transpose(1, 2)),
        opacity_logits=torch.full((count,), _LOGIT),
        sh=sh,
    )
    closing = closing.select(~_shows(closing, object_, cameras))
    is_guessed = torch.cat([nothing.is_guessed, torch.ones(closing.count, dtype=torch.bool)])
    return ClosedObject(concatenate([object_, closing]), is_guessed, share)


def _carved(
    object_: Gaussians, cameras: Cameras, masks: Sequence[Float[Tensor, "_ _"]], up: Float[Tensor, "3"]
) -> _Hull | None:
    """Carve the visual hull of the masks, cut off below the object's lowest point; None if it is empty."""
    ends = object_.means.quantile(torch.tensor([_TRIMMED, 1 - _TRIMMED]), dim=0)
    lowest = float((object_.means @ up).quantile(_TRIMMED))
    room = _ROOM * float((ends[1] - ends[0]).max())
    low, high = ends[0] - room, ends[1] + room
    surface = object_.means[object_.opacities > SURFACE_OPACITY]
    # the first pass finds the hull's extent, the second carves it finely
    for _ in range(2):
        voxel = (high - low) / _GRID
        index = torch.arange(_GRID) + 0.5
        centers = torch.stack(torch.meshgrid(*(low[i] + index * voxel[i] for i in range(3)), indexing="ij"), -1)
        inside = _inside_masks(centers.reshape(-1, 3), cameras, masks).reshape(_GRID, _GRID, _GRID)
        occupied = _pieces_around(surface, inside & (centers @ up >= lowest), low, voxel)
        if not bool(occupied.any()):
            return None
        found = centers[occupied]
        low, high = found.amin(0) - 2.5 * voxel, found.amax(0) + 2.5 * voxel
    corner = centers[0, 0, 0] - 0.5 * voxel
    filled = torch.nn.functional.pad(occupied.float(), (2,) * 6)[None, None]
    smooth = torch.nn.functional.avg_pool3d(filled, 5, stride=1)[0, 0]
    gradient = torch.stack(torch.gradient(smooth), -1) / voxel
    around = torch.nn.functional.max_pool3d(1 - torch.nn.functional.pad(filled, (-1,) * 6), 3, stride=1)[0, 0]
    surface = occupied & (around > 0) & (gradient.norm(dim=-1) > 1e-6)
    normals = -torch.nn.functional.normalize(gradient[surface], dim=1)
    return _Hull(occupied, corner, voxel, centers[surface], normals)


def _pieces_around(
    surface: Float[Tensor, "p 3"], occupied: Bool[Tensor, "g g g"], low: Float[Tensor, "3"], voxel: Float[Tensor, "3"]
) -> Bool[Tensor, "g g g"]:
    """Select the connected pieces of a hull that contain a part of the object's surface."""
    pieces, count = ndimage.label(occupied.numpy(), ndimage.generate_binary_structure(3, 3))  # pyright: ignore[reportGeneralTypeIssues]
    cells = ((surface - low) / voxel).long()
    x, y, z = cells[((cells >= 0) & (cells < _GRID)).all(1)].unbind(1)
    held = torch.from_numpy(pieces).long()[x, y, z].bincount(minlength=count + 1)
    is_part = held >= _PIECE * len(surface)
    is_part[0] = False
    return is_part[torch.from_numpy(pieces).long()]


def _inside_masks(
    points: Float[Tensor, "p 3"], cameras: Cameras, masks: Sequence[Float[Tensor, "_ _"]]
) -> Bool[Tensor, "p"]:
    """Test which points lie inside nearly all masks of the photographs that frame them."""
    inside, shown, left = torch.zeros(len(points)), torch.zeros(len(points)), torch.arange(len(points))
    for camera, mask in zip(cameras, masks, strict=True):
        pixels, depth = camera.project(points[left])
        height, width = mask.shape
        framed = (depth > 0) & (pixels >= 0).all(1) & (pixels < torch.tensor([width, height])).all(1)
        column, row = pixels.nan_to_num(0).clamp(-1, 1e6).long().unbind(1)
        inside[left] += framed & (mask[row.clamp(0, height - 1), column.clamp(0, width - 1)] > 0.5)
        shown[left] += framed
        # drop points outside more masks than may be wrong; soon, few points are left
        left = left[shown[left] - inside[left] <= (1 - _AGREEING) * len(cameras)]
    return (shown >= _SHOWN * len(cameras)) & (inside >= _AGREEING * shown)


def _eroded(mask: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Remove a mask's rim, because Gaussians in it would show beside the object."""
    size = 2 * _RIM_PX + 1
    return -torch.nn.functional.max_pool2d(-mask[None, None], size, stride=1, padding=_RIM_PX)[0, 0]


def _seen(hull: _Hull, cameras: Cameras) -> Bool[Tensor, "m"]:
    """Test which points of a hull's surface face a camera and are not hidden from it by the hull."""
    seen = torch.zeros(len(hull.points), dtype=torch.bool)
    side = float(hull.voxel.min())
    steps = torch.arange(_BIAS, 3**0.5 * _GRID * float(hull.voxel.max()) / side)
    for camera in cameras:
        away = camera.centers[0].to(hull.points) - hull.points
        towards = torch.nn.functional.normalize(away, dim=1)
        asked = (~seen & ((towards * hull.normals).sum(1) > _FACING)).nonzero()[:, 0]
        for part in asked.split(4096):
            path = hull.points[part, None] + (side * steps)[:, None] * towards[part, None]
            seen[part] = ~hull.occupied[_cells(hull, path)].any(1)
    return seen


def _is_bare(hull: _Hull, object_: Gaussians) -> Bool[Tensor, "m"]:
    """Test which points of a hull have no surface of the object behind them, in the nearer half of the hull.

    A surface in the farther half is the inside of the opposite side.
    """
    axes = rotation_from_quaternion(object_.quaternions) * object_.scales[:, None]
    flat = axes.gather(2, object_.log_scales.topk(2).indices[:, None].expand(-1, 3, -1))
    steps = torch.cartesian_prod(torch.tensor([-1.0, 0.0, 1.0]), torch.tensor([-1.0, 0.0, 1.0]))
    spots = object_.means[:, None] + torch.einsum("nij,sj->nsi", flat, steps)
    surface = torch.zeros_like(hull.occupied)
    surface[_cells(hull, spots)] = True
    surface = torch.nn.functional.max_pool3d(surface[None, None].float(), 3, stride=1, padding=1)[0, 0] > 0
    away = torch.arange(0, 3**0.5 * _GRID) * float(hull.voxel.min())
    bare = []
    for points, normals in zip(hull.points.split(4096), hull.normals.split(4096), strict=True):
        cells = _cells(hull, points[:, None] - away[:, None] * normals[:, None])
        depth = hull.occupied[cells].long().cumprod(1).sum(1)
        is_nearer = torch.arange(len(away)) < (0.5 * depth)[:, None]
        bare.append(~(surface[cells] & is_nearer).any(1))
    return torch.cat(bare)


def _cells(hull: _Hull, points: Float[Tensor, "p s 3"]) -> tuple[Int[Tensor, "p s"], ...]:
    """Return the indices of the voxels at points; points outside get voxels at the border, which are empty."""
    return ((points - hull.low) / hull.voxel).long().clamp(0, _GRID - 1).unbind(-1)


def _shows(closing: Gaussians, object_: Gaussians, cameras: Cameras) -> Bool[Tensor, "n"]:
    """Test which Gaussians would show in a photograph, beside the object or through it."""
    both = concatenate([object_, closing])
    shows = torch.zeros(closing.count, dtype=torch.bool)
    area = 2 * math.pi * closing.scales.topk(2).values.prod(1)
    for camera in cameras:
        width, height = camera.sizes[0].tolist()
        ones = torch.ones(height, width, 1)
        pixels = view_operator(both, camera, RenderOptions()).blend_transpose(ones)[object_.count :, 0]
        pose, focal = camera.camera_from_world[0], camera.intrinsics[0, 0, 0]
        depth = (closing.means @ pose[2, :3] + pose[2, 3]).clamp_min(1e-6)
        shows |= pixels > _HIDDEN * area * (focal / depth) ** 2
    return shows


def _continued(hull: _Hull, seen: Bool[Tensor, "m"], object_: Gaussians) -> Float[Tensor, "m 3"]:
    """Compute band 0 at the points of a hull: the object's where it was seen, and a smooth continuation elsewhere.

    The saturation is continued beside the colour, because a mean of several hues would be grey.
    """
    _, nearest = KDTree(object_.means.numpy()).query(hull.points.numpy(), k=min(_NEIGHBOURS, object_.count))
    colors = object_.sh[:, 0][torch.from_numpy(nearest).reshape(len(hull.points), -1)].mean(1)
    known = torch.cat([colors, _chroma(colors).norm(dim=1, keepdim=True)], 1)
    _, around = KDTree(hull.points.numpy()).query(hull.points.numpy(), k=min(_NEIGHBOURS, len(hull.points)))
    around = torch.from_numpy(around).reshape(len(hull.points), -1)
    smooth = torch.where(seen[:, None], known, known[seen].mean(0))
    for _ in range(_ROUNDS):
        smooth = torch.where(seen[:, None], known, smooth[around].mean(1))
    chroma, saturation = _chroma(smooth[:, :3]), smooth[:, 3:]
    factor = saturation / torch.maximum(chroma.norm(dim=1, keepdim=True), saturation / _MAX_SATURATION).clamp_min(1e-6)
    return torch.where(seen[:, None], colors, smooth[:, :3] + (factor - 1) * chroma)


def _chroma(colors: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3"]:
    return colors - colors.mean(1, keepdim=True)
