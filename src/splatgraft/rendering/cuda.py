"""Rendering on CUDA by gsplat's `rasterization`."""

from collections.abc import Callable
from collections.abc import Set as AbstractSet
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering.interface import Output, Render, RenderOptions, assemble_render


def render(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    outputs: AbstractSet[Output],
    features: Float[Tensor, "n f"] | None,
    options: RenderOptions,
) -> Render:
    """`rendering.render` for tensors on a CUDA device.

    Raises: ValueError where gsplat is not installed.
    """
    views = [_channels(gaussians, camera, outputs, features) for camera in cameras]
    drawn = [_draw(gaussians, camera, values, options) for camera, values in zip(cameras, views, strict=True)]
    image, alpha, visible = (torch.stack(parts) for parts in zip(*drawn, strict=True))
    return assemble_render(
        image.permute(0, 3, 1, 2), alpha, visible, outputs=outputs, has_features=features is not None, options=options
    )


class FrozenView:
    """`ViewOperator` on CUDA: gsplat keeps no tile lists between calls, so each call rasterises again."""

    def __init__(self, gaussians: Gaussians, camera: Cameras, options: RenderOptions, _min_row_weight: float) -> None:
        """Freeze geometry and opacity; gsplat leaves no row out."""
        self._gaussians, self._camera, self._options = gaussians.map(Tensor.detach), camera, options
        _, self.alpha, _ = self._draw(gaussians.means.new_zeros(gaussians.count, 1))

    @cached_property
    def visible(self) -> Bool[Tensor, "n"]:
        """Which Gaussians have any weight in the view."""
        return (self.blend_transpose(torch.ones_like(self.alpha)[..., None]) > 0)[:, 0]

    def blend(self, values: Float[Tensor, "n c"]) -> Float[Tensor, "h w c"]:
        """W values, over black; differentiable in `values`."""
        return self._draw(values)[0]

    def blend_transpose(self, image: Float[Tensor, "h w c"]) -> Float[Tensor, "n c"]:
        """W^T image: the gradient of <W values, image> to `values`."""
        with torch.enable_grad():
            values = image.new_zeros(self._gaussians.count, image.shape[-1], requires_grad=True)
            return torch.autograd.grad(self._draw(values)[0], values, image)[0]

    def blend_and_transpose(
        self, values: Float[Tensor, "n 3"], weights: Float[Tensor, "h w"] | None
    ) -> Float[Tensor, "n 3"]:
        """W^T (weights * W values); weights of 1 where none are given."""
        image = self.blend(values)
        return self.blend_transpose(image if weights is None else image * weights[..., None])

    def transpose_residual(self, values: Float[Tensor, "n"], target: Float[Tensor, "h w"]) -> Float[Tensor, "n"]:
        """W^T (target - W values)."""
        return self.blend_transpose(target[..., None] - self.blend(values[:, None]))[:, 0]

    def _draw(self, values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return _draw(self._gaussians, self._camera, values, self._options)


def _draw(
    gaussians: Gaussians, camera: Cameras, values: Tensor, options: RenderOptions
) -> tuple[Tensor, Tensor, Tensor]:
    """Blended `values (n, c)` as (h, w, c) over black, alpha (h, w) and what is visible (n,), for one camera."""
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
    """What `CHANNEL_COUNTS` lists, per Gaussian."""
    offset = gaussians.means - camera.centers[0].to(gaussians.means)
    parts = []
    if "color" in outputs:
        directions = torch.nn.functional.normalize(offset, dim=-1)
        parts.append(spherical_harmonics.colors(gaussians.sh, directions))
    if "depth" in outputs:
        forward = camera.world_from_camera[0, :3, 2].to(gaussians.means)
        parts.append((offset @ forward)[:, None])
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
