"""What the light transfer did to a view, where no ground truth can judge it. Measures change, not quality."""

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.evaluation.regions import SHADOW_RATIO, luminance_ratio

_DARKER = torch.tensor([0.16, 0.32, 0.78])
_BRIGHTER = torch.tensor([0.93, 0.55, 0.10])
_SAME = torch.tensor([0.93, 0.93, 0.93])


def describe_change(
    result: Float[Tensor, "h w 3"], composite: Float[Tensor, "h w 3"], mask: Float[Tensor, "h w"]
) -> dict[str, float]:
    """How `result` differs from copy-paste: the object's brightness ratio, and how much around it fell into shadow.

    `object_brightness` is linear luminance over that of copy-paste, 1 where the view shows no object;
    `darkened_fraction` and `brightened_fraction` are of the pixels outside the object.
    """
    ratio = luminance_ratio(result, composite)
    inside, outside = mask > 0.5, mask <= 0
    beside = ratio[outside]
    return {
        "object_brightness": float(ratio[inside].mean()) if bool(inside.any()) else 1.0,
        "darkened_fraction": float((beside < SHADOW_RATIO).float().mean()) if len(beside) else 0.0,
        "brightened_fraction": float((beside > 1 / SHADOW_RATIO).float().mean()) if len(beside) else 0.0,
    }


def change_map(result: Float[Tensor, "h w 3"], composite: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """A picture of where light was taken away (blue) or given (orange), full colour at a factor of two; sRGB."""
    stops = luminance_ratio(result, composite).clamp_min(1e-3).log2().clamp(-1, 1)[..., None]
    tint = torch.where(stops < 0, _DARKER, _BRIGHTER)
    # a fiftieth of a stop is the noise of two renders; the root keeps faint shadows visible beside strong ones
    strength = ((stops.abs() - 0.02).clamp_min(0) / 0.98) ** 0.7
    return _SAME + strength * (tint - _SAME)
