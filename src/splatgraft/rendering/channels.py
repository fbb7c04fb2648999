"""The channels of values that are blended together on every device, and the `Render` assembled from them."""

from collections.abc import Set as AbstractSet

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.rendering.interface import Output, Render, RenderOptions

CHANNEL_COUNTS: dict[Output, int] = {"color": 3, "depth": 1, "normal": 3}
"""Number of channels of each output, blended in this order; features follow."""


def assemble_render(
    image: Float[Tensor, "v c h w"],
    alpha: Float[Tensor, "v h w"],
    visible: Bool[Tensor, "v n"],
    *,
    outputs: AbstractSet[Output],
    has_features: bool,
    options: RenderOptions,
) -> Render:
    """Split blended channels into the outputs of a `Render`.

    Args:
        image: Blended channels over black, in the order of `CHANNEL_COUNTS`, then features.
        alpha: Accumulated opacity.
        visible: Gaussians in each view.
        outputs: Which of `CHANNEL_COUNTS` are in `image`.
        has_features: Whether features follow.
        options: Of which the background is added to the colour.
    """
    planes, at = {}, 0
    for name, width in CHANNEL_COUNTS.items():
        if name in outputs:
            planes[name], at = image[:, at : at + width], at + width
    made: dict[str, Tensor] = {}
    if "color" in outputs:
        made["color"] = _over(planes["color"], alpha, options.background)
    if "depth" in outputs:
        made["depth"] = _per_hit(planes["depth"][:, 0], alpha)
    if "normal" in outputs:
        made["normal"] = _unit(planes["normal"].permute(0, 2, 3, 1))
    if has_features:
        made["features"] = image[:, at:].permute(0, 2, 3, 1)
    return Render(alpha=alpha, visible=visible, pictures=made)


def _over(planes: Tensor, alpha: Tensor, background: tuple[float, float, float]) -> Tensor:
    if any(background):
        planes = planes + (1 - alpha)[:, None] * planes.new_tensor(background)[:, None, None]
    return planes.permute(0, 2, 3, 1)


def _per_hit(depth: Tensor, alpha: Tensor) -> Tensor:
    return depth / torch.where(alpha > 0, alpha, 1)


def _unit(normal: Tensor) -> Tensor:
    squares = (normal * normal).sum(-1, keepdim=True)
    return normal / torch.where(squares > 0, squares, 1).sqrt()
