"""Puts an object's shadow and bounce on the Gaussians that can be reached, and splits those too wide for its edge.

Knows nothing about where the light is from, nor about files.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatgraft.gaussians import Gaussians, concatenate
from splatgraft.relight.scene_shading import ObjectMaps, SceneRatio, scene_ratio
from splatgraft.splitting import NARROWER, split_along

_ROUNDS = 3
_VARIATION = 0.05  # share of light over one standard deviation: about the contrast at which an edge is seen as one


@dataclass(frozen=True)
class Receivers:
    """Gaussians that may be in the shadow, with what is needed to light them."""

    gaussians: Gaussians
    normals: Float[Tensor, "m 3"]
    arrives: Float[Tensor, "m k"]
    """Share of every bundle that the scene lets through."""
    trust: Float[Tensor, "m"]
    """In [0, 1]; scales the change where a Gaussian's surface is unsure."""
    origin: Int[Tensor, "m"]
    """Position in the list that they were taken from."""

    def select(self, which: Tensor) -> "Receivers":
        """Those that a mask keeps or an index list names."""
        return Receivers(
            gaussians=self.gaussians.select(which),
            normals=self.normals[which],
            arrives=self.arrives[which],
            trust=self.trust[which],
            origin=self.origin[which],
        )


def shade_receivers(
    receivers: Receivers, maps: ObjectMaps, *, budget: int
) -> tuple[Receivers, Int[Tensor, "j"], SceneRatio]:
    """Receivers, some split (at most `budget` added); which one each was; their ratios, averaged over their extent."""
    # narrower ones are finer than an edge that matters at the size of the object
    smallest = 5 * maps.ambient_maps.texel
    done: list[tuple[Receivers, Tensor, SceneRatio]] = []
    pending, which = receivers, torch.arange(len(receivers.origin))
    for round_ in range(_ROUNDS + 1):
        ratio, variation = _extended_ratio(pending, maps, smallest=smallest)
        axis = variation.argmax(1)
        wanted = variation.max(1).values
        wanted = torch.where((wanted > _VARIATION) & (pending.gaussians.opacities > 0.05), wanted, 0)
        room = budget // 4  # one becomes five
        if round_ == _ROUNDS or room == 0 or not bool((wanted > 0).any()):
            done.append((pending, which, ratio))
            break
        order = wanted.argsort(descending=True)[: min(room, int((wanted > 0).sum()))]
        keep = torch.ones(len(wanted), dtype=torch.bool)
        keep[order] = False
        kept = SceneRatio(shadow=ratio.shadow[keep], bounce=ratio.bounce[keep])
        done.append((pending.select(keep), which[keep], kept))
        pieces, parent = split_along(pending.gaussians.select(order), axis[order])
        parents = pending.select(order)
        pending = Receivers(
            gaussians=pieces,
            normals=parents.normals[parent],
            arrives=parents.arrives[parent],
            trust=parents.trust[parent],
            origin=parents.origin[parent],
        )
        which = which[order][parent]
        budget -= 4 * len(order)
    joined = Receivers(
        gaussians=concatenate([r.gaussians for r, _, _ in done]),
        normals=torch.cat([r.normals for r, _, _ in done]),
        arrives=torch.cat([r.arrives for r, _, _ in done]),
        trust=torch.cat([r.trust for r, _, _ in done]),
        origin=torch.cat([r.origin for r, _, _ in done]),
    )
    trust = joined.trust[:, None]
    shadow = torch.cat([ratio.shadow for _, _, ratio in done])
    bounce = torch.cat([ratio.bounce for _, _, ratio in done])
    parents = torch.cat([w for _, w, _ in done])
    return joined, parents, SceneRatio(shadow=1 - (1 - shadow) * trust, bounce=bounce * trust)


def _extended_ratio(
    receivers: Receivers, maps: ObjectMaps, *, smallest: float
) -> tuple[SceneRatio, Float[Tensor, "m 3"]]:
    """Ratio averaged over each Gaussian, and how much it varies along each own axis (0 along narrow ones)."""
    g = receivers.gaussians
    center = scene_ratio(maps, g.means, receivers.normals, arrives=receivers.arrives)
    variation = torch.zeros(g.count, 3)
    wide = g.scales > smallest * torch.tensor(1 / NARROWER).sqrt()
    if not bool(wide.any()):
        return center, variation
    row, axis = wide.nonzero(as_tuple=True)
    step = g.rotations[row, :, axis] * g.scales[row, axis][:, None]
    points = torch.cat([g.means[row] + step, g.means[row] - step])
    twice = torch.cat([row, row])
    sides = scene_ratio(maps, points, receivers.normals[twice], arrives=receivers.arrives[twice])
    one, other = sides.shadow.chunk(2)
    middle = center.shadow[row]
    spread = torch.maximum((one - other).abs() / 2, (0.5 * (one + other) - middle).abs()).max(1).values
    variation[row, axis] = spread
    # mean along each wide axis with weights 1/4, 1/2, 1/4: between the middle alone and the exact second moment, which
    # would leave the middle out
    shadow, bounce = center.shadow.clone(), center.bounce.clone()
    shadow.index_add_(0, row, 0.5 * (one + other) / 2 - 0.5 * middle)
    lifted, lowered = sides.bounce.chunk(2)
    bounce.index_add_(0, row, 0.5 * (lifted + lowered) / 2 - 0.5 * center.bounce[row])
    return SceneRatio(shadow=shadow.clamp(0, 1), bounce=bounce.clamp_min(0)), variation
