"""Rendering on CUDA by gsplat's `rasterization`, and median depth, which gsplat lacks, by the CPU's kernels."""

from collections.abc import Callable
from collections.abc import Set as AbstractSet
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering import cpu
from splatgraft.rendering.interface import Output, Render, RenderOptions, assemble_render


def render(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    outputs: AbstractSet[Output],
    features: Float[Tensor, "n f"] | None,
    options: RenderOptions,
) -> Render:
    """Render as `rendering.render` does, for tensors on a CUDA device.

    Raises:
        ValueError: gsplat is not installed.
    """
    drawn = []
    for camera in cameras:
        image, alpha, visible = _draw(gaussians, camera, _channels(gaussians, camera, outputs, features), options)
        if "inverse_depth" in outputs:
            planes = _draw(gaussians, camera, inverse_depth_planes(gaussians, camera, options), options)[0]
            image = torch.cat([image, (planes * camera.rays()[..., [2, 0, 1]].to(planes)).sum(-1, keepdim=True)], -1)
        drawn.append((image.permute(2, 0, 1), alpha, _median_depth(gaussians, camera, outputs, options), visible))
    image, alpha, depth, visible = (torch.stack(parts) for parts in zip(*drawn, strict=True))
    return assemble_render(image, alpha, depth, visible, outputs=outputs, options=options)


def _median_depth(
    gaussians: Gaussians, camera: Cameras, outputs: AbstractSet[Output], options: RenderOptions
) -> Float[Tensor, "h w"]:
    """Compute median depth by the CPU's kernels, because gsplat has none for 3D Gaussians; empty if not requested."""
    if "depth" not in outputs:
        return gaussians.means.new_zeros(0, 0)
    on_cpu = gaussians.map(lambda tensor: tensor.detach().cpu())
    drawn = cpu.render(on_cpu, camera.to("cpu"), outputs=frozenset({"depth"}), features=None, options=options)
    return drawn.depth[0].to(gaussians.device)


def inverse_depth_planes(gaussians: Gaussians, camera: Cameras, options: RenderOptions) -> Float[Tensor, "n 3"]:
    """Compute each Gaussian's inverse depth as a linear function of the pixel, as `cpu_project.project` does.

    Returns:
        Coefficients of 1, (x - cx) / fx and (y - cy) / fy, per world unit.
    """
    pose, k = camera.camera_from_world[0].to(gaussians.means), camera.intrinsics[0].to(gaussians.means)
    in_camera = gaussians.means @ pose[:3, :3].T + pose[:3, 3]
    z = in_camera[:, 2].clamp_min(options.near)
    center, focal = in_camera[:, :2] / z[:, None], torch.stack([k[0, 0], k[1, 1]])
    size, principal = camera.sizes[0].to(z), k[:2, 2]
    low, high = -principal / focal - 0.15 * size / focal, (size - principal) / focal + 0.15 * size / focal
    held = torch.maximum(torch.minimum(center, high), low)
    zero = torch.zeros_like(z)
    rows = [
        torch.stack([1 / z, zero, -held[:, 0] / z], -1),
        torch.stack([zero, 1 / z, -held[:, 1] / z], -1),
        torch.stack([zero, zero, -1 / z.square()], -1),
    ]
    axes = torch.stack(rows, 1) @ pose[:3, :3] @ (gaussians.rotations * gaussians.scales[:, None])
    covariance = axes @ axes.mT
    blurred = covariance[:, :2, :2] + torch.diag(options.low_pass_px2 / focal.square())
    slope = torch.linalg.solve(blurred, covariance[:, :2, 2])
    at_axis = 1 / z - (slope * center).sum(1)
    planes = torch.cat([at_axis[:, None], slope], 1)
    # the plane of a Gaussian is extrapolated if its centre is out of view: no gradient, as in the CPU's kernels
    return torch.where((held == center).all(1, keepdim=True), planes, planes.detach())


class FrozenView:
    """`ViewOperator` on CUDA; each call rasterises again, because gsplat keeps no tile lists between calls."""

    def __init__(self, gaussians: Gaussians, camera: Cameras, options: RenderOptions, _min_row_weight: float) -> None:
        """Freeze geometry and opacity; no row is left out."""
        self._gaussians, self._camera, self._options = gaussians.map(Tensor.detach), camera, options
        _, self.alpha, _ = self._draw(gaussians.means.new_zeros(gaussians.count, 1))

    @cached_property
    def visible(self) -> Bool[Tensor, "n"]:
        """Whether each Gaussian has weight in some pixel."""
        return (self.blend_transpose(torch.ones_like(self.alpha)[..., None]) > 0)[:, 0]

    def blend(self, values: Float[Tensor, "n c"]) -> Float[Tensor, "h w c"]:
        """W values, over black; differentiable in `values`."""
        return self._draw(values)[0]

    def blend_transpose(self, image: Float[Tensor, "h w c"]) -> Float[Tensor, "n c"]:
        """W^T image: the gradient of <W values, image> to `values`."""
        with torch.enable_grad():
            values = image.new_zeros(self._gaussians.count, image.shape[-1], requires_grad=True)
            return torch.autograd.grad(self._draw(values)[0], values, image)[0]

    def blend_and_transpose(self, values: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """W^T W values."""
        return self.blend_transpose(self.blend(values))

    def transpose_residual(self, values: Float[Tensor, "n"], target: Float[Tensor, "h w"]) -> Float[Tensor, "n"]:
        """W^T (target - W values)."""
        return self.blend_transpose(target[..., None] - self.blend(values[:, None]))[:, 0]

    def _draw(self, values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return _draw(self._gaussians, self._camera, values, self._options)


def _draw(
    gaussians: Gaussians, camera: Cameras, values: Tensor, options: RenderOptions
) -> tuple[Tensor, Tensor, Tensor]:
    """Blend `values (n, c)` to (h, w, c) over black; also gives alpha (h, w) and whether Gaussians are visible (n,)."""
    if gaussians.count == 0:
        blank = values.new_zeros(camera.height, camera.width, values.shape[1])
        return blank, blank.new_zeros(blank.shape[:2]), torch.zeros(0, dtype=torch.bool, device=values.device)
    image, alpha, info = _rasterization()(
        means=gaussians.means,
        quats=gaussians.quaternions,
        scales=gaussians.scales,
        opacities=gaussians.opacities,
        colors=values,
        viewmats=camera.camera_from_world.to(gaussians.means),
        Ks=camera.intrinsics.to(gaussians.means),
        width=camera.width,
        height=camera.height,
        near_plane=options.near,
        eps2d=options.low_pass_px2,
        packed=False,
        render_mode="RGB",
        rasterize_mode=options.low_pass,
    )
    return image[0], alpha[0, ..., 0], (info["radii"][0] > 0).reshape(gaussians.count, -1).all(-1)


def _channels(
    gaussians: Gaussians, camera: Cameras, outputs: AbstractSet[Output], features: Tensor | None
) -> Float[Tensor, "n c"]:
    """Compute the channels of `CHANNEL_COUNTS` per Gaussian, then the features."""
    offset = gaussians.means - camera.centers[0].to(gaussians.means)
    parts = []
    if "color" in outputs:
        directions = torch.nn.functional.normalize(offset, dim=-1)
        parts.append(spherical_harmonics.colors(gaussians.sh, directions))
    if "normal" in outputs:
        axes = gaussians.log_scales.detach().argmin(-1)
        normal = gaussians.rotations[torch.arange(gaussians.count, device=axes.device), :, axes]
        parts.append(torch.where((normal * offset).sum(-1, keepdim=True) > 0, -normal, normal))
    if features is not None:
        parts.append(features)
    # gsplat draws at least one channel
    return torch.cat(parts, -1) if parts else gaussians.means.new_zeros(gaussians.count, 1)


def _rasterization() -> Callable:
    try:
        from gsplat import rasterization
    except ImportError as error:
        raise ValueError(
            "rendering on CUDA: expected gsplat, found none; install it with: pip install 'splatgraft[cuda]'"
        ) from error
    return rasterization
