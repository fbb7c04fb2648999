"""Puts an object's shadow and bounce on the Gaussians that can be reached, and splits those too wide for its edge.

Knows nothing about where the light is from, nor about files.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.splitting import PIECE_WIDTH, PIECES, split_along
from splatgraft.relighting.shadows.scene_ratio import ObjectShadowMaps, SceneRatio, light_sums, ratio_of

_ROUNDS = 12
RIM = 2.4
"""Standard deviations; beyond, a Gaussian's alpha is below 0.05."""
_STEPS = (-RIM, -RIM / 2, 0.0, RIM / 2, RIM)
_LINES = torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.7, 0.7], [0.7, -0.7]])
_BROAD, _FINEST = 0.1, 0.02  # object radii
_VARIATION = 0.003  # share of light times alpha: what many that overlap may each leave out
SHOWS_BEHIND = 1.2
"""Standard deviations. Splats are blended in the order of their centres, so that what shows of one among others lies
behind its centre, seen from the camera; without this every edge stands too far from all cameras. Measured on planes:
1.0 for opaque ones side by side, 1.4 to 2 for the pieces of split ones, of which many overlap."""
_UNSEEN = 0.25  # of the finest width that is split: an edge in narrower ones is not looked for
_AT_RIMS = 0.02  # share of light: a rim shows a twentieth of it


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
    receivers: Receivers, maps: ObjectShadowMaps, *, budget: int
) -> tuple[Receivers, Int[Tensor, "j"], SceneRatio]:
    """Receivers, some split (at most `budget` added); which one each was; their ratios, averaged over their extent."""
    done: list[tuple[Receivers, Tensor, SceneRatio]] = []
    pending, which = receivers, torch.arange(len(receivers.origin))
    ambient = _sums(pending, maps, sources=False)
    for round_ in range(_ROUNDS + 1):
        ratio, variation = _extended_ratio(pending, maps, ambient)
        axis = variation.argmax(1)
        wanted = variation.max(1).values
        wanted = torch.where((wanted > _VARIATION) & (pending.gaussians.opacities > 0.05), wanted, 0)
        room = budget // (PIECES - 1)
        if round_ == _ROUNDS or room == 0 or not bool((wanted > 0).any()):
            done.append((pending, which, ratio))
            break
        order = wanted.argsort(descending=True)[: min(room, int((wanted > 0).sum()))]
        keep = torch.ones(len(wanted), dtype=torch.bool)
        keep[order] = False
        kept = SceneRatio(shadow=ratio.shadow[keep], bounce=ratio.bounce[keep], slope=ratio.slope[keep])
        done.append((pending.select(keep), which[keep], kept))
        parents = pending.select(order)
        pieces, parent = split_along(parents.gaussians, axis[order])
        pending = replace(parents.select(parent), gaussians=pieces)
        which, ambient = which[order][parent], ambient[:, order][:, parent]
        # ambient light differs between pieces only where the whole was broad
        anew = _broad(parents.gaussians, maps)[parent].nonzero()[:, 0]
        ambient[:, anew] = _sums(pending.select(anew), maps, sources=False)
        budget -= (PIECES - 1) * len(order)
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
    slope = torch.cat([ratio.slope for _, _, ratio in done])
    parents = torch.cat([w for _, w, _ in done])
    return joined, parents, SceneRatio(1 - (1 - shadow) * trust, bounce * trust, slope * trust)


def _broad(gaussians: Gaussians, maps: ObjectShadowMaps) -> Bool[Tensor, "m"]:
    """Whether ambient light may differ within one: it has no edge that is finer than a part of the object."""
    return gaussians.scales.max(1).values > _BROAD * maps.ambient_maps.window.radius


def _extended_ratio(
    receivers: Receivers, maps: ObjectShadowMaps, ambient: Float[Tensor, "3 m 3"]
) -> tuple[SceneRatio, Float[Tensor, "m 3"]]:
    """Ratio averaged over each Gaussian, and how much it varies along each own axis (0 along narrow ones).

    Variation counts as far as it is seen: by the Gaussian's alpha in the point. Splats are drawn in the order of their
    centres, so the rims of those in front cover what lies between them and the object.
    """
    g = receivers.gaussians
    by_sources = _sums(receivers, maps, sources=True)
    ratio, variation = ratio_of(by_sources + ambient), torch.zeros(g.count, 3)
    smallest = _FINEST * maps.ambient_maps.window.radius / math.sqrt(PIECE_WIDTH)
    broad = _broad(g, maps)
    fine = ((g.scales.max(1).values > smallest) & ~broad).nonzero()[:, 0]
    fine = _at_an_edge(receivers, maps, fine, (by_sources, ambient)) if bool(by_sources.any()) else fine[:0]
    _average(receivers, maps, fine, (ratio, variation), ambient=ambient[:, fine])
    _average(receivers, maps, broad.nonzero()[:, 0], (ratio, variation), ambient=None)
    _lean(receivers, maps, _in_penumbra(g, by_sources, ratio, smallest), ratio, ambient=ambient)
    variation[g.scales < smallest] = 0
    return ratio, variation


def _sums(receivers: Receivers, maps: ObjectShadowMaps, *, sources: bool, points: Tensor | None = None) -> Tensor:
    """Light at the middle of every receiver, or at `points`, as many for each."""
    if points is None:
        points = receivers.gaussians.means[:, None]
    count = points.shape[1]
    normals, arrives = (t.repeat_interleave(count, 0) for t in (receivers.normals, receivers.arrives))
    return light_sums(maps, points.reshape(-1, 3), normals, arrives=arrives, sources=sources)


def _at_an_edge(
    receivers: Receivers,
    maps: ObjectShadowMaps,
    which: Int[Tensor, "f"],
    center: tuple[Float[Tensor, "3 m 3"], Float[Tensor, "3 m 3"]],
) -> Int[Tensor, "g"]:
    """Those of `which` that see a source differently at their rims than in their middle."""
    if not len(which):
        return which
    part, ambient = receivers.select(which), center[1][:, which, None]
    rims = _points(part.gaussians, torch.tensor([[RIM, -RIM, 0.0, 0.0], [0.0, 0.0, RIM, -RIM]]))
    there = _sums(part, maps, sources=True, points=rims).reshape(3, len(which), -1, 3) + ambient
    here = center[0][:, which, None] + ambient
    changes = (there[1] / there[0].clamp_min(1e-9) - here[1] / here[0].clamp_min(1e-9)).abs()
    return which[changes.amax((1, 2)) > _AT_RIMS]


def _average(
    receivers: Receivers,
    maps: ObjectShadowMaps,
    which: Int[Tensor, "f"],
    found: tuple[SceneRatio, Float[Tensor, "m 3"]],
    *,
    ambient: Float[Tensor, "3 f 3"] | None,
) -> None:
    """Fill in mean and variation of those Gaussians from points along both wide axes, and between them.

    `ambient`, if given, is even over each; then so narrow ones are not asked between their axes.
    """
    if not len(which):
        return
    part, lines, line = receivers.select(which), 2 if ambient is not None else 4, torch.tensor(_STEPS)
    beside = line[line != 0]
    points = _points(part.gaussians, (_LINES[:lines, :, None] * beside).transpose(0, 1).flatten(1))
    sums = _sums(part, maps, sources=True, points=points)
    if ambient is None:
        sums = sums + _sums(part, maps, sources=False, points=points)
    else:
        sums = sums + ambient.repeat_interleave(lines * len(beside), 1)
    there = ratio_of(sums)
    ratio, variation = found
    shadow = _with_middle(there.shadow.reshape(len(which), lines, len(beside), 3), ratio.shadow[which])
    bounce = _with_middle(there.bounce.reshape(len(which), lines, len(beside), 3), ratio.bounce[which])
    # what is seen of a Gaussian is mostly its middle: half the weight of its width
    seen = torch.exp(-(line**2))[:, None]
    seen = seen / seen.sum()
    ratio.shadow[which] = _both_ways((shadow * seen).sum(2), ratio.shadow[which]).clamp(0, 1)
    ratio.bounce[which] = _both_ways((bounce * seen).sum(2), ratio.bounce[which]).clamp_min(0)
    alpha = part.gaussians.opacities[:, None, None] * torch.exp(-0.5 * line**2)
    moves = ((shadow - shadow.mean(2, keepdim=True)).abs().amax(3) * alpha).amax(2)
    if lines > 2:
        # half of what varies between the axes is along either
        moves = torch.maximum(moves[:, :2], 0.5 * moves[:, 2:].amax(1, keepdim=True))
    along = (((shadow + bounce).mean(3) * seen[:, 0] * line).sum(2) / (seen[:, 0] * line**2).sum())[:, :2]
    ratio.slope[which] = SHOWS_BEHIND * _in_world(part.gaussians, along)
    variation[which[:, None], part.gaussians.scales.argsort(1, descending=True)[:, :2]] = moves


def _with_middle(beside: Float[Tensor, "f l s 3"], middle: Float[Tensor, "f 3"]) -> Float[Tensor, "f l t 3"]:
    """Values along lines, t = s + 1, from those at the steps but the middle one."""
    half = beside.shape[2] // 2
    there = middle[:, None, None].expand(-1, beside.shape[1], 1, 3)
    return torch.cat([beside[:, :, :half], there, beside[:, :, half:]], 2)


def _in_penumbra(
    gaussians: Gaussians, by_sources: Float[Tensor, "3 m 3"], ratio: SceneRatio, smallest: float
) -> Int[Tensor, "p"]:
    """Those too narrow to be averaged, yet not so narrow that an edge crosses them unseen."""
    before, after, _ = by_sources.mean(-1)
    cut = (after > _AT_RIMS * before) & (after < (1 - _AT_RIMS) * before)
    widest = gaussians.scales.max(1).values
    unknown = (ratio.slope == 0).all(1)
    return (cut & unknown & (widest > _UNSEEN * smallest) & (gaussians.opacities > 0.05)).nonzero()[:, 0]


def _lean(
    receivers: Receivers,
    maps: ObjectShadowMaps,
    which: Int[Tensor, "p"],
    ratio: SceneRatio,
    *,
    ambient: Float[Tensor, "3 m 3"],
) -> None:
    """Fill in the slope of those Gaussians from points beside their middle; ambient light is even over each."""
    if not len(which):
        return
    part = receivers.select(which)
    beside = _points(part.gaussians, torch.eye(2))
    there = ratio_of(_sums(part, maps, sources=True, points=beside) + ambient[:, which].repeat_interleave(2, 1))
    here = (ratio.shadow[which] + ratio.bounce[which]).mean(1, keepdim=True)
    along = (there.shadow + there.bounce).mean(1).reshape(-1, 2) - here
    ratio.slope[which] = SHOWS_BEHIND * _in_world(part.gaussians, along)


def _in_world(gaussians: Gaussians, along: Float[Tensor, "n 2"]) -> Float[Tensor, "n 3"]:
    """A vector given along the two widest axes."""
    return (_widest(gaussians)[1] @ along[..., None])[..., 0]


def _both_ways(along: Float[Tensor, "f l 3"], middle: Float[Tensor, "f 3"]) -> Float[Tensor, "f 3"]:
    """Mean over an ellipse from those along its axes: what they differ from the middle by adds up."""
    return along[:, 0] + along[:, 1] - middle


def _points(gaussians: Gaussians, offsets: Float[Tensor, "2 p"]) -> Float[Tensor, "n p 3"]:
    """Points at `offsets`, standard deviations, along the two widest axes."""
    widths, axes = _widest(gaussians)
    return gaussians.means[:, None] + ((axes * widths[:, None]) @ offsets).transpose(1, 2)


def _widest(gaussians: Gaussians) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 3 2"]]:
    """The two largest scales, and their axes as columns in the world."""
    widths, axes = gaussians.scales.sort(1, descending=True)
    return widths[:, :2], torch.gather(gaussians.rotations, 2, axes[:, None, :2].expand(-1, 3, -1))
