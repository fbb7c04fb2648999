"""Reference renderer in plain torch operations: every pixel against every Gaussian.

Written from the 3DGS paper's formulas, for small scenes, in the dtype of its input (float64 in the tests).
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering import Render, RenderOptions

MIN_ALPHA, MAX_ALPHA = 1 / 255, 0.99


def projection(
    gaussians: Gaussians, camera: Cameras, options: RenderOptions
) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2 2"], Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Return centres in pixels, covariances in pixels^2 after the low-pass, opacities, depths."""
    slope, depth, focal, principal = seen_centers(gaussians, camera)
    sharp = covariance_on_screen(gaussians, camera)[:, :2, :2]
    blurred = sharp + 0.3 * torch.eye(2).to(sharp)
    opacity = gaussians.opacities
    if options.low_pass == "antialiased":
        opacity = opacity * (torch.linalg.det(sharp).clamp_min(1e-12) / torch.linalg.det(blurred)).sqrt()
    return slope * focal + principal, blurred, opacity, depth


def seen_centers(gaussians: Gaussians, camera: Cameras) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return x / z and y / z (n 2) and depths (n) of the centres, focal lengths (2) and principal point (2)."""
    pose, k = camera.camera_from_world[0].to(gaussians.means), camera.intrinsics[0].to(gaussians.means)
    x_in_camera = gaussians.means @ pose[:3, :3].T + pose[:3, 3]
    return x_in_camera[:, :2] / x_in_camera[:, 2:], x_in_camera[:, 2], torch.stack([k[0, 0], k[1, 1]]), k[:2, 2]


def covariance_on_screen(gaussians: Gaussians, camera: Cameras) -> Float[Tensor, "n 3 3"]:
    """Return covariances of pixel x, pixel y and inverse depth, linearised at the centres."""
    slope, depth, focal, principal = seen_centers(gaussians, camera)
    size = camera.sizes[0].to(slope)
    margin = 0.15 * size / focal
    held = torch.maximum(torch.minimum(slope, (size - principal) / focal + margin), -principal / focal - margin)
    zero = torch.zeros_like(depth)
    jacobian = torch.stack(
        [
            torch.stack([focal[0] / depth, zero, -focal[0] * held[:, 0] / depth], -1),
            torch.stack([zero, focal[1] / depth, -focal[1] * held[:, 1] / depth], -1),
            torch.stack([zero, zero, -1 / depth**2], -1),
        ],
        1,
    )
    to_screen = jacobian @ camera.camera_from_world[0, :3, :3].to(jacobian)
    return to_screen @ gaussians.covariances @ to_screen.transpose(1, 2)


def pixels_from(centers: Float[Tensor, "n 2"], camera: Cameras) -> Float[Tensor, "h w n 2"]:
    """Return the offset of every pixel's middle from every centre, pixels."""
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    return torch.stack([x, y], -1)[:, :, None].to(centers) - centers


def inverse_depths(gaussians: Gaussians, camera: Cameras, options: RenderOptions) -> Float[Tensor, "h w n"]:
    """Return the mean of each Gaussian's inverse depth in each pixel."""
    center, blurred, _, depth = projection(gaussians, camera, options)
    covariance = covariance_on_screen(gaussians, camera)
    slope = torch.einsum("nij,nj->ni", torch.linalg.inv(blurred), covariance[:, :2, 2])
    away = pixels_from(center, camera)
    mean = 1 / depth + (away * slope).sum(-1)
    # no gradient if the centre is out of view, because the plane is extrapolated there
    size = camera.sizes[0].to(center)
    shown = ((center > -0.15 * size) & (center < 1.15 * size)).all(1)
    return torch.where(shown, mean, mean.detach())


def weights(
    gaussians: Gaussians, camera: Cameras, options: RenderOptions
) -> tuple[Float[Tensor, "h w m"], Float[Tensor, " m"]]:
    """Return the weight of every Gaussian in every pixel, nearest first, and the Gaussians' indices in that order."""
    center, covariance, opacity, depth = projection(gaussians, camera, options)
    order = torch.argsort(depth.detach(), stable=True)
    order = order[(depth >= options.near)[order]]
    center, covariance, opacity = center[order], covariance[order], opacity[order]
    away = pixels_from(center, camera)
    distance = torch.einsum("hwmi,mij,hwmj->hwm", away, torch.linalg.inv(covariance), away)
    alpha = opacity * torch.exp(-0.5 * distance)
    alpha = torch.where(alpha >= MIN_ALPHA, alpha.clamp_max(MAX_ALPHA), 0)
    through = torch.cumprod(1 - alpha, -1)
    before = torch.cat([torch.ones_like(through[..., :1]), through[..., :-1]], -1)
    return alpha * before, order


def render(
    gaussians: Gaussians,
    camera: Cameras,
    *,
    features: Float[Tensor, "n f"],
    options: RenderOptions = RenderOptions(),
) -> Render:
    """Return every output for one camera; `visible` marks Gaussians with weight in a pixel."""
    weight, order = weights(gaussians, camera, options)
    inverse = inverse_depths(gaussians, camera, options)[..., order]
    offset = gaussians.means - camera.centers[0].to(gaussians.means)
    colors = spherical_harmonics.colors(gaussians.sh, torch.nn.functional.normalize(offset, dim=-1))
    axis = gaussians.log_scales.detach().argmin(-1)
    normal = gaussians.rotations[torch.arange(gaussians.count), :, axis]
    normal = torch.where((normal * offset).sum(-1, keepdim=True) > 0, -normal, normal)
    alpha = weight.sum(-1)
    blended_normal = weight @ normal[order]
    covered = weight.cumsum(-1)
    at_center = 1 / projection(gaussians, camera, options)[3][order]
    bounded = torch.minimum(torch.maximum(inverse, at_center / 4), 4 * at_center)
    middle = bounded.gather(-1, (covered > 0.5).int().argmax(-1, keepdim=True))[..., 0]
    background = torch.tensor(options.background).to(alpha)
    visible = torch.zeros(gaussians.count, dtype=torch.bool)
    visible[order] = (weight > 0).any(0).any(0)
    return Render(
        alpha=alpha[None],
        visible=visible[None],
        pictures={
            "color": (weight @ colors[order] + (1 - alpha)[..., None] * background)[None],
            "depth": torch.where(covered[..., -1] > 0.5, 1 / middle, 0)[None].detach(),
            "inverse_depth": (weight * inverse).sum(-1)[None],
            "normal": torch.nn.functional.normalize(blended_normal, dim=-1)[None],
            "features": (weight @ features[order])[None],
        },
    )


def undecided(gaussians: Gaussians, camera: Cameras, options: RenderOptions) -> Bool[Tensor, "h w"]:
    """Return pixels that rounding to float32 may decide otherwise: an alpha within 1e-4 of either of its bounds."""
    center, covariance, opacity, _ = projection(gaussians, camera, options)
    away = pixels_from(center, camera)
    alpha = opacity * torch.exp(-0.5 * torch.einsum("hwmi,mij,hwmj->hwm", away, torch.linalg.inv(covariance), away))
    return ((alpha / MIN_ALPHA - 1).abs() < 1e-4).any(-1) | ((alpha / MAX_ALPHA - 1).abs() < 1e-4).any(-1)
