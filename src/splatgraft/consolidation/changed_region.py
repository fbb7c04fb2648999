"""Restricts a consolidation to what the harmoniser changed: the active Gaussians, and the pixels that they reach.

A Gaussian is active where a share of the blending weight that it has in all views falls on changed pixels.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.consolidation.frozen_views import Views
from splatgraft.core import spherical_harmonics
from splatgraft.core.cameras import Window


@dataclass(frozen=True)
class ChangeOptions:
    """What counts as changed; values set by hand."""

    changed_share: float = 0.02
    """Share of a Gaussian's blending weight on changed pixels above which it is active."""
    visible_share: float = 1.0 / 255
    """Share of a pixel that active Gaussians make up, from which it lies in the window: one grey level."""
    margin_px: int = 16
    """Border of the windows, so that windowed losses and SSIM see the surroundings."""


@torch.no_grad()
def restrict_to_changes(views: Views, unchanged_below: float, *, options: ChangeOptions = ChangeOptions()) -> Views:
    """The views cropped to what changed, with the other Gaussians fixed.

    Args:
        views: Of all Gaussians, whole.
        unchanged_below: Difference from the composite's render, in sRGB, below which a pixel is unchanged; 0 or less
            returns `views`.
        options: What counts as changed.
    """
    if unchanged_below <= 0:
        return views
    active = _on_changed_pixels(views, unchanged_below, options.changed_share)
    if bool(active.all()):
        return views
    return views.restricted(active, [_window(views, index, active, options) for index in range(len(views))])


def _on_changed_pixels(views: Views, unchanged_below: float, changed_share: float) -> Bool[Tensor, "n"]:
    weights = torch.zeros(views.composite.count, 2, device=views.composite.device)
    for index in range(len(views)):
        view = views[index]
        picture = view.render(views.composite.sh).clamp(0, 1)
        changed = ((views.target(index) - picture).abs().amax(-1) >= unchanged_below).to(picture.dtype)
        weights += view.blend_transpose(torch.stack([changed, torch.ones_like(changed)], -1))
    return (weights[:, 0] > changed_share * weights[:, 1]) & (weights[:, 1] > 0)


def _window(views: Views, index: int, active: Bool[Tensor, "n"], options: ChangeOptions) -> Window | None:
    share: Float[Tensor, "h w"] = views[index].blend(active[:, None].to(views.composite.sh.dtype))[..., 0]
    rows, columns = torch.nonzero(share >= options.visible_share, as_tuple=True)
    if len(rows) == 0:
        return None
    height, width = share.shape
    return (
        max(0, int(columns.min()) - options.margin_px),
        max(0, int(rows.min()) - options.margin_px),
        min(width, int(columns.max()) + 1 + options.margin_px),
        min(height, int(rows.max()) + 1 + options.margin_px),
    )


def drop_higher_bands(sh: Float[Tensor, "n k 3"]) -> Float[Tensor, "n k 3"]:
    """Coefficients with bands above 0 set to zero (paper, section Multi-View Consolidation)."""
    return spherical_harmonics.with_degree(
        spherical_harmonics.with_degree(sh, 0), spherical_harmonics.degree_of(sh.shape[1])
    )
