"""Rendering of Gaussians: options, results, and the choice of the implementation by device."""

from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType
from typing import Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians

Output = Literal["color", "depth", "inverse_depth", "normal"]
CHANNEL_COUNTS: dict[Output, int] = {"color": 3, "inverse_depth": 1, "normal": 3}
"""Number of channels of each blended output, in this order; features follow. Median depth is not blended."""


@dataclass(frozen=True)
class RenderOptions:
    """Options of the renderer."""

    low_pass: Literal["classic", "antialiased"] = "classic"
    """Both widen the covariance; `antialiased` also scales opacity by the area ratio (Mip-Splatting)."""
    low_pass_px2: float = 0.3
    """Variance added to projected covariances, pixels squared; 0.3 (3DGS) for whole images."""
    near: float = 0.01
    """Depth below which Gaussians, by their centres, are not drawn, world units."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """sRGB behind the scene."""


@dataclass(frozen=True)
class Render:
    """Pictures of one scene from v cameras of one size; reading an output that was not requested raises ValueError."""

    alpha: Float[Tensor, "v h w"]
    """Accumulated opacity in [0, 1]."""
    visible: Bool[Tensor, "v n"]
    """Whether each Gaussian is in some tile's list of that view."""
    pictures: Mapping[str, Float[Tensor, "v h w ..."]]
    """Pictures by name: the requested outputs, and "features" if features were given."""

    @property
    def color(self) -> Float[Tensor, "v h w 3"]:
        """sRGB over the background, not clamped above."""
        return self._asked("color")

    @property
    def depth(self) -> Float[Tensor, "v h w"]:
        """Median depth along the optical axis, world units: the depth at which the transmittance falls below one half.

        It is 0 where alpha is below one half, and has no gradient.
        """
        return self._asked("depth")

    @property
    def inverse_depth(self) -> Float[Tensor, "v h w"]:
        """Blended inverse depth, not divided by alpha, per world unit; a Gaussian's inverse depth varies by pixel."""
        return self._asked("inverse_depth")

    @property
    def normal(self) -> Float[Tensor, "v h w 3"]:
        """World-frame unit normal towards the camera (shortest axes, blended, normalised); 0 where alpha is 0."""
        return self._asked("normal")

    @property
    def features(self) -> Float[Tensor, "v h w f"]:
        """Blended per-Gaussian features, not divided by alpha."""
        return self._asked("features")

    def _asked(self, name: str) -> Tensor:
        if name not in self.pictures:
            found = ", ".join(self.pictures) or "none"
            raise ValueError(f"render: expected {name} among the requested outputs, found {found}")
        return self.pictures[name]


@runtime_checkable
class ViewOperator(Protocol):
    """The fixed linear map W from Gaussian values to pixels of one view: geometry and opacity are frozen."""

    visible: Bool[Tensor, "n"]
    """Whether each Gaussian has weight in some pixel."""

    @property
    def alpha(self) -> Float[Tensor, "h w"]:
        """Accumulated opacity in [0, 1]."""
        ...

    def blend(self, values: Float[Tensor, "n c"]) -> Float[Tensor, "h w c"]:
        """W values, over black. Differentiable in `values`."""
        ...

    def blend_transpose(self, image: Float[Tensor, "h w c"]) -> Float[Tensor, "n c"]:
        """W^T image."""
        ...

    def blend_and_transpose(self, values: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """W^T W values."""
        ...

    def transpose_residual(self, values: Float[Tensor, "n"], target: Float[Tensor, "h w"]) -> Float[Tensor, "n"]:
        """W^T (target - W values)."""
        ...


def render(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    outputs: frozenset[Output] = frozenset({"color"}),
    features: Float[Tensor, "n f"] | None = None,
    options: RenderOptions = RenderOptions(),
) -> Render:
    """Render Gaussians by splatting (3DGS, sections 4 and 6); differentiable in every field and in `features`.

    Args:
        gaussians: n Gaussians, on the CPU (numba) or a CUDA device (gsplat).
        cameras: v cameras that share one image size.
        outputs: The outputs to render: color, depth, inverse_depth, normal; inverse_depth excludes normal.
        features: f values per Gaussian that are blended like colours; not with inverse_depth.
        options: Low-pass filter, near plane and background.

    Returns:
        The requested outputs, with opacity and visibility, on the device of `gaussians`.

    Raises:
        ValueError: The cameras' image sizes differ, gsplat is not installed, or inverse_depth is requested with
            normals or features.
    """
    if "inverse_depth" in outputs and (features is not None or not outputs <= {"color", "depth", "inverse_depth"}):
        raise ValueError("render: expected inverse_depth with color and depth alone, found normal or features")
    if "inverse_depth" in outputs:
        outputs = frozenset[Output]({*outputs, "color"})  # they are blended in one pass
    implementation = _implementation(gaussians)
    _ = cameras.width  # refuses images that cannot be stacked
    return implementation.render(gaussians, cameras, outputs=outputs, features=features, options=options)


def view_operator(
    gaussians: Gaussians,
    camera: Cameras,
    options: RenderOptions = RenderOptions(),
    *,
    min_row_weight: float = 0.0,
) -> ViewOperator:
    """Make the map from Gaussian values to the pixels of one camera; depth order and tile lists are computed once.

    Args:
        gaussians: n Gaussians, on the CPU or a CUDA device.
        camera: One camera.
        options: Low-pass filter and near plane.
        min_row_weight: Bound on a sum of weights; 0 is exact. In each tile of 16x16 pixels, a Gaussian's first and last
            rows are dropped while the weights of the row's 16 pixels add up to no more. Behind opaque surfaces this
            drops most rows. On CUDA no row is dropped.
    """
    return _implementation(gaussians).FrozenView(gaussians, camera, options, min_row_weight)


def surface_points(scene: Gaussians, camera: Cameras, pixels: Float[Tensor, "k 2"]) -> Float[Tensor, "k 3"]:
    """Find the points of the scene's surface behind pixels x, y; pixels without a surface are left out."""
    drawn = render(scene, camera, outputs=frozenset({"depth"}))
    pixels = pixels.to(drawn.depth)
    size = camera.sizes[0].to(pixels)
    pixels = torch.minimum(pixels.clamp_min(0), size - 1)
    column, row = pixels.long().unbind(-1)
    depth = drawn.depth[0][row, column]
    rays = torch.cat([pixels, torch.ones_like(pixels[:, :1])], 1) @ torch.linalg.inv(camera.intrinsics[0].to(pixels)).T
    pose = camera.world_from_camera[0].to(pixels)
    return ((rays * depth[:, None]) @ pose[:3, :3].T + pose[:3, 3])[depth > 0]


def _implementation(gaussians: Gaussians) -> ModuleType:
    # imported on first use, because numba and gsplat take seconds to load
    name = "cuda" if gaussians.device.type == "cuda" else "cpu"
    return import_module(f"splatgraft.rendering.{name}")


def assemble_render(
    image: Float[Tensor, "v c h w"],
    alpha: Float[Tensor, "v h w"],
    depth: Float[Tensor, "v *size"],
    visible: Bool[Tensor, "v n"],
    *,
    outputs: AbstractSet[Output],
    options: RenderOptions,
) -> Render:
    """Split blended channels, in the order of `CHANNEL_COUNTS` and then features, into a `Render`.

    Without the output `depth`, that argument is empty.
    """
    planes, at = {}, 0
    for name, width in CHANNEL_COUNTS.items():
        if name in outputs:
            planes[name], at = image[:, at : at + width], at + width
    made: dict[str, Tensor] = {}
    if "color" in outputs:
        color = planes["color"]
        if any(options.background):
            color = color + (1 - alpha)[:, None] * color.new_tensor(options.background)[:, None, None]
        made["color"] = color.permute(0, 2, 3, 1)
    if "depth" in outputs:
        made["depth"] = depth
    if "inverse_depth" in outputs:
        made["inverse_depth"] = planes["inverse_depth"][:, 0]
    if "normal" in outputs:
        normal = planes["normal"].permute(0, 2, 3, 1)
        squares = (normal * normal).sum(-1, keepdim=True)
        made["normal"] = normal / torch.where(squares > 0, squares, 1).sqrt()
    if image.shape[1] > at:
        made["features"] = image[:, at:].permute(0, 2, 3, 1)
    return Render(alpha=alpha, visible=visible, pictures=made)
