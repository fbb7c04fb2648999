"""Contact: flatten the layer of Gaussians that an object stands on, so that the object's foot stays visible.

A reconstructed floor or table is a layer of Gaussians as thick as its noise. The upper ones are blended in front of an
object that stands on it. For each object:

1. Fit the layer's plane by weighted least squares to the Gaussians near the object (`_contact_layer`).
2. Choose a factor on heights over the plane, smallest at the foot (`_factors`). Heights of a cup beside the foot or of
   the vertical edge of a table keep the factor 1.
3. Scale heights and shapes by the factor (`_flattened`). From straight above, a flattened layer looks the same.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere, bounding_sphere
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.planes import least_squares_normal
from splatgraft.core.rotations import quaternion_from_rotation

SHAPE = ("means", "log_scales", "quaternions")
"""Fields of Gaussians that flattening changes."""

# what counts as a contact layer, and how far it is flattened; set by hand on rendered scenes
_OPAQUE = 0.1  # opacity above which a Gaussian is part of a surface, as for a bounding sphere
_REACH = 0.35  # object radii; the plane is fitted to Gaussians within this distance of the object's
_TOLERANCES = (0.4, 0.25, 0.2)  # object radii; largest distance from the plane in each round of the fit
_NEIGHBOURS = 24  # Gaussians that give one normal of the fit, or the mean height beside a Gaussian
_MAX_USED = 2000  # Gaussians of target and of object in the fit, spread evenly over the list
_MIN_FACING = math.sqrt(0.75)  # cosine between a Gaussian's normal and the plane's: 30 degrees
_DEEPEST = 3.0  # standard deviations from the layer's middle to its end; an object with a higher base floats
_LEVEL = 0.5  # standard deviations by which the mean height beside a Gaussian may be off; one more: not flattened
_SLOPE = 0.2  # tangent, 11 degrees, by which a flattened layer rises from the foot; lower cameras may see it in front
_FLATTEST = 0.2  # smallest factor on heights; measured: a flatter layer covers no less


@dataclass(frozen=True)
class _Layer:
    """The layer of Gaussians that an object stands on."""

    normal: Float[Tensor, "3"]
    """Unit, towards the object."""
    offset: float
    """Position of its middle along the normal, world units."""
    deviation: float
    """Standard deviation of heights over the middle, with the Gaussians' own extent, world units."""

    def heights(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Heights of points over the middle, world units."""
        return points @ self.normal - self.offset

    def extents(self, gaussians: Gaussians) -> Float[Tensor, "n"]:
        """Standard deviations along the normal, world units."""
        return ((gaussians.rotations.transpose(1, 2) @ self.normal) * gaussians.scales).norm(dim=1)

    def projected(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Points moved along the normal onto the middle."""
        return points - self.heights(points)[:, None] * self.normal


def flatten_contact_layers(target: Gaussians, objects: Sequence[Gaussians]) -> Gaussians:
    """Flatten the layers that placed objects stand on, so that they do not cover the objects' feet.

    Only centres and shapes near a foot change. All other Gaussians keep every bit. So does the whole target below an
    object that floats or stands on no surface.
    """
    flattened = target.to("cpu")
    is_changed = False
    for one in objects:
        found = flattened_under(flattened, one.to("cpu"))
        if found is not None:
            rows, flat = found
            fields = {name: getattr(flattened, name).index_copy(0, rows, getattr(flat, name)) for name in SHAPE}
            flattened, is_changed = replace(flattened, **fields), True
    return flattened.to(target.device) if is_changed else target


def flattened_under(target: Gaussians, placed: Gaussians) -> tuple[Int[Tensor, "k"], Gaussians] | None:
    """Flatten the layer that one object stands on.

    Args:
        target: Gaussians on the CPU.
        placed: The object in the target's frame, on the CPU.

    Returns:
        Indices of the k Gaussians that change, and these Gaussians with new `SHAPE` and the first band of colours
        alone; None if the object floats or stands on no surface.
    """
    opaque = placed.with_sh_degree(0).select(placed.opacities > _OPAQUE)
    if not opaque.count:
        return None
    sphere, opaque = bounding_sphere(opaque), _evenly(opaque, _MAX_USED)
    away = (target.means - sphere.center).norm(dim=1) - 2 * target.log_scales.amax(1).exp()
    near = (away < 2 * sphere.radius).nonzero()[:, 0]
    around = target.with_sh_degree(0).select(near)
    layer = _contact_layer(around, opaque, sphere)
    if layer is None:
        return None
    if float(layer.heights(sphere.center[None])) < 0:
        layer = replace(layer, normal=-layer.normal, offset=-layer.offset)
    heights = layer.heights(opaque.means)
    base = float((heights - layer.extents(opaque)).min())
    if base > _DEEPEST * layer.deviation:
        return None
    # no hole is dug for an object that was buried on purpose: deeper than the surface's height is uncertain
    base = max(base, -layer.deviation)
    foot = opaque.select(heights < base + 0.2 * sphere.radius)
    factor = _factors(around, foot, layer, radius=sphere.radius)
    changed = (factor < 1).nonzero()[:, 0]
    return near[changed], _flattened(around.select(changed), layer, factor[changed], level=min(base, 0.0))


def _evenly(gaussians: Gaussians, count: int) -> Gaussians:
    """Select at most `count` Gaussians, spread evenly over the list."""
    if gaussians.count <= count:
        return gaussians
    return gaussians.select(torch.linspace(0, gaussians.count - 1, count).long())


def _distance_from(foot: Gaussians, gaussians: Gaussians, layer: _Layer) -> Float[Tensor, "n"]:
    """Compute in-plane distances of centres from the foot's rim, world units; negative below the foot."""
    tree = KDTree(layer.projected(foot.means).numpy())
    apart, nearest = tree.query(layer.projected(gaussians.means).numpy())
    return torch.from_numpy(apart).float() - foot.scales.median(1).values[torch.from_numpy(nearest)]


def _factors(around: Gaussians, foot: Gaussians, layer: _Layer, *, radius: float) -> Float[Tensor, "n"]:
    """Compute factors on the heights of n Gaussians; 1 leaves a Gaussian unchanged."""
    heights, deepest = layer.heights(around.means), _DEEPEST * layer.deviation
    in_layer = (heights.abs() < deepest) & (layer.extents(around) < deepest)
    free = _distance_from(foot, around, layer) - around.scales.max(1).values
    # the layer's top, two deviations above its middle, comes down to the slope
    factor = (_SLOPE * free / (2 * layer.deviation)).clamp(_FLATTEST, 1)
    factor[~in_layer] = 1
    reached = (factor < 1).nonzero()[:, 0]
    standing = _evenly(around.select((heights > -deepest) & (heights < radius)), 2 * _MAX_USED)
    if standing.count < 2 * _NEIGHBOURS:
        return torch.ones_like(factor)
    tree = KDTree(layer.projected(standing.means).numpy())
    beside = tree.query(layer.projected(around.means[reached]).numpy(), k=_NEIGHBOURS)[1]
    levels = layer.heights(standing.means)[torch.from_numpy(beside)].mean(1)
    uneven = (levels.abs() / layer.deviation - _LEVEL).clamp(0, 1)
    # twice the fit's neighbours: a single noisy normal would leave its Gaussian in front of the foot
    normals = _normals(around.select(reached), standing, 2 * _NEIGHBOURS)
    sideways = (normals @ layer.normal).abs() < _MIN_FACING
    factor[reached] = torch.where(sideways, 1, torch.maximum(factor[reached], uneven))
    return factor


def _contact_layer(around: Gaussians, opaque: Gaussians, sphere: BoundingSphere) -> _Layer | None:
    """Fit the layer with most surface near an object's Gaussians; None without a surface."""
    around = _evenly(around.select(around.opacities > _OPAQUE), 5 * _MAX_USED)
    if not around.count:
        return None
    reach = _REACH * sphere.radius
    apart = KDTree(opaque.means.numpy()).query(around.means.numpy(), distance_upper_bound=reach)[0]
    near = _evenly(around.select(torch.from_numpy(apart) < reach), _MAX_USED)
    if near.count < _NEIGHBOURS:
        return None
    weights = near.opacities * near.scales.sort(1).values[:, 1:].prod(1)
    normals = _normals(near, near, _NEIGHBOURS)
    normal = normals[0]
    agreement = torch.ones_like(weights)
    for _ in range(4):  # the most frequent axis: of a floor and a wall, the one with more surface
        scatter = torch.einsum("n,ni,nj->ij", weights * agreement, normals, normals)
        normal = torch.linalg.eigh(scatter).eigenvectors[:, -1]
        agreement = (normals @ normal) ** 8
    facing = (normals @ normal).abs() > _MIN_FACING
    return _fitted_layer(near, weights, facing, normal, radius=sphere.radius)


def _normals(gaussians: Gaussians, among: Gaussians, count: int) -> Float[Tensor, "n 3"]:
    """Compute normals of either sign: the shortest axis of the nearest centres' covariance plus the Gaussian's own."""
    near = KDTree(among.means.numpy()).query(gaussians.means.numpy(), k=count)[1]
    centers = among.means[torch.from_numpy(near)]
    offsets = centers - centers.mean(1, keepdim=True)
    covariances = offsets.transpose(1, 2) @ offsets / count + gaussians.covariances
    return torch.linalg.eigh(covariances).eigenvectors[:, :, 0]


def _fitted_layer(
    near: Gaussians,
    weights: Float[Tensor, "n"],
    facing: Bool[Tensor, "n"],
    normal: Float[Tensor, "3"],
    *,
    radius: float,
) -> _Layer | None:
    """Fit a plane to the Gaussians that face it, in rounds that keep only those near the last plane."""
    means, weights = near.means.double(), weights.double()
    on_plane, middle = weights * facing, means.mean(0)
    for tolerance in _TOLERANCES:
        levels = means @ normal.to(means)
        on_plane = on_plane * ((levels - _median(levels, on_plane)).abs() < tolerance * radius)
        if int((on_plane > 0).sum()) < _NEIGHBOURS:
            return None
        middle = on_plane @ means / on_plane.sum()
        offsets = means - middle
        normal = least_squares_normal(on_plane.sqrt()[:, None] * offsets).float()
    if float(on_plane.sum()) < 0.25 * float(weights.sum()):  # most of the surface lies elsewhere, as in a bush
        return None
    layer = _Layer(normal, float(middle.float() @ normal), 0.0)
    variances = layer.heights(near.means) ** 2 + layer.extents(near) ** 2
    return replace(layer, deviation=float((on_plane @ variances.double() / on_plane.sum()).sqrt()))


def _median(values: Float[Tensor, "n"], weights: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    """Compute the weighted median."""
    order = values.argsort()
    filled = weights[order].cumsum(0)
    return values[order[int((filled < 0.5 * filled[-1]).sum())]]


def _flattened(gaussians: Gaussians, layer: _Layer, factor: Float[Tensor, "n"], *, level: float) -> Gaussians:
    """Scale heights over `level` and extents along the normal by `factor`."""
    heights = layer.heights(gaussians.means)
    shift = (1 - factor) * (level - heights)
    squash = torch.eye(3) - (1 - factor)[:, None, None] * torch.outer(layer.normal, layer.normal)
    half = (squash @ (gaussians.rotations * gaussians.scales[:, None, :])).double()
    widths, axes = torch.linalg.eigh(half @ half.transpose(1, 2))
    axes = axes * torch.linalg.det(axes).sign()[:, None, None]
    # thinner ones than this exist only in broken scenes
    thinnest = 1e-6 * gaussians.scales.max(1).values[:, None].double()
    return replace(
        gaussians,
        means=gaussians.means + shift[:, None] * layer.normal,
        log_scales=torch.maximum(widths.clamp_min(0).sqrt(), thinnest).log().float(),
        quaternions=quaternion_from_rotation(axes.float()),
    )
