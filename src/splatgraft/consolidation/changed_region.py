"""What a consolidation may leave alone: Gaussians that no changed pixel sees, pixels that no moving one reaches.

Knows nothing about how colours are fitted.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatgraft.consolidation.frozen_views import Views, Window
from splatgraft.core import spherical_harmonics

# a Gaussian moves when at least this share of what the views see of it has changed
_CHANGED_SHARE = 0.02
# a pixel matters when moving Gaussians make up at least this much of it: one grey level
_VISIBLE_SHARE = 1.0 / 255
# windows keep this margin, so that windowed losses and SSIM see the surroundings, pixels
_MARGIN_PX = 16


@torch.no_grad()
def narrow(views: Views, unchanged_below: float) -> Views:
    """The views cut to what changed: where an image differs from the composite's render by `unchanged_below`."""
    if unchanged_below <= 0:
        return views
    moving = _seen_changed(views, unchanged_below)
    if bool(moving.all()):
        return views
    return views.narrowed(moving, [_window(views, index, moving) for index in range(len(views))])


def _seen_changed(views: Views, unchanged_below: float) -> Bool[Tensor, "n"]:
    seen = torch.zeros(views.composite.count, 2, device=views.composite.device)
    for index in range(len(views)):
        view = views[index]
        picture = view.render(views.composite.sh).clamp(0, 1)
        changed = ((views.target(index) - picture).abs().amax(-1) >= unchanged_below).to(picture.dtype)
        seen += view.gather(torch.stack([changed, torch.ones_like(changed)], -1))
    return (seen[:, 0] > _CHANGED_SHARE * seen[:, 1]) & (seen[:, 1] > 0)


def _window(views: Views, index: int, moving: Bool[Tensor, "n"]) -> Window | None:
    share: Float[Tensor, "h w"] = views[index].blend(moving[:, None].to(views.composite.sh.dtype))[..., 0]
    rows, columns = torch.nonzero(share >= _VISIBLE_SHARE, as_tuple=True)
    if len(rows) == 0:
        return None
    height, width = share.shape
    return (
        max(0, int(columns.min()) - _MARGIN_PX),
        max(0, int(rows.min()) - _MARGIN_PX),
        min(width, int(columns.max()) + 1 + _MARGIN_PX),
        min(height, int(rows.max()) + 1 + _MARGIN_PX),
    )


def reset_bands(sh: Float[Tensor, "n k 3"]) -> Float[Tensor, "n k 3"]:
    """Band 0 alone: the colours without view dependence (paper, section Multi-View Consolidation)."""
    return spherical_harmonics.with_degree(
        spherical_harmonics.with_degree(sh, 0), spherical_harmonics.degree_of(sh.shape[1])
    )
