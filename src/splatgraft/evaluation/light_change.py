"""Measures how the light transfer changed a view, without ground truth."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.evaluation.regions import SHADOW_RATIO, luminance_ratio

_DARKER = torch.tensor([0.16, 0.32, 0.78])
_BRIGHTER = torch.tensor([0.93, 0.55, 0.10])
_UNCHANGED = torch.tensor([0.93, 0.93, 0.93])


@dataclass(frozen=True)
class ChangeMapSettings:
    """Scale of the change map, set by hand."""

    noise_stops: float = 0.02
    """Photographic stops; smaller changes stay grey. The noise between two renders."""
    full_color_stops: float = 1.0
    """Photographic stops of the full colours."""
    exponent: float = 0.7
    """Below 1, so that faint shadows stay visible beside strong ones."""


def describe_change(
    result: Float[Tensor, "h w 3"], composite: Float[Tensor, "h w 3"], mask: Float[Tensor, "h w"]
) -> dict[str, float]:
    """Describe how the luminance of `result` differs from copy-paste.

    Args:
        result: the view after light transfer, sRGB in [0, 1].
        composite: the view before, sRGB in [0, 1].
        mask: coverage by the object, in [0, 1].

    Returns:
        object_brightness: mean ratio of linear luminance on the object, 1 where the view shows no object.
        darkened_fraction: share of the pixels outside the object that lost more than 5% of their light.
        brightened_fraction: share of these pixels that gained as much.
    """
    ratio = luminance_ratio(result, composite)
    inside, outside = mask > 0.5, mask <= 0
    surroundings = ratio[outside]
    return {
        "object_brightness": float(ratio[inside].mean()) if bool(inside.any()) else 1.0,
        "darkened_fraction": float((surroundings < SHADOW_RATIO).float().mean()) if len(surroundings) else 0.0,
        "brightened_fraction": float((surroundings > 1 / SHADOW_RATIO).float().mean()) if len(surroundings) else 0.0,
    }


def change_map(
    result: Float[Tensor, "h w 3"],
    composite: Float[Tensor, "h w 3"],
    *,
    settings: ChangeMapSettings = ChangeMapSettings(),
) -> Float[Tensor, "h w 3"]:
    """Draw where `result` is darker (blue) or brighter (orange) than `composite`, sRGB in [0, 1]."""
    full, noise = settings.full_color_stops, settings.noise_stops
    stops = luminance_ratio(result, composite).clamp_min(1e-3).log2().clamp(-full, full)[..., None]
    tint = torch.where(stops < 0, _DARKER, _BRIGHTER)
    strength = ((stops.abs() - noise).clamp_min(0) / (full - noise)) ** settings.exponent
    return _UNCHANGED + strength * (tint - _UNCHANGED)
