"""Views of a composite with frozen geometry: the linear map from colours to pixels, cached within a byte budget.

The active Gaussians may change colour; the others are blended once into a constant image per view. Target images are
read lazily.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatgraft.consolidation.options import ImageSequence
from splatgraft.core import spherical_harmonics
from splatgraft.core.cameras import Cameras, Window
from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering import RenderOptions, ViewOperator, view_operator


@dataclass(frozen=True)
class View:
    """The affine map from the colours of m active Gaussians to the pixels of one view."""

    operator: ViewOperator
    """From the values of all n Gaussians to pixels."""
    basis: Float[Tensor, "m k"]
    """Spherical harmonics towards each active Gaussian."""
    static: Float[Tensor, "h w 3"] | None
    """Image of the other Gaussians and the background; None where that is zero."""
    active: Int[Tensor, "m"] | None
    """Indices of the active Gaussians; None where all n are active."""

    @property
    def visible(self) -> Bool[Tensor, "m"]:
        """Which active Gaussians have weight in the view."""
        return self.operator.visible if self.active is None else self.operator.visible[self.active]

    def colors(self, sh: Float[Tensor, "m k 3"]) -> Float[Tensor, "m 3"]:
        """The expansion towards this view, plus one half, not clamped."""
        return torch.einsum("mk,mkc->mc", self.basis, sh) + 0.5

    def blend(self, colors: Float[Tensor, "m c"]) -> Float[Tensor, "h w c"]:
        """The linear part: active Gaussians over black."""
        if self.active is None:
            return self.operator.blend(colors)
        values = colors.new_zeros(len(self.operator.visible), colors.shape[1])
        return self.operator.blend(values.index_copy(0, self.active, colors))

    def render(self, sh: Float[Tensor, "m k 3"]) -> Float[Tensor, "h w 3"]:
        """The image, with colours clamped at zero as every 3DGS renderer does; differentiable."""
        picture = self.blend(self.colors(sh).clamp_min(0))
        return picture if self.static is None else picture + self.static

    def blend_transpose(self, image: Float[Tensor, "h w c"]) -> Float[Tensor, "m c"]:
        """The transpose of `blend`."""
        values = self.operator.blend_transpose(image)
        return values if self.active is None else values[self.active]


class Views:
    """v views of one composite, whose `active` Gaussians may change colour.

    The first views whose operators fit `cache_bytes` are cached; the others are projected and sorted on each access.
    Images and weights are read one at a time.
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
        """All Gaussians are active and all pixels count."""
        self.composite, self.cameras, self.images, self.weights = composite, cameras, images, weights
        self.rendering, self.cache_bytes = rendering, cache_bytes
        self.active: Tensor | None = None
        self._cached: dict[int, View] = {}
        self._cached_bytes = 0

    def __len__(self) -> int:
        """How many there are."""
        return len(self.cameras)

    def restricted(self, active: Bool[Tensor, "n"], windows: Sequence[Window | None]) -> "Views":
        """The same views with some Gaussians active, cropped to `windows`, and without those whose window is None."""
        chosen = [i for i, window in enumerate(windows) if window is not None]
        kept = [window for window in windows if window is not None]
        restricted = Views(
            self.composite,
            self.cameras[chosen].cropped(kept),
            _Cropped(self.images, chosen, kept),
            weights=None if self.weights is None else _Cropped(self.weights, chosen, kept),
            rendering=self.rendering,
            cache_bytes=self.cache_bytes,
        )
        restricted.active = None if bool(active.all()) else torch.nonzero(active).flatten()
        return restricted

    def __getitem__(self, index: int) -> View:
        """The view's map, from the cache or built anew."""
        if index in self._cached:
            return self._cached[index]
        view = self._build(index)
        size = memory_bytes(view)
        if self._cached_bytes + size <= self.cache_bytes:
            self._cached[index] = view
            self._cached_bytes += size
        return view

    def _build(self, index: int) -> View:
        scene, camera = self.composite, self.cameras[index]
        operator = view_operator(scene, camera, self.rendering)
        directions = torch.nn.functional.normalize(scene.means - camera.centers, dim=-1)
        static = None
        if any(self.rendering.background):
            static = (1 - operator.alpha)[..., None] * operator.alpha.new_tensor(self.rendering.background)
        if self.active is not None:
            colors = spherical_harmonics.colors(scene.sh, directions)
            colors[self.active] = 0
            others = operator.blend(colors)
            static = others if static is None else static + others
            directions = directions[self.active]
        basis = spherical_harmonics.basis(directions, scene.sh_degree)
        return View(operator=operator, basis=basis, static=static, active=self.active)

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
    """Chosen images of a sequence, cropped."""

    whole: ImageSequence
    chosen: list[int]
    windows: list[Window]

    def __len__(self) -> int:
        """How many there are."""
        return len(self.chosen)

    def __getitem__(self, index: int, /) -> Tensor:
        """The cropped image."""
        left, top, right, bottom = self.windows[index]
        return self.whole[self.chosen[index]][top:bottom, left:right]


def memory_bytes(value: object) -> int:
    """Bytes of all tensors and arrays in a value, its items and its fields."""
    if isinstance(value, Tensor):
        return value.numel() * value.element_size()
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, dict):
        return sum(memory_bytes(part) for part in value.values())
    if isinstance(value, list | tuple):
        return sum(memory_bytes(part) for part in value)
    return sum(memory_bytes(part) for part in vars(value).values()) if hasattr(value, "__dict__") else 0
