"""Shadow catchers: black Gaussians in a translucent surface, which shade the Gaussians seen behind it.

Reconstructions often draw a plain floor by thin Gaussians in front of wide ones far behind it. A shadow in the thin
ones' colours changes only a part of each pixel, so it is pale. Black Gaussians shade the rest: their transmittance is
the ratio of light with the object to light without it.

1. Place catchers at shadowed points of the surface that views show translucent (`_under_surface`).
2. Correct their depth by the pixels that they cover (`_weighed`), in two rounds.
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
_OPAQUE = 0.97  # share of a pixel; a surface with a larger share needs no catchers
_AROUND = 16  # receivers around a point; a catcher lies one standard deviation of their heights below their mean
_FAINTEST = 0.03  # share of light; a shadow that takes less has no catchers
_WIDTH = 0.6  # standard deviation over the spacing: a square lattice of them is even to a percent
_CLEAREST = 1e-6  # opacity of a catcher without depth


@dataclass(frozen=True)
class ShadowCatchers:
    """k black Gaussians."""

    clear: Gaussians
    """The Gaussians without their depth, so invisible; world frame."""
    depth: Float[Tensor, "k"]
    """Optical depth in the middle of each, -log(1 - opacity), in sRGB."""
    receiver: Int[Tensor, "k"]
    """Position of a receiver beside each catcher."""

    @staticmethod
    def none() -> "ShadowCatchers":
        """Return no catchers."""
        return ShadowCatchers(empty(), torch.zeros(0), torch.zeros(0, dtype=torch.int64))

    @property
    def visible(self) -> Gaussians:
        """The Gaussians with their depth."""
        return with_depth(self.clear, self.depth)


def with_depth(gaussians: Gaussians, depth: Float[Tensor, "n"]) -> Gaussians:
    """Replace the opacity of Gaussians by an optical depth in their middle."""
    return replace(gaussians, opacity_logits=(1 - torch.exp(-depth)).clamp(_CLEAREST, 1 - _CLEAREST).logit())


def find_catchers(
    receivers: Receivers, ratio: SceneRatio, gaussians: Gaussians, views: Sequence[SurfaceView], *, spacing: float
) -> ShadowCatchers:
    """Find catchers under a surface, where views show both its shadow and something behind it.

    Args:
        receivers: Gaussians of the surface.
        ratio: Ratios at the receivers' centres.
        gaussians: The scene, receivers first.
        views: Views of the surface.
        spacing: World units between two catchers.
    """
    catchers = _under_surface(receivers, views, spacing=spacing)
    for _ in range(2 if len(catchers.depth) else 0):
        catchers = _weighed(catchers, ratio, gaussians, views)
    seen = catchers.depth > _CLEAREST
    return ShadowCatchers(catchers.clear.select(seen), catchers.depth[seen], catchers.receiver[seen])


def _weighed(
    catchers: ShadowCatchers, ratio: SceneRatio, gaussians: Gaussians, views: Sequence[SurfaceView]
) -> ShadowCatchers:
    """Scale the depth of catchers so that the pixels that they cover become as dark as the ratio demands.

    Some catchers lie in front of Gaussians of the surface, whose colours hold the shadow already. The factor follows by
    the secant from mean logarithms of the pixels without catchers, with catchers, and with the wanted shadow.
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
    part = ((without - wanted) / (without - with_them).clamp_min(1e-6)).clamp(0, 1.5)
    return replace(catchers, depth=part * catchers.depth)


def _under_surface(receivers: Receivers, views: Sequence[SurfaceView], *, spacing: float) -> ShadowCatchers:
    """Place catchers as deep as the shadow, one per cell of shadowed surface points that views show translucent."""
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
        log_scales=torch.tensor([width, width, 0.1 * width]).log().repeat(len(points), 1),
        quaternions=quaternion_from_rotation(frames_along(-normals).transpose(1, 2)),
        opacity_logits=torch.zeros(len(points)),
        sh=dc_from_rgb(torch.zeros(len(points), 3))[:, None],
    )
    depth = -ratio[:, 0].log() / GAMMA / _overlapping(middle, width)
    return ShadowCatchers(with_depth(clear, torch.zeros(len(points))), depth, receiver[through])


def _under(points: Float[Tensor, "k 3"], normals: Float[Tensor, "k 3"], receivers: Receivers) -> Float[Tensor, "k"]:
    """Compute the depth below surface points at which most receivers around them lie, world units.

    It is averaged over neighbouring points.
    """
    if not len(points):
        return torch.zeros(0)

    def heights(of: Float[Tensor, "r 3"]) -> tuple[Float[Tensor, "k a"], Int[Tensor, "k a"]]:
        """Compute heights of the nearest positions over the points' planes, and their indices."""
        count = min(_AROUND, len(of))
        near = torch.from_numpy(KDTree(of.numpy()).query(points.numpy(), k=count)[1].astype(np.int64)).reshape(
            -1, count
        )
        return ((of[near] - points[:, None]) * normals[:, None]).sum(-1), near

    around, _ = heights(receivers.gaussians.means)
    lowest = around.mean(1) - around.std(1, correction=0)
    level, beside = heights(points)
    return -(level + lowest[beside]).mean(1)


def _overlapping(points: Float[Tensor, "k 3"], width: float) -> Float[Tensor, "k"]:
    """Sum the values of all Gaussians of one width at each one's middle, its own 1 included."""
    if not len(points):
        return torch.ones(0)
    tree = KDTree(points.numpy())
    near = tree.sparse_distance_matrix(tree, 3 * width, output_type="coo_matrix")
    value = torch.from_numpy(np.exp(-0.5 * (near.data / width) ** 2)).float()
    return torch.zeros(len(points)).index_add_(0, torch.from_numpy(near.row.astype(np.int64)), value)
