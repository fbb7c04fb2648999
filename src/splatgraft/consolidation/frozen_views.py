"""Views of a composite with frozen geometry: linear maps from colours to pixels, cached within a budget of bytes.

The active Gaussians may change colour; the others are blended once into a constant image per view. Target images are
read lazily.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatgraft.consolidation.expansion import Expansion
from splatgraft.consolidation.options import ConsolidateOptions, ImageSequence
from splatgraft.core import spherical_harmonics
from splatgraft.core.cameras import Cameras, Window
from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering import ViewOperator, view_operator
from splatgraft.runtime.lazy_sequence import LazySequence


@dataclass(frozen=True)
class View:
    """The affine map from the colours of m active Gaussians to the pixels of one view."""

    operator: ViewOperator
    """Linear map from the values of all n Gaussians to pixels."""
    expansion: Expansion
    """Linear map from the coefficients of the active Gaussians to their colours towards the view."""
    static: Float[Tensor, "h w 3"] | None
    """Image of the other Gaussians and the background; None if it is zero."""
    active: Int[Tensor, "m"] | None
    """Indices of the active Gaussians; None if all n are active."""

    @property
    def visible(self) -> Bool[Tensor, "m"]:
        """Whether each active Gaussian has weight in the view."""
        return self.operator.visible if self.active is None else self.operator.visible[self.active]

    @property
    def own_bytes(self) -> int:
        """Bytes of this view alone, without parts that views share."""
        return sum(memory_bytes(part) for part in (self.operator, self.static, self.expansion.shown))

    def colors(self, sh: Float[Tensor, "m k 3"]) -> Float[Tensor, "m 3"]:
        """Compute the colours towards this view, not clamped; one half for Gaussians that the view does not show."""
        return self.expansion.colors(sh) + 0.5

    def blend(self, colors: Float[Tensor, "m c"]) -> Float[Tensor, "h w c"]:
        """Blend the active Gaussians over black: the linear part."""
        return self.operator.blend(self._of_all(colors))

    def render(self, sh: Float[Tensor, "m k 3"]) -> Float[Tensor, "h w 3"]:
        """Render the image, with colours clamped at zero as every 3DGS renderer does."""
        return self.draw(self.colors(sh))

    def draw(self, colors: Float[Tensor, "m 3"]) -> Float[Tensor, "h w 3"]:
        """Draw the image of colours, clamped at zero; differentiable."""
        picture = self.blend(colors.clamp_min(0))
        return picture if self.static is None else picture + self.static

    def blend_transpose(self, image: Float[Tensor, "h w c"]) -> Float[Tensor, "m c"]:
        """Apply the transpose of `blend`."""
        values = self.operator.blend_transpose(image)
        return values if self.active is None else values[self.active]

    def blend_and_transpose(self, colors: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3"]:
        """Apply `blend`, then `blend_transpose`."""
        values = self.operator.blend_and_transpose(self._of_all(colors))
        return values if self.active is None else values[self.active]

    def _of_all(self, colors: Float[Tensor, "m c"]) -> Float[Tensor, "n c"]:
        """Spread colours to all Gaussians; those that are not active get 0."""
        if self.active is None:
            return colors
        values = colors.new_zeros(len(self.operator.visible), colors.shape[1])
        return values.index_copy(0, self.active, colors)


class Views:
    """v views of one composite, whose `active` Gaussians may change colour.

    The first views whose operators fit `options.cache_bytes` are cached; the others are projected and sorted on each
    access. Images are read one at a time.
    """

    def __init__(
        self,
        composite: Gaussians,
        cameras: Cameras,
        images: ImageSequence,
        *,
        options: ConsolidateOptions,
    ) -> None:
        """Make the views; all Gaussians are active."""
        self.composite, self.cameras, self.images, self.options = composite, cameras, images, options
        self.active: Tensor | None = None
        self._means = composite.means.float().contiguous()
        self._cached: dict[int, View] = {}
        self._cached_bytes = 0

    def __len__(self) -> int:
        return len(self.cameras)

    def restricted(self, active: Bool[Tensor, "n"], windows: Sequence[Window | None]) -> "Views":
        """Make views with only some Gaussians active, cropped to `windows`; views whose window is None are dropped.

        Cached views that are not cropped move to the new cache.
        """
        chosen = [i for i, window in enumerate(windows) if window is not None]
        kept = [window for window in windows if window is not None]
        restricted = Views(
            self.composite,
            self.cameras[chosen].cropped(kept),
            _cropped(self.images, chosen, kept),
            options=self.options,
        )
        if not bool(active.all()):
            restricted.active = torch.nonzero(active).flatten()
            restricted._means = self._means[active]
        for place, (index, window) in enumerate(zip(chosen, kept, strict=True)):
            known = self._cached.pop(index, None)
            if known is not None and window == (0, 0, *self.cameras.sizes[index].tolist()):
                restricted._keep(place, restricted._view(place, known.operator))
        self._cached, self._cached_bytes = {}, 0
        return restricted

    def __getitem__(self, index: int) -> View:
        """Return the view's map, from the cache or built anew."""
        if index in self._cached:
            return self._cached[index]
        operator = view_operator(
            self.composite, self.cameras[index], self.options.rendering, min_row_weight=self.options.min_row_weight
        )
        view = self._view(index, operator)
        self._keep(index, view)
        return view

    def _keep(self, index: int, view: View) -> None:
        if self.take_bytes(view.own_bytes):
            self._cached[index] = view

    def take_bytes(self, count: int) -> bool:
        """Reserve bytes of the cache; False if it has no room for them."""
        has_room = self._cached_bytes + count <= self.options.cache_bytes
        self._cached_bytes += count if has_room else 0
        return has_room

    def _view(self, index: int, operator: ViewOperator) -> View:
        scene, camera = self.composite, self.cameras[index]
        static, visible = None, operator.visible
        if any(self.options.rendering.background):
            static = (1 - operator.alpha)[..., None] * operator.alpha.new_tensor(self.options.rendering.background)
        if self.active is not None:
            static = self._fixed(operator, camera, static)
            visible = visible[self.active]
        shown = torch.nonzero(visible).flatten().int()
        expansion = Expansion(self._means, camera.centers[0].float().contiguous(), shown, scene.sh_degree)
        return View(operator=operator, expansion=expansion, static=static, active=self.active)

    def _fixed(self, operator: ViewOperator, camera: Cameras, behind: Tensor | None) -> Tensor | None:
        """Blend the Gaussians that are not active over `behind`; None if there is neither."""
        fixed = operator.visible.clone()
        fixed[self.active] = False
        which = torch.nonzero(fixed).flatten()
        if not len(which):
            return behind
        scene = self.composite
        colors = scene.sh.new_zeros(scene.count, 3)
        directions = torch.nn.functional.normalize(scene.means[which] - camera.centers, dim=-1)
        colors[which] = spherical_harmonics.colors(scene.sh[which], directions)
        others = operator.blend(colors)
        return others if behind is None else behind + others

    def target(self, index: int) -> Float[Tensor, "h w 3"]:
        """Read the harmonised image of a view."""
        image = self.images[index]
        width, height = self.cameras.sizes[index].tolist()
        if tuple(image.shape[:2]) != (height, width):
            found = f"{image.shape[1]}x{image.shape[0]}"
            raise ValueError(f"{self.cameras.names[index]}: expected image pixels {width}x{height}, found {found}")
        if not bool(image.isfinite().all()):
            raise ValueError(f"{self.cameras.names[index]}: expected finite image pixels, found others")
        return image


def _cropped(images: ImageSequence, chosen: list[int], windows: list[Window]) -> ImageSequence:
    def read(index: int) -> Tensor:
        left, top, right, bottom = windows[index]
        return images[chosen[index]][top:bottom, left:right]

    return LazySequence(len(chosen), read)


def memory_bytes(value: object) -> int:
    """Add up the bytes of all tensors and arrays in a value and its fields."""
    if isinstance(value, Tensor):
        return value.numel() * value.element_size()
    if isinstance(value, np.ndarray):
        return value.nbytes
    return sum(memory_bytes(part) for part in vars(value).values()) if hasattr(value, "__dict__") else 0
