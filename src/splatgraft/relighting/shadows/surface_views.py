"""Views of the surface under a shadow: for each pixel, the surface point on its ray and the ratio of light there.

The receivers form the surface: a layer of Gaussians, blended in the order of their centres and often translucent. The
surface point of a pixel is the intersection of its ray with the middle of the layer.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from numba import prange
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.relighting.shadows.receivers import Receivers
from splatgraft.relighting.shadows.scene_ratio import DARKEST, SceneRatio
from splatgraft.rendering import ViewOperator, view_operator
from splatgraft.runtime.kernels import kernel, serialized

RatioAt = Callable[[Float[Tensor, "p 3"], Float[Tensor, "p 3"], Int[Tensor, "p"]], Float[Tensor, "p"]]
"""Function that computes grey ratios of light from p points, their unit normals and the indices of their receivers."""

GAMMA = 2.2
"""Exponent of a power law for sRGB, in which Gaussians are blended."""

# set by hand
_LONGEST_PX = 512  # longest side of a view after the cut to the shadow; larger ones are reduced
_CHANGED = 0.05  # share of light; receivers and pixels with a larger change are in shadow, smaller changes are smooth
_BESIDE_PX = 4  # pixels around a shadowed pixel that are used too; pixels left out along the end of a surface
_RECEIVING = 0.1  # smallest share of receivers in a used pixel and around it


@dataclass(frozen=True)
class _Surfaces:
    """The surfaces that m receivers form."""

    points: Float[Tensor, "m 3"]
    """Point in the middle of the layer at each receiver, world units."""
    normals: Float[Tensor, "m 3"]
    """Unit normals, world frame."""
    extents: Float[Tensor, "m"]
    """Largest distance from its point at which a receiver shows the surface, world units."""
    tree: KDTree
    """Search tree of the points."""

    @staticmethod
    def of(receivers: Receivers) -> "_Surfaces":
        """Find the surfaces in the middle of the receivers' layers."""
        off = ((receivers.gaussians.means - receivers.surface) * receivers.normals).sum(1, keepdim=True)
        points = receivers.gaussians.means - off * receivers.normals
        extents = 3 * receivers.gaussians.scales.max(1).values
        return _Surfaces(points, receivers.normals, extents, KDTree(points.numpy()))

    def hit(
        self, origin: Float[Tensor, "3"], rays: Float[Tensor, "p 3"], near: Float[Tensor, "p 3"]
    ) -> tuple[Float[Tensor, "p 3"], Int[Tensor, "p"], Bool[Tensor, "p"]]:
        """Intersect rays with the plane of the nearest receiver, starting from guessed points `near`.

        Returns:
            Points, indices of their receivers, and whether the receiver faces the ray and reaches the point.
        """
        points, nearest = near, torch.zeros(len(near), dtype=torch.int64)
        facing = torch.zeros(len(near))
        for _ in range(2):
            nearest = torch.from_numpy(self.tree.query(points.numpy())[1].astype(np.int64))
            normal = self.normals[nearest]
            facing = (normal * rays).sum(1)
            along = ((self.points[nearest] - origin) * normal).sum(1) / torch.where(facing < -1e-3, facing, -1)
            points = origin + along[:, None] * rays
        apart = (points - self.points[nearest]).norm(dim=1)
        return points, nearest, (facing < -1e-3) & (apart < self.extents[nearest])


@dataclass(frozen=True)
class SurfaceView:
    """One view of h x w pixels with n Gaussians in front of the camera; the first m are receivers."""

    camera: Cameras
    """A single camera, cut to the shadow."""
    which: Int[Tensor, "n"]
    """Positions of the Gaussians in the scene, receivers first."""
    receivers: Int[Tensor, "m"]
    """Positions of the m receivers among all receivers."""
    drawn_px: Float[Tensor, "n"]
    """Largest standard deviations of the Gaussians in the view, pixels."""
    weights: ViewOperator
    """Map from values of the n Gaussians to pixels."""
    value: Float[Tensor, "h w"]
    """Blend of the receivers' ratios at their centres, in sRGB, with 1 for all other Gaussians."""
    mass: Float[Tensor, "h w"]
    """Share of receivers in each pixel."""
    shown: Bool[Tensor, "h w"]
    """Whether a pixel shows the surface at a shadow or beside one; true for p pixels."""
    points: Float[Tensor, "p 3"]
    """Surface points, world units."""
    nearest: Int[Tensor, "p"]
    """Index of the receiver at each point."""
    ratio: Float[Tensor, "p"]
    """Grey ratio of light at each point."""


def blended_values(ratio: SceneRatio) -> Float[Tensor, "m"]:
    """Compute the receivers' factors in blending: their grey ratios in sRGB."""
    return (ratio.shadow + ratio.bounce).mean(1).clamp_min(DARKEST) ** (1 / GAMMA)


def views_of_surface(
    receivers: Receivers, ratio: SceneRatio, gaussians: Gaussians, cameras: Cameras, *, ratio_at: RatioAt
) -> list[SurfaceView]:
    """Draw views of the surface in shadow; cameras that do not see the shadow give none.

    Args:
        receivers: m Gaussians that an object's shadow may fall on.
        ratio: Ratios at the receivers' centres.
        gaussians: The scene, receivers first.
        cameras: Cameras of the views.
        ratio_at: Function that computes the ratio anywhere on the receivers' surfaces.
    """
    grey = (ratio.shadow + ratio.bounce).mean(1)
    shadowed = (1 - grey).abs() > _CHANGED
    if not bool(shadowed.any()):
        return []
    surfaces, widths = _Surfaces.of(receivers), gaussians.log_scales.max(1).values.exp()
    values = blended_values(ratio)
    views = []
    for camera in cameras:
        cut = _cut_to(camera, receivers.gaussians.means[shadowed])
        if cut is not None:
            found = _view(gaussians, widths, values, surfaces, cut, ratio_at=ratio_at)
            views += [found] if found is not None else []
    return views


def _cut_to(camera: Cameras, points: Float[Tensor, "s 3"]) -> Cameras | None:
    """Cut a camera's image to the points that it sees, and reduce it; None if it sees none."""
    pixels, depth = camera.project(points)
    size = camera.sizes[0].float()
    seen = (depth > 0) & (pixels > 0).all(1) & (pixels < size).all(1)
    if not bool(seen.any()):
        return None
    low, high = pixels[seen].amin(0), pixels[seen].amax(0)
    margin = 0.25 * (high - low) + _BESIDE_PX
    low, high = (low - margin).clamp_min(0).floor(), torch.minimum(high + margin, size).ceil()
    window = (int(low[0]), int(low[1]), int(high[0]), int(high[1]))
    return camera.cropped([window]).resized(min(1.0, _LONGEST_PX / float((high - low).max())))


def _view(
    scene: Gaussians,
    widths: Float[Tensor, "n"],
    values: Float[Tensor, "r"],
    surfaces: _Surfaces,
    camera: Cameras,
    *,
    ratio_at: RatioAt,
) -> SurfaceView | None:
    """Draw one camera's view of a scene, receivers first; None if it shows no shadow on their surface."""
    which, drawn_px = gaussians_in_view(scene.means, widths, camera)
    weights = view_operator(scene.select(which), camera)
    receivers = which[: int((which < len(surfaces.points)).sum())]
    features, first = torch.zeros(len(which), 5), slice(len(receivers))
    features[:, 0], features[first, 0] = 1, values[receivers]
    features[first, 1:4], features[first, 4] = surfaces.points[receivers], 1
    blended = weights.blend(features)
    value, mass = blended[..., 0], blended[..., 4]
    changed = (value - weights.alpha).abs() > _CHANGED * mass
    shown = _widened(changed.float()).bool() & (-_widened(-mass) > _RECEIVING)
    seen = blended[..., 1:4][shown] / mass[shown][:, None]
    points, nearest, valid = surfaces.hit(camera.centers[0], _rays(camera)[shown], seen)
    shown[shown.clone()] = valid
    if not bool(shown.any()):
        return None
    points, nearest = points[valid], nearest[valid]
    ratio = ratio_at(points, surfaces.normals[nearest], nearest).clamp(DARKEST, 1)
    return SurfaceView(camera, which, receivers, drawn_px, weights, value, mass, shown, points, nearest, ratio)


def _widened(values: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Take the largest value around each pixel."""
    return F.max_pool2d(values[None], 2 * _BESIDE_PX + 1, 1, _BESIDE_PX)[0]


def _rays(camera: Cameras) -> Float[Tensor, "h w 3"]:
    """Compute unit directions of the pixels' rays, world frame."""
    return F.normalize(camera.world_rays(), dim=-1)


_REACH = np.float32(3)  # standard deviations by which a Gaussian's centre may lie outside the picture
_NEAREST = np.float32(1e-6)  # world units; smallest depth, against division by 0


def gaussians_in_view(
    means: Float[Tensor, "n 3"], widths: Float[Tensor, "n"], camera: Cameras
) -> tuple[Int[Tensor, "m"], Float[Tensor, "m"]]:
    """Find the Gaussians that a camera may show: their positions, ascending, and standard deviations in pixels.

    Args:
        means: Centres, world units.
        widths: Largest standard deviations, world units.
        camera: A single camera.
    """
    drawn = np.empty(len(means), np.float32)
    pose, intrinsics = (
        np.ascontiguousarray(x[0].numpy(), np.float32) for x in (camera.camera_from_world, camera.intrinsics)
    )
    size = camera.sizes[0].float().numpy()
    _drawn_widths(means.contiguous().numpy(), widths.contiguous().numpy(), pose, intrinsics, size, drawn)
    which = torch.from_numpy(np.nonzero(drawn >= 0)[0])
    return which, torch.from_numpy(drawn)[which]


@serialized
@kernel(parallel=True)
@no_type_check
def _drawn_widths(means, widths, pose, intrinsics, size, drawn):
    """Fill `drawn` with standard deviations in pixels; -1 for Gaussians outside the picture."""
    for i in prange(means.shape[0]):
        x, y, z = means[i, 0], means[i, 1], means[i, 2]
        a = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]
        b = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]
        depth = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        over = np.float32(1) / max(intrinsics[2, 0] * a + intrinsics[2, 1] * b + intrinsics[2, 2] * depth, _NEAREST)
        u = (intrinsics[0, 0] * a + intrinsics[0, 1] * b + intrinsics[0, 2] * depth) * over
        v = (intrinsics[1, 0] * a + intrinsics[1, 1] * b + intrinsics[1, 2] * depth) * over
        width = widths[i] * intrinsics[0, 0] / max(depth, _NEAREST)
        beside = _REACH * width
        inside = depth > 0 and u > -beside and v > -beside and u < size[0] + beside and v < size[1] + beside
        drawn[i] = width if inside else np.float32(-1)
