"""Up direction and focus point of a capture, from its camera poses alone, by reweighted least squares."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.directions import tangents

WIDE_GAP_DEG = 60.0
"""Horizontal angle without photographs above which a gap is reported; set by hand."""
_ROUNDS = 10  # iterations of reweighting; this and the others are set by hand
_ROLL_RAD = 0.05  # roll above which a camera counts less: hand-held cameras are level to about three degrees
_MEAN_UP_WEIGHT = 0.01  # weight of the images' mean up, equal to that of horizontal axes that spread over 6 degrees
_GOES_ROUND = 0.35  # minimum middle eigenvalue of an axis's second moments: 0.5 for a circle, 0.35 for 135 degrees
_LEVEL = 0.1  # maximum ratio of the smallest to the middle eigenvalue, the flatness of the axis's directions
_MORE_LEVEL = 0.25  # maximum flatness relative to the other axis
_LOOKING_DOWN = 0.05  # minimum mean sine of the view's angle to the horizon; cameras look down, which gives the sign
_UP_AFTER = 0.5  # minimum cosine between up and the up of a turned image; views straight down stay below
_UP_BEFORE = 0.3  # maximum cosine between up and the up of an image before it is turned
_RESIDUAL_FLOOR = 0.1  # distance of an axis from the focus point, over the median, below which weights stop growing
_MIN_IN_FRONT = 0.7  # minimum share of cameras with the focus point in front of them


def estimate_up(cameras: Cameras) -> Float[Tensor, "3"]:
    """Estimate the world's unit up direction, perpendicular to the images' horizontal axes: most cameras are level.

    The images' mean up gives the sign, and the direction if all cameras face one way. Rolled cameras are outliers of an
    iteratively reweighted least-squares fit.
    """
    right, down, _ = cameras.world_from_camera[:, :3, :3].double().unbind(2)
    return _up_of(right, down).to(cameras.world_from_camera)


def _up_of(right: Float[Tensor, "v 3"], down: Float[Tensor, "v 3"]) -> Float[Tensor, "3"]:
    mean_up = torch.nn.functional.normalize(-down.mean(0), dim=0)
    up = mean_up
    for _ in range(_ROUNDS):
        weight = _ROLL_RAD / (_ROLL_RAD + (right @ up).abs())
        spread = (right * weight[:, None]).T @ right / weight.sum()
        prior = _MEAN_UP_WEIGHT * torch.eye(3, dtype=torch.float64)
        up = torch.nn.functional.normalize(torch.linalg.solve(spread + prior, _MEAN_UP_WEIGHT * mean_up), dim=0)
    return up


def quarter_turns(world_from_camera: Float[Tensor, "v 4 4"]) -> Int[Tensor, "v"]:
    """Estimate the counterclockwise quarter turns, 0 to 3, that set each image upright; 0 if that is not clear.

    If cameras go round an object, the images' horizontal axes lie in one plane, perpendicular to up. If the vertical
    axes lie in one plane instead, all images are on their side; then up is the side from which cameras look down.
    Single images are turned by the up direction of the others.
    """
    right, down, forward = world_from_camera[:, :3, :3].double().unbind(2)
    moments = [torch.linalg.eigh(axis.T @ axis / max(1, len(axis))) for axis in (right, down)]
    middle = moments[1].eigenvalues[1]
    flat_right, flat_down = (m.eigenvalues[0] / m.eigenvalues[1].clamp_min(1e-9) for m in moments)
    up = _up_of(right, down)
    if middle > _GOES_ROUND and flat_down < min(_LEVEL, _MORE_LEVEL * float(flat_right)):
        up = moments[1].eigenvectors[:, 0]
        looking = float((forward @ up).mean())
        if abs(looking) < _LOOKING_DOWN:
            return torch.zeros(len(right), dtype=torch.long)
        up = -math.copysign(1.0, looking) * up
    # cosine between up and the up of each image, by number of turns
    ups = torch.stack([-down, right, down, -right]) @ up
    clear = (ups.amax(0) > _UP_AFTER) & (ups[0] < _UP_BEFORE)
    return torch.where(clear, ups.argmax(0), 0)


def focus_point(cameras: Cameras) -> Float[Tensor, "3"]:
    """Compute the point nearest to all optical axes, world units (see `nearest_to_axes`).

    Raises:
        ValueError: The point lies behind many cameras, for example if the capture looks outwards.
    """
    point = nearest_to_axes(cameras, prior_weight=0.0)
    centers, forward = cameras.centers.double().cpu(), cameras.world_from_camera[:, :3, 2].double().cpu()
    in_front = float((((point - centers) * forward).sum(-1) > 0).double().mean())
    if in_front < _MIN_IN_FRONT:
        raise ValueError(
            f"cameras: expected most of them to look at one place, found a place in front of only {in_front:.0%};"
            " name the place"
        )
    return point.to(cameras.world_from_camera)


def nearest_to_axes(cameras: Cameras, *, prior_weight: float) -> Float[Tensor, "3"]:
    """Compute the point nearest to most optical axes by iteratively reweighted least squares.

    Args:
        cameras: v cameras.
        prior_weight: Weight, over that of the axes, of a point in front of the mean camera, at twice their spread.
            This point decides if the angles between the axes are below about sqrt(prior_weight) radians.

    Returns:
        The point, world units, float64 on the CPU. It may lie behind cameras that look outwards. Without a prior, it is
        the one nearest to the origin if the axes are parallel.
    """
    centers, forward = cameras.centers.double().cpu(), cameras.world_from_camera[:, :3, 2].double().cpu()
    spread = max(float((centers - centers.mean(0)).norm(dim=1).max()), 1e-3)
    prior = (centers + 2 * spread * forward).mean(0)
    identity = torch.eye(3, dtype=torch.float64)
    across = identity - forward[:, :, None] * forward[:, None, :]
    weight, point = torch.ones(len(cameras), dtype=torch.float64), prior
    for _ in range(_ROUNDS):
        of_prior = prior_weight * weight.sum()
        wanted = torch.einsum("v,vij,vj->i", weight, across, centers) + of_prior * prior
        normal = (weight[:, None, None] * across).sum(0) + of_prior * identity
        point = torch.linalg.lstsq(normal, wanted[:, None], rcond=1e-9).solution[:, 0]
        miss = torch.einsum("vij,vj->vi", across, point - centers).norm(dim=-1)
        weight = 1 / (miss + _RESIDUAL_FLOOR * miss.median() + 1e-9)
    return point


def widest_gap(cameras: Cameras, middle: Float[Tensor, "3"]) -> tuple[float, tuple[str, str]]:
    """Find the widest horizontal angle around a point in which no photograph was taken.

    Args:
        cameras: Cameras of the photographs.
        middle: The point, world units.

    Returns:
        The angle, degrees, and the names of the photographs on either side of it.
    """
    tangent, bitangent = tangents(estimate_up(cameras))
    away = cameras.centers - middle
    turns = torch.atan2(away @ bitangent, away @ tangent)
    order = turns.argsort()
    gaps = torch.remainder(turns[order].roll(-1) - turns[order], 2 * math.pi)
    if len(cameras) == 1:
        gaps += 2 * math.pi
    first = int(gaps.argmax())
    ends = order[first], order[(first + 1) % len(order)]
    return math.degrees(float(gaps[first])), (cameras.names[int(ends[0])], cameras.names[int(ends[1])])
