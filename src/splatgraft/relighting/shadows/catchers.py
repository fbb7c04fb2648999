"""Shadow catchers: black Gaussians in a surface that lets light through, which shade what is seen behind it.

Fits often draw a plain floor by thin Gaussians before wide ones far behind it, so that a shadow in the colours of the
surface changes a part of each pixel alone, and is pale. Black Gaussians whose transmittance is the ratio of light with
the object to that without it do the same to the rest. Where the surface is opaque there are none.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.core.directions import frames_along
from splatgraft.core.gaussians import Gaussians, empty
from splatgraft.core.rotations import quaternion_from_rotation
from splatgraft.core.spherical_harmonics import dc_from_rgb
from splatgraft.relighting.shadows.receivers import Receivers
from splatgraft.relighting.shadows.scene_ratio import DARKEST, SceneRatio
from splatgraft.relighting.shadows.surface_views import GAMMA, SurfaceView, blended_values

# set by hand
_OPAQUE = 0.97  # share of a pixel from which on colours of the surface alone make its shadow
_AROUND, _UNDER = 16, 1.0
"""Receivers around a point; how many standard deviations of their height a catcher lies under their mean."""
_FAINTEST = 0.03  # share of light; where less is lost there are no catchers
_WIDTH = 0.6  # standard deviation over the spacing: a square lattice of them is even to a percent
_FLAT = 0.1  # standard deviation along the normal over that across it
_REACH = 3.0  # standard deviations within which catchers overlap
_CLEAREST = 1e-6  # opacity of those without any depth
_ROUNDS, _MOST = 2, 1.5
"""How often depths are corrected by what the views show, and the largest factor."""


@dataclass(frozen=True)
class ShadowCatchers:
    """k black Gaussians."""

    clear: Gaussians
    """Without their depth: invisible; world frame."""
    depth: Float[Tensor, "k"]
    """Optical depth in the middle of each, -log(1 - opacity), in sRGB."""
    receiver: Int[Tensor, "k"]
    """Position of the receiver that each is at."""

    @staticmethod
    def none() -> "ShadowCatchers":
        """No catchers."""
        return ShadowCatchers(empty(), torch.zeros(0), torch.zeros(0, dtype=torch.int64))

    @property
    def visible(self) -> Gaussians:
        """With their depth."""
        return with_depth(self.clear, self.depth)


def with_depth(gaussians: Gaussians, depth: Float[Tensor, "n"]) -> Gaussians:
    """Gaussians of some optical depth in their middle, instead of their opacity."""
    return replace(gaussians, opacity_logits=(1 - torch.exp(-depth)).clamp(_CLEAREST, 1 - _CLEAREST).logit())


def find_catchers(
    receivers: Receivers, ratio: SceneRatio, gaussians: Gaussians, views: Sequence[SurfaceView], *, spacing: float
) -> ShadowCatchers:
    """The catchers under a surface, where views show its shadow and something behind it.

    Args:
        receivers: Gaussians of the surface.
        ratio: Their ratios, at their centres.
        gaussians: The scene, receivers first.
        views: What they show of it.
        spacing: World units between two catchers.
    """
    catchers = _under_surface(receivers, views, spacing=spacing)
    for _ in range(_ROUNDS if len(catchers.depth) else 0):
        catchers = _weighed(catchers, ratio, gaussians, views)
    seen = catchers.depth > _CLEAREST
    return ShadowCatchers(catchers.clear.select(seen), catchers.depth[seen], catchers.receiver[seen])


def _weighed(
    catchers: ShadowCatchers, ratio: SceneRatio, gaussians: Gaussians, views: Sequence[SurfaceView]
) -> ShadowCatchers:
    """Catchers with the part of their depth with which the pixels that they cover are as dark as they must be.

    Some lie before Gaussians of the surface, which have the shadow in their colours already. The mean logarithms of a
    pixel without the catchers, with them, and as it must be give the part, by the secant.
    """
    values, black = blended_values(ratio), catchers.visible
    sums = torch.zeros(black.count, 3)
    for view in views:
        weights, _, shaded = view.with_catchers(gaussians, black, values)
        wanted = view.value.clone()
        wanted[view.shown] = view.weights.alpha[view.shown] * view.ratio ** (1 / GAMMA)
        known = view.shown[..., None].float()
        pixels = torch.stack([view.value, shaded, wanted], -1).clamp_min(DARKEST).log() * known
        sums += weights.blend_transpose(pixels)[len(view.which) :]
    without, with_them, wanted = sums.unbind(1)
    part = ((without - wanted) / (without - with_them).clamp_min(1e-6)).clamp(0, _MOST)
    return replace(catchers, depth=part * catchers.depth)


def _under_surface(receivers: Receivers, views: Sequence[SurfaceView], *, spacing: float) -> ShadowCatchers:
    """Catchers as deep as the shadow of the points that the views show, wherever some show something behind them."""
    values = [
        torch.cat([v.points, receivers.normals[v.nearest], v.ratio[:, None], v.opaque[:, None]], 1) for v in views
    ]
    seen, of = torch.cat([torch.zeros(0, 8), *values]), torch.cat([torch.zeros(0).long(), *[v.nearest for v in views]])
    shaded = seen[:, 6] < 1 - _FAINTEST
    cells, cell = torch.unique((seen[shaded, :3] / spacing).floor().long(), dim=0, return_inverse=True)
    count = torch.bincount(cell, minlength=len(cells))[:, None]
    means = torch.zeros(len(cells), 8).index_add_(0, cell, seen[shaded]) / count
    receiver = torch.full((len(cells),), len(receivers.origin)).scatter_reduce(0, cell, of[shaded], "amin")
    through = means[:, 7] < _OPAQUE
    points, normals, ratio, _ = means[through].split([3, 3, 1, 1], 1)
    normals, width = F.normalize(normals, dim=1), _WIDTH * spacing
    middle = points - _under(points, normals, receivers)[:, None] * normals
    clear = Gaussians(
        means=middle,
        log_scales=torch.tensor([width, width, _FLAT * width]).log().repeat(len(points), 1),
        quaternions=quaternion_from_rotation(frames_along(-normals).transpose(1, 2)),
        opacity_logits=torch.zeros(len(points)),
        sh=dc_from_rgb(torch.zeros(len(points), 3))[:, None],
    )
    depth = -ratio[:, 0].log() / GAMMA / _overlapping(middle, width)
    return ShadowCatchers(with_depth(clear, torch.zeros(len(points))), depth, receiver[through])


def _under(points: Float[Tensor, "k 3"], normals: Float[Tensor, "k 3"], receivers: Receivers) -> Float[Tensor, "k"]:
    """How far under points of the surface most receivers around them are, world units; smooth over the points."""
    if not len(points):
        return torch.zeros(0)

    def heights(of: Float[Tensor, "r 3"]) -> tuple[Float[Tensor, "k a"], Int[Tensor, "k a"]]:
        """Those of the nearest over the points' planes, and which they are."""
        count = min(_AROUND, len(of))
        near = torch.from_numpy(KDTree(of.numpy()).query(points.numpy(), k=count)[1].astype(np.int64)).reshape(
            -1, count
        )
        return ((of[near] - points[:, None]) * normals[:, None]).sum(-1), near

    around, _ = heights(receivers.gaussians.means)
    lowest = around.mean(1) - _UNDER * around.std(1, correction=0)
    level, beside = heights(points)
    return -(level + lowest[beside]).mean(1)


def _overlapping(points: Float[Tensor, "k 3"], width: float) -> Float[Tensor, "k"]:
    """How many Gaussians of a width overlap at each one's middle, itself included, by their values there."""
    if not len(points):
        return torch.ones(0)
    tree = KDTree(points.numpy())
    near = tree.sparse_distance_matrix(tree, _REACH * width, output_type="coo_matrix")
    value = torch.from_numpy(np.exp(-0.5 * (near.data / width) ** 2)).float()
    return torch.zeros(len(points)).index_add_(0, torch.from_numpy(near.row.astype(np.int64)), value)
