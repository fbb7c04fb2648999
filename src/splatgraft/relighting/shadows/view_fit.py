"""Shadows fitted in the target's own views: ratios of receivers that draw the ratio of the surface seen in each pixel.

A surface is drawn by Gaussians in a layer, blended in the order of their centres. From low above it, one that is a
little too high hides the surface well behind it, so a shadow that is evaluated at the centres is displaced from every
side, and blurred. Rendering is linear in the Gaussians' values: simultaneous iterative reconstruction (SIRT, Gilbert
1972) finds a value and a slope over view directions for each Gaussian whose blend is nearest to the true ratio.
"""

from collections.abc import Callable, Sequence
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
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.relighting.shadows.receivers import Receivers
from splatgraft.relighting.shadows.scene_ratio import SceneRatio
from splatgraft.rendering import ViewOperator, view_operator
from splatgraft.runtime.kernels import kernel, serialized

RatioAt = Callable[[Float[Tensor, "p 3"], Float[Tensor, "p 3"], Int[Tensor, "p"]], Float[Tensor, "p"]]
"""Grey ratio of light at points with unit normals, each on the surface of the receiver whose index is given."""

# the views and the solver; set by hand
_ROUNDS = 5
"""Iterations of the solver."""
_LONGEST_PX = 512
"""Longest side of a view, cut to the shadow; wider ones are reduced."""
_NARROWEST_PX = 0.5
"""Widest standard deviation in pixels below which a Gaussian keeps what it has: a reduced view draws it wider than
it is, and so in the wrong place. Measured on planes: at 0.3 the fit makes shadows worse, at 0.6 better."""
_MARGIN = 0.25
"""Share of its size that a view reaches beyond the shadow on each side."""
_CHANGED = 0.05
"""Change of light from which a receiver or a pixel counts as shadowed; fainter changes are smooth."""
_BESIDE_PX = 4
"""Pixels around a shadowed pixel that are fitted too."""
_RECEIVING = 0.5
"""Share of a pixel that receivers must make up."""
_GAMMA = 2.2
"""Exponent of sRGB, in which Gaussians are blended, as a power law."""
_DARKEST = 0.04
"""Ratio of light below which nothing is fitted, as `scene_ratio.DARKEST`."""
_MAX_SLOPE = 0.9
"""Most share of a value that a view direction takes away."""
_MIN_WEIGHT = 0.05
"""Pixels; receivers with less weight in all views together keep what they have."""


@dataclass(frozen=True)
class _FittedView:
    """One view of the Gaussians in front of a camera, of which the first m are receivers."""

    which: Int[Tensor, "m"]
    """Positions of these among all receivers."""
    count: int
    """Gaussians in front of the camera; those after the first m have a value of 1."""
    weights: ViewOperator
    """From values of all these Gaussians to pixels."""
    target: Float[Tensor, "h w"]
    """What the values must blend to: where no shadow is near, what they blend to at first."""
    directions: Float[Tensor, "m 3"]
    """Unit, from the camera to each receiver."""
    wide: Bool[Tensor, "m"]
    """Which receivers the view draws as wide as they are."""


@dataclass(frozen=True)
class _Surfaces:
    """The surfaces that m receivers form."""

    points: Float[Tensor, "m 3"]
    """The point in the middle of the layer at each of them, world units."""
    normals: Float[Tensor, "m 3"]
    """Unit."""
    extents: Float[Tensor, "m"]
    """World units; how far from its point a receiver shows the surface."""
    tree: KDTree
    """Search tree of the points."""

    @staticmethod
    def of(receivers: Receivers) -> "_Surfaces":
        off = ((receivers.gaussians.means - receivers.surface) * receivers.normals).sum(1, keepdim=True)
        points = receivers.gaussians.means - off * receivers.normals
        extents = 3 * receivers.gaussians.scales.max(1).values
        return _Surfaces(points, receivers.normals, extents, KDTree(points.numpy()))

    def hit(
        self, origin: Float[Tensor, "3"], rays: Float[Tensor, "p 3"], near: Float[Tensor, "p 3"]
    ) -> tuple[Float[Tensor, "p 3"], Int[Tensor, "p"], Bool[Tensor, "p"]]:
        """Where rays meet the plane of the receiver nearest to a guess, that receiver, and whether it is there."""
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


def fit_to_views(
    receivers: Receivers, ratio: SceneRatio, others: Gaussians, cameras: Cameras, *, ratio_at: RatioAt
) -> SceneRatio:
    """Fit the ratios of receivers to what some views show of them.

    Args:
        receivers: m Gaussians that an object's shadow may fall on.
        ratio: Their ratios so far, at their centres; receivers that no view shows keep them.
        others: The rest of the scene, which hides receivers.
        cameras: The views; none to change nothing.
        ratio_at: The ratio anywhere on the receivers' surfaces.
    """
    grey = (ratio.shadow + ratio.bounce).mean(1)
    shadowed = (1 - grey).abs() > _CHANGED
    if not bool(shadowed.any()) or not len(cameras):
        return ratio
    gaussians = concatenate([receivers.gaussians, others.with_sh_degree(receivers.gaussians.sh_degree)])
    values = grey.clamp_min(_DARKEST) ** (1 / _GAMMA)
    widths = gaussians.log_scales.max(1).values.exp()
    surfaces = _Surfaces.of(receivers)
    views = []
    for camera in cameras:
        cut = _cut_to(camera, receivers.gaussians.means[shadowed])
        if cut is not None:
            found = _view(gaussians, widths, values, surfaces, cut, ratio_at=ratio_at)
            views += [found] if found is not None else []
    value, slope, known = _solved(values, views)
    wanted, before = value**_GAMMA, ratio.shadow.mean(1).clamp_min(1e-6)
    factor = ((wanted - ratio.bounce.mean(1)) / before).clamp_min(0)
    shadow = (ratio.shadow * factor[:, None]).clamp(_DARKEST, 1)
    slope = _GAMMA * (value ** (_GAMMA - 1))[:, None] * slope
    return SceneRatio(
        shadow=torch.where(known[:, None], shadow, ratio.shadow),
        bounce=ratio.bounce,
        slope=torch.where(known[:, None], slope, ratio.slope),
    )


def _solved(
    values: Float[Tensor, "r"], views: Sequence[_FittedView]
) -> tuple[Float[Tensor, "r"], Float[Tensor, "r 3"], Bool[Tensor, "r"]]:
    """Values and slopes of the receivers, and which of these were fitted."""
    slope, weight = torch.zeros(len(values), 3), torch.zeros(len(values))
    wide = torch.zeros(len(values), dtype=torch.bool)
    for view in views:
        seen = view.weights.blend_transpose(torch.ones_like(view.target)[..., None])[: len(view.which), 0]
        weight[view.which] += seen
        wide[view.which] |= view.wide
    step = torch.where(wide & (weight > _MIN_WEIGHT), 1 / weight.clamp_min(_MIN_WEIGHT), 0)
    least = _DARKEST ** (1 / _GAMMA)
    for _ in range(_ROUNDS):
        change, turn = torch.zeros_like(values), torch.zeros_like(slope)
        for view in views:
            seen = torch.ones(view.count)
            seen[: len(view.which)] = values[view.which] + (slope[view.which] * view.directions).sum(1)
            back = view.weights.transpose_residual(seen, view.target)[: len(view.which)]
            change[view.which] += back
            turn[view.which] += back[:, None] * view.directions
        values = (values + step * change).clamp(least, 1)
        slope = slope + step[:, None] * turn
        most = torch.minimum(_MAX_SLOPE * values, 1 - values)[:, None]
        slope = slope * (most / slope.norm(dim=1, keepdim=True).clamp_min(1e-9)).clamp_max(1)
    return values, slope, step > 0


def _cut_to(camera: Cameras, points: Float[Tensor, "s 3"]) -> Cameras | None:
    """The camera cut to what it shows of `points`, and reduced; None where it shows nothing of them."""
    pixels, depth = _projected(camera, points)
    size = camera.sizes[0].float()
    seen = (depth > 0) & (pixels > 0).all(1) & (pixels < size).all(1)
    if not bool(seen.any()):
        return None
    low, high = pixels[seen].amin(0), pixels[seen].amax(0)
    margin = _MARGIN * (high - low) + _BESIDE_PX
    low, high = (low - margin).clamp_min(0).floor(), torch.minimum(high + margin, size).ceil()
    window = (int(low[0]), int(low[1]), int(high[0]), int(high[1]))
    return camera.cropped([window]).resized(min(1.0, _LONGEST_PX / float((high - low).max())))


def _projected(camera: Cameras, points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n"]]:
    """Pixels and depths of points."""
    pose = camera.camera_from_world[0]
    local = points @ pose[:3, :3].T + pose[:3, 3]
    seen = local @ camera.intrinsics[0].T
    return seen[:, :2] / seen[:, 2:].clamp_min(1e-6), local[:, 2]


def _view(
    scene: Gaussians,
    widths: Float[Tensor, "n"],
    values: Float[Tensor, "r"],
    surfaces: _Surfaces,
    camera: Cameras,
    *,
    ratio_at: RatioAt,
) -> _FittedView | None:
    """What one camera shows of a scene, receivers first: per pixel the ratio where its ray meets their surface."""
    which, drawn_px = gaussians_in_view(scene.means, widths, camera)
    gaussians = scene.select(which)
    weights = view_operator(gaussians, camera)
    receivers = which[: int((which < len(surfaces.points)).sum())]
    features, first = torch.zeros(len(which), 5), slice(len(receivers))
    features[:, 0], features[first, 0] = 1, values[receivers]
    features[first, 1:4], features[first, 4] = surfaces.points[receivers], 1
    blended = weights.blend(features)
    value, mass = blended[..., 0], blended[..., 4]
    changed = (value / weights.alpha.clamp_min(1e-6) - 1).abs() > _CHANGED
    beside = F.max_pool2d(changed[None].float(), 2 * _BESIDE_PX + 1, 1, _BESIDE_PX)[0].bool()
    fitted = beside & (mass > _RECEIVING)
    if not bool(fitted.any()):
        return None
    origin = camera.centers[0]
    seen = blended[..., 1:4][fitted] / mass[fitted][:, None]
    points, nearest, valid = surfaces.hit(origin, _rays(camera)[fitted], seen)
    fitted[fitted.clone()] = valid
    points, nearest = points[valid], nearest[valid]
    target = value.clone()
    ratio = ratio_at(points, surfaces.normals[nearest], nearest).clamp(_DARKEST, 1) ** (1 / _GAMMA)
    target[fitted] = weights.alpha[fitted] * ratio
    directions = F.normalize(gaussians.means[first] - origin, dim=1)
    return _FittedView(receivers, len(which), weights, target, directions, drawn_px[first] > _NARROWEST_PX)


def _rays(camera: Cameras) -> Float[Tensor, "h w 3"]:
    """Unit directions of the pixels' rays, in the world."""
    return F.normalize(camera.rays() @ camera.world_from_camera[0, :3, :3].T, dim=-1)


_REACH = np.float32(3)
"""Standard deviations by which a Gaussian's centre may lie outside the picture."""
_NEAREST = np.float32(1e-6)
"""World units; a depth below is taken for this one."""


def gaussians_in_view(
    means: Float[Tensor, "n 3"], widths: Float[Tensor, "n"], camera: Cameras
) -> tuple[Int[Tensor, "m"], Float[Tensor, "m"]]:
    """Positions of the Gaussians that the camera may show, ascending, and their standard deviations in pixels.

    Args:
        means: World units.
        widths: Largest standard deviations, world units.
        camera: One.
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
    """Fill `drawn` with standard deviations in pixels; -1 for what lies outside the picture."""
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
