"""Puts an object's shadow and bounce on the Gaussians that can be reached, and splits those too wide for its edge.

Knows nothing about where the light is from, nor about files.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatgraft.gaussians import Gaussians, concatenate
from splatgraft.relight.scene_shading import ObjectMaps, SceneRatio, light_sums, ratio_of
from splatgraft.splitting import NARROWER, split_along

_ROUNDS = 12
RIM = 2.4
"""Standard deviations; beyond, a Gaussian's alpha is below 0.05."""
_GRID = (-RIM, -RIM / 2, 0.0, RIM / 2, RIM)
_BROAD, _FINEST = 0.1, 0.02  # object radii
_VARIATION = 0.005  # share of light times alpha: a tenth of the contrast at which an edge is seen, as many overlap


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
    smallest = _FINEST * maps.ambient_maps.window.radius
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
    """Ratio averaged over each Gaussian, and how much it varies along each own axis (0 along narrow ones).

    Variation counts as far as it is seen: by the Gaussian's alpha in the point. Splats are drawn in the order of their
    centres, so the rims of those in front cover what lies between them and the object.
    """
    g = receivers.gaussians
    center = [_sums(receivers, maps, sources=flag) for flag in (True, False)]
    ratio, variation = ratio_of(center[0] + center[1]), torch.zeros(g.count, 3)
    widest = g.scales.max(1).values
    # ambient light has no edge that is finer than a part of the object
    broad = widest > _BROAD * maps.ambient_maps.window.radius
    fine = (widest > smallest / math.sqrt(NARROWER)) & ~broad
    if bool(center[0].any()):
        fine = _at_an_edge(receivers, maps, fine.nonzero()[:, 0], center)
        _average(receivers, maps, fine, ratio, variation, ambient=center[1][:, fine])
    _average(receivers, maps, broad.nonzero()[:, 0], ratio, variation, ambient=None)
    variation[g.scales < smallest / math.sqrt(NARROWER)] = 0
    return ratio, variation


def _sums(receivers: Receivers, maps: ObjectMaps, *, sources: bool, points: Tensor | None = None) -> Tensor:
    """Light at the middle of every receiver, or at `points`, as many for each."""
    if points is None:
        points = receivers.gaussians.means[:, None]
    count = points.shape[1]
    normals, arrives = (t.repeat_interleave(count, 0) for t in (receivers.normals, receivers.arrives))
    return light_sums(maps, points.reshape(-1, 3), normals, arrives=arrives, sources=sources)


def _at_an_edge(
    receivers: Receivers, maps: ObjectMaps, which: Int[Tensor, "f"], center: list[Tensor]
) -> Int[Tensor, "g"]:
    """Those of `which` that see a source differently at their rims than in their middle."""
    if not len(which):
        return which
    part = receivers.select(which)
    rims = _points(part.gaussians, torch.tensor([[RIM, -RIM, 0.0, 0.0], [0.0, 0.0, RIM, -RIM]]))
    sums = _sums(part, maps, sources=True, points=rims).reshape(3, len(which), -1, 3)
    after, before = sums[1] + center[1][1, which, None], sums[0] + center[1][0, which, None]
    there = after / before.clamp_min(1e-9)
    middle = (center[0] + center[1])[:, which]
    here = middle[1] / middle[0].clamp_min(1e-9)
    return which[(there - here[:, None]).abs().amax((1, 2)) > _VARIATION]


def _average(
    receivers: Receivers,
    maps: ObjectMaps,
    which: Int[Tensor, "f"],
    ratio: SceneRatio,
    variation: Float[Tensor, "m 3"],
    *,
    ambient: Float[Tensor, "3 f 3"] | None,
) -> None:
    """Fill in mean and variation of those Gaussians, from points all over them; `ambient` is even there if given."""
    if not len(which):
        return
    part, size = receivers.select(which), len(_GRID)
    u, v = torch.meshgrid(torch.tensor(_GRID), torch.tensor(_GRID), indexing="ij")
    points = _points(part.gaussians, torch.stack([u.flatten(), v.flatten()]))
    sums = _sums(part, maps, sources=True, points=points)
    if ambient is None:
        sums = sums + _sums(part, maps, sources=False, points=points)
    else:
        sums = sums + ambient.repeat_interleave(size * size, 1)
    found = ratio_of(sums)
    there, sent = (t.reshape(len(which), size, size, 3) for t in (found.shadow, found.bounce))
    # what is seen of a Gaussian is mostly its middle: half the weight of its width
    seen = torch.exp(-(u**2 + v**2))[..., None]
    seen = seen / seen.sum()
    ratio.shadow[which] = (there * seen).sum((1, 2)).clamp(0, 1)
    ratio.bounce[which] = (sent * seen).sum((1, 2)).clamp_min(0)
    alpha = part.gaussians.opacities[:, None, None] * torch.exp(-0.5 * (u**2 + v**2))
    axes = part.gaussians.scales.argsort(1, descending=True)
    for i, axis in enumerate((1, 2)):
        moves = ((there - there.mean(axis, keepdim=True)).abs().amax(3) * alpha).amax((1, 2))
        variation[which, axes[:, i]] = moves


def _points(gaussians: Gaussians, offsets: Float[Tensor, "2 p"]) -> Float[Tensor, "n p 3"]:
    """Points at `offsets`, standard deviations, along the two widest axes."""
    widths, axes = gaussians.scales.sort(1, descending=True)
    along = torch.gather(gaussians.rotations, 2, axes[:, None, :2].expand(-1, 3, -1)) * widths[:, None, :2]
    return gaussians.means[:, None] + (along @ offsets).transpose(1, 2)
