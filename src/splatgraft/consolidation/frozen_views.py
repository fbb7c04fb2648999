"""The views that a consolidation works on: frozen operators, kept within a byte budget, and lazily read targets.

Knows which Gaussians move and which part of each view they touch. Knows nothing about losses or solvers.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatgraft.consolidation.options import ImageSequence
from splatgraft.core import spherical_harmonics
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering import RenderOptions, ViewOperator, view_operator

Window = tuple[int, int, int, int]
"""Left, top, right, bottom, pixels; right and bottom excluded."""


@dataclass(frozen=True)
class View:
    """The affine map from the colours of m moving Gaussians to the pixels of one view."""

    operator: ViewOperator
    """From the values of all n Gaussians to pixels."""
    basis: Float[Tensor, "m k"]
    """Spherical harmonics towards each moving Gaussian."""
    still: Float[Tensor, "h w 3"] | None
    """What the other Gaussians and the background give; None where they give nothing."""
    moving: Int[Tensor, "m"] | None
    """Indices of the moving Gaussians; None where all n move."""

    @property
    def visible(self) -> Bool[Tensor, "m"]:
        """Which moving Gaussians the view sees."""
        return self.operator.visible if self.moving is None else self.operator.visible[self.moving]

    def colors(self, sh: Float[Tensor, "m k 3"]) -> Float[Tensor, "m 3"]:
        """The expansion towards this view, plus one half, not clamped."""
        return torch.einsum("mk,mkc->mc", self.basis, sh) + 0.5

    def blend(self, colors: Float[Tensor, "m c"]) -> Float[Tensor, "h w c"]:
        """The linear part: moving Gaussians over black."""
        if self.moving is None:
            return self.operator.blend(colors)
        values = colors.new_zeros(len(self.operator.visible), colors.shape[1])
        return self.operator.blend(values.index_copy(0, self.moving, colors))

    def render(self, sh: Float[Tensor, "m k 3"]) -> Float[Tensor, "h w 3"]:
        """The picture, with colours clamped at zero as every 3DGS renderer does; differentiable."""
        picture = self.blend(self.colors(sh).clamp_min(0))
        return picture if self.still is None else picture + self.still

    def gather(self, image: Float[Tensor, "h w c"]) -> Float[Tensor, "m c"]:
        """The transpose of `blend`."""
        values = self.operator.blend_transpose(image)
        return values if self.moving is None else values[self.moving]


class Views:
    """v views of one composite, of which `moving` Gaussians may change colour.

    Keeps the first views whose operators fit `cache_bytes`; the others are made anew each time, which costs a
    projection and a sort. Images and weights are read one at a time.
    """

    def __init__(
        self,
        composite: Gaussians,
        cameras: Cameras,
        images: ImageSequence,
        *,
        weights: ImageSequence | None,
        rendering: RenderOptions,
        cache_bytes: int,
    ) -> None:
        """All Gaussians move and all pixels count, until `narrowed`."""
        self.composite, self.cameras, self.images, self.weights = composite, cameras, images, weights
        self.rendering, self.cache_bytes = rendering, cache_bytes
        self.moving: Tensor | None = None
        self._kept: dict[int, View] = {}
        self._kept_bytes = 0

    def __len__(self) -> int:
        """How many there are."""
        return len(self.cameras)

    def narrowed(self, moving: Bool[Tensor, "n"], windows: Sequence[Window | None]) -> "Views":
        """Only some Gaussians move; views are cut to their windows, and dropped where that is None."""
        chosen = [i for i, window in enumerate(windows) if window is not None]
        kept = [window for window in windows if window is not None]
        narrowed = Views(
            self.composite,
            cropped(self.cameras[chosen], kept),
            _Cropped(self.images, chosen, kept),
            weights=None if self.weights is None else _Cropped(self.weights, chosen, kept),
            rendering=self.rendering,
            cache_bytes=self.cache_bytes,
        )
        narrowed.moving = None if bool(moving.all()) else torch.nonzero(moving).flatten()
        return narrowed

    def __getitem__(self, index: int) -> View:
        """The view's map, from the budget's keep or made anew."""
        if index in self._kept:
            return self._kept[index]
        view = self._make(index)
        size = held_bytes(view)
        if self._kept_bytes + size <= self.cache_bytes:
            self._kept[index] = view
            self._kept_bytes += size
        return view

    def _make(self, index: int) -> View:
        scene, camera = self.composite, self.cameras[index]
        operator = view_operator(scene, camera, self.rendering)
        directions = torch.nn.functional.normalize(scene.means - camera.centers, dim=-1)
        still = None
        if any(self.rendering.background):
            still = (1 - operator.alpha)[..., None] * operator.alpha.new_tensor(self.rendering.background)
        if self.moving is not None:
            colors = spherical_harmonics.colors(scene.sh, directions)
            colors[self.moving] = 0
            others = operator.blend(colors)
            still = others if still is None else still + others
            directions = directions[self.moving]
        basis = spherical_harmonics.basis(directions, scene.sh_degree)
        return View(operator=operator, basis=basis, still=still, moving=self.moving)

    def target(self, index: int) -> Float[Tensor, "h w 3"]:
        """The harmonised image of a view.

        Raises: ValueError where its size is not the camera's, or numbers are not finite.
        """
        return self._sized(self.images[index], index, "image")

    def weight(self, index: int) -> Float[Tensor, "h w"] | None:
        """The confidence in each pixel of a view in [0, 1], None where all count fully.

        Raises: ValueError where its size is not the camera's, or numbers are not finite.
        """
        return None if self.weights is None else self._sized(self.weights[index], index, "weight")

    def _sized(self, image: Tensor, index: int, kind: str) -> Tensor:
        width, height = self.cameras.sizes[index].tolist()
        if tuple(image.shape[:2]) != (height, width):
            found = f"{image.shape[1]}x{image.shape[0]}"
            raise ValueError(f"{self.cameras.names[index]}: expected {kind} pixels {width}x{height}, found {found}")
        if not bool(image.isfinite().all()):
            raise ValueError(f"{self.cameras.names[index]}: expected finite {kind} pixels, found others")
        return image


@dataclass(frozen=True)
class _Cropped:
    """Some images of a sequence, cut."""

    whole: ImageSequence
    chosen: list[int]
    windows: list[Window]

    def __len__(self) -> int:
        """How many there are."""
        return len(self.chosen)

    def __getitem__(self, index: int, /) -> Tensor:
        """The image, cut."""
        left, top, right, bottom = self.windows[index]
        return self.whole[self.chosen[index]][top:bottom, left:right]


def cropped(cameras: Cameras, windows: Sequence[Window]) -> Cameras:
    """The cameras of images cut to `windows`."""
    intrinsics = cameras.intrinsics.clone()
    edges = torch.tensor(windows, dtype=torch.int64).reshape(-1, 4)
    intrinsics[:, :2, 2] -= edges[:, :2].to(intrinsics)
    sizes = (edges[:, 2:] - edges[:, :2]).to(cameras.sizes.dtype)
    return replace(cameras, intrinsics=intrinsics, sizes=sizes)


def held_bytes(value: object) -> int:
    """Bytes of all tensors and arrays that a value holds, directly or in its fields."""
    if isinstance(value, Tensor):
        return value.numel() * value.element_size()
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, dict):
        return sum(held_bytes(part) for part in value.values())
    if isinstance(value, list | tuple):
        return sum(held_bytes(part) for part in value)
    return sum(held_bytes(part) for part in vars(value).values()) if hasattr(value, "__dict__") else 0
