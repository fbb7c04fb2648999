"""Contact of objects with what they stand on: around an object's foot the support's layer of Gaussians is flattened.

A reconstructed floor or table is a layer of Gaussians as thick as its noise. Those of them that reach into the air are
blended in front of an object that stands on it. The layer's plane is fitted by weighted least squares, and heights over
it are scaled down, the more, the nearer to the foot. From straight above, a flattened layer looks the same.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere, bounding_sphere
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.planes import least_squares_normal
from splatgraft.core.rotations import quaternion_from_rotation

_OPAQUE = 0.1  # opacity above which a Gaussian counts as part of a surface, as for a bounding sphere
_FIT_TOLERANCES = (0.4, 0.25, 0.2)  # object radii; distance from the plane of the Gaussians that each fit takes

# what counts as a contact layer, and how far it is flattened; set by hand on rendered scenes
_REACH = 0.35  # object radii: the plane is fitted to the target's Gaussians within this distance of the object's
_NEIGHBOURS = 24  # gaussians whose centres and shapes give the normal of one; fewer in all are no contact layer
_MAX_USED = 2000
"""Gaussians of the target, and of the object, that the fit uses: even ones of the list, where there are more. Twice
as many show where the scene is level."""
_MAX_TILT = 0.5  # largest sine of the angle between the plane and the surface at a Gaussian that the plane is fitted to
_MIN_SHARE = 0.25
"""Smallest share of the surface within reach that lies on the plane; less, as in a bush, is no contact layer."""
_TOP = 2.0  # standard deviations of the heights from the layer's middle to its top
_DEEPEST = 3.0
"""Standard deviations from the middle up to which a Gaussian belongs to the layer; an object whose base is higher
floats."""
_LEVEL = 0.5
"""Standard deviations of the heights by which the mean of the Gaussians beside one in the plane may be off the
middle; where it is off by one more, as at a book or a cup on the table, nothing is flattened."""
_FOOT = 0.2  # object radii above its base up to which an object is its foot
_SLOPE = 0.2
"""Tangent of the elevation, 11 degrees, of the lowest camera from which the whole foot is visible: a flattened layer
rises from the foot by this slope."""
_FLATTEST = 0.2  # least factor on heights; measured: a flatter layer covers no less


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
    """Flatten the layers that the placed objects stand on, so that they do not cover the objects' feet.

    Gaussians away from every foot, and all around an object that floats or that stands on no surface, keep every bit;
    of the others centres and shapes change, not opacities and colours.
    """
    on_cpu = flattened = target.to("cpu")
    for one in objects:
        opaque = one.select(one.opacities > _OPAQUE).to("cpu")
        if opaque.count:
            flattened = _flattened_under(flattened, _evenly(opaque, _MAX_USED), bounding_sphere(opaque))
    return target if flattened is on_cpu else flattened.to(target.device)


def _evenly(gaussians: Gaussians, count: int) -> Gaussians:
    """At most `count` of some Gaussians, spread evenly over the list."""
    if gaussians.count <= count:
        return gaussians
    return gaussians.select(torch.linspace(0, gaussians.count - 1, count).long())


def _flattened_under(target: Gaussians, opaque: Gaussians, sphere: BoundingSphere) -> Gaussians:
    away = (target.means - sphere.center).norm(dim=1) - 2 * target.scales.max(1).values
    near = (away < 2 * sphere.radius).nonzero()[:, 0]
    around = target.select(near)
    layer = _contact_layer(around, opaque, sphere)
    if layer is None:
        return target
    if float(layer.heights(sphere.center[None])) < 0:
        layer = replace(layer, normal=-layer.normal, offset=-layer.offset)
    heights = layer.heights(opaque.means)
    base = float((heights - layer.extents(opaque)).min())
    if base > _DEEPEST * layer.deviation:
        return target
    # a foot that is buried deeper than the surface is known is so on purpose: no hole is dug for it
    base = max(base, -layer.deviation)
    foot = opaque.select(heights < base + _FOOT * sphere.radius)
    factor = _factors(around, foot, layer, radius=sphere.radius)
    changed = (factor < 1).nonzero()[:, 0]
    flat = _flattened(around.select(changed), layer, factor[changed], level=min(base, 0.0))
    rows = near[changed]

    def with_rows(old: Tensor, new: Tensor) -> Tensor:
        return old.index_copy(0, rows, new)

    return replace(
        target,
        means=with_rows(target.means, flat.means),
        log_scales=with_rows(target.log_scales, flat.log_scales),
        quaternions=with_rows(target.quaternions, flat.quaternions),
    )


def _distance_from(foot: Gaussians, gaussians: Gaussians, layer: _Layer) -> Float[Tensor, "n"]:
    """Distance of centres from a foot's rim in the layer's plane, world units; negative below the foot's Gaussians."""
    tree = KDTree(layer.projected(foot.means).numpy())
    apart, nearest = tree.query(layer.projected(gaussians.means).numpy())
    return torch.from_numpy(apart).float() - foot.scales.median(1).values[torch.from_numpy(nearest)]


def _factors(around: Gaussians, foot: Gaussians, layer: _Layer, *, radius: float) -> Float[Tensor, "n"]:
    """Factors on the heights of n Gaussians: 1 away from the foot, outside of the layer, and where it is not bare."""
    heights, deepest = layer.heights(around.means), _DEEPEST * layer.deviation
    in_layer = (heights.abs() < deepest) & (layer.extents(around) < deepest)
    free = _distance_from(foot, around, layer) - around.scales.max(1).values
    factor = (_SLOPE * free / (_TOP * layer.deviation)).clamp(_FLATTEST, 1)
    factor[~in_layer] = 1
    reached = (factor < 1).nonzero()[:, 0]
    standing = _evenly(around.select((heights > -deepest) & (heights < radius)), 2 * _MAX_USED)
    if standing.count < _NEIGHBOURS:
        return torch.ones_like(factor)
    tree = KDTree(layer.projected(standing.means).numpy())
    beside = tree.query(layer.projected(around.means[reached]).numpy(), k=_NEIGHBOURS)[1]
    levels = layer.heights(standing.means)[torch.from_numpy(beside)].mean(1)
    uneven = (levels.abs() / layer.deviation - _LEVEL).clamp(0, 1)
    factor[reached] = torch.maximum(factor[reached], uneven)
    return factor


def _contact_layer(around: Gaussians, opaque: Gaussians, sphere: BoundingSphere) -> _Layer | None:
    """The layer next to an object's Gaussians that most of their surface belongs to; None where that is no surface."""
    around = _evenly(around.select(around.opacities > _OPAQUE), 5 * _MAX_USED)
    if not around.count:
        return None
    reach = _REACH * sphere.radius
    apart = KDTree(opaque.means.numpy()).query(around.means.numpy(), distance_upper_bound=reach)[0]
    near = _evenly(around.select(torch.from_numpy(apart) < reach), _MAX_USED)
    if near.count < _NEIGHBOURS:
        return None
    weights = near.opacities * near.scales.sort(1).values[:, 1:].prod(1)
    normals = _normals(near, _NEIGHBOURS)
    normal = normals[0]
    agreement = torch.ones_like(weights)
    for _ in range(4):  # the axis that most normals are near to, of floor and wall the one with more Gaussians
        scatter = torch.einsum("n,ni,nj->ij", weights * agreement, normals, normals)
        normal = torch.linalg.eigh(scatter).eigenvectors[:, -1]
        agreement = (normals @ normal) ** 8
    tolerances = [tolerance * sphere.radius for tolerance in _FIT_TOLERANCES]
    facing = (normals @ normal).abs() > (1 - _MAX_TILT**2) ** 0.5
    return _fitted_layer(near, weights, facing, normal, tolerances=tolerances)


def _normals(gaussians: Gaussians, neighbours: int) -> Float[Tensor, "n 3"]:
    """Shortest axis of the covariance of each Gaussian's neighbours' centres and of its own; of either sign."""
    near = KDTree(gaussians.means.numpy()).query(gaussians.means.numpy(), k=neighbours)[1]
    centers = gaussians.means[torch.from_numpy(near)]
    offsets = centers - centers.mean(1, keepdim=True)
    covariances = offsets.transpose(1, 2) @ offsets / neighbours + gaussians.covariances
    return torch.linalg.eigh(covariances).eigenvectors[:, :, 0]


def _fitted_layer(
    near: Gaussians,
    weights: Float[Tensor, "n"],
    facing: Bool[Tensor, "n"],
    normal: Float[Tensor, "3"],
    *,
    tolerances: Sequence[float],
) -> _Layer | None:
    """The layer around the plane nearest to the Gaussians that face it, in repeated fits to those near the last one."""
    means, weights = near.means.double(), weights.double()
    on_plane, middle = weights * facing, means.mean(0)
    for tolerance in tolerances:
        levels = means @ normal.to(means)
        on_plane = on_plane * ((levels - _median(levels, on_plane)).abs() < tolerance)
        if int((on_plane > 0).sum()) < _NEIGHBOURS:
            return None
        middle = on_plane @ means / on_plane.sum()
        offsets = means - middle
        normal = least_squares_normal(on_plane.sqrt()[:, None] * offsets).float()
    if float(on_plane.sum()) < _MIN_SHARE * float(weights.sum()):
        return None
    layer = _Layer(normal, float(middle.float() @ normal), 0.0)
    variances = layer.heights(near.means) ** 2 + layer.extents(near) ** 2
    return replace(layer, deviation=float((on_plane @ variances.double() / on_plane.sum()).sqrt()))


def _median(values: Float[Tensor, "n"], weights: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    """Weighted median."""
    order = values.argsort()
    filled = weights[order].cumsum(0)
    return values[order[int((filled < 0.5 * filled[-1]).sum())]]


def _flattened(gaussians: Gaussians, layer: _Layer, factor: Float[Tensor, "n"], *, level: float) -> Gaussians:
    """Heights over the layer's middle scaled by `factor`, centres and shapes; what is scaled to 0 comes to `level`."""
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
