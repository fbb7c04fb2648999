"""Receivers of shadows: an object's shadow and bounce averaged over Gaussians, of which wide ones are split at edges.

A Gaussian has one colour, so one that is wider than a shadow's edge cannot show it: it is split along the axis over
which the ratio varies most, again and again while the budget lasts. A slope in the first band corrects where an edge
appears. A plain surface is a layer of Gaussians whose centres lie above and below it: the layer's middle is the
surface, and visibility is tested at its top, as the upper Gaussians would shadow the lower ones (shadow acne).
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.splitting import PIECE_WIDTH, PIECES, split_along
from splatgraft.relighting.nearest_neighbours import nearest_neighbours
from splatgraft.relighting.shadows.scene_ratio import (
    ObjectShadowMaps,
    SceneRatio,
    light_sums,
    ratio_from_sums,
)

RIM = 2.4
"""Standard deviations; beyond, a Gaussian's alpha is below 0.05."""
_STEPS = (-RIM, -RIM / 2, 0.0, RIM / 2, RIM)  # standard deviations of the points along a line
_LINES = torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.7, 0.7], [0.7, -0.7]])
"""Directions of lines, along the widest and the second widest axis."""

# which receivers are split, and how far an edge is corrected
_MAX_SPLITS = 12  # most splits of one Gaussian and its pieces, one after another; set by hand
_BROAD = 0.1  # object radii (standard deviation): ambient light is averaged over wider Gaussians alone; set by hand
_FINEST = 0.02  # object radii (standard deviation): no piece gets narrower; set by hand
_VARIATION = 0.003  # share of light times alpha below which a Gaussian is not split, small as many overlap; set by hand
_FAINTEST = 0.05  # opacity below which a Gaussian is not split and gets no slope; set by hand
_SHOWS_BEHIND = 1.2
"""Standard deviations. Splats are blended in the order of their centres, so what is visible of one among others
lies behind its centre, seen from the camera; without this an edge appears too far from all cameras. Measured on
planes: 1.0 for opaque ones side by side, 1.4 to 2 for the pieces of split ones, of which many overlap."""
_NARROWEST = 0.25  # share of the finest width that is split: narrower Gaussians get no slope; set by hand
_EDGE = 0.02  # share of light by which rim and centre differ at an edge; a rim shows a twentieth of it; set by hand


@dataclass(frozen=True)
class Receivers:
    """m Gaussians of the scene that may be in an object's shadow, with what is needed to light them."""

    gaussians: Gaussians
    """World frame."""
    normals: Float[Tensor, "m 3"]
    """Unit, world frame."""
    sample_visibility: Float[Tensor, "m k"]
    """Share of every light sample that the scene lets through, in [0, 1]."""
    surface: Float[Tensor, "m 3"]
    """A point of the surface that each one shows, world units; pieces keep that of their whole."""
    origin: Int[Tensor, "m"]
    """Position in the list that they were taken from."""

    def select(self, which: Tensor) -> "Receivers":
        """The receivers that a mask keeps or an index list names."""
        return Receivers(
            gaussians=self.gaussians.select(which),
            normals=self.normals[which],
            sample_visibility=self.sample_visibility[which],
            surface=self.surface[which],
            origin=self.origin[which],
        )


def shade_receivers(
    receivers: Receivers, maps: ObjectShadowMaps, *, budget: int
) -> tuple[Receivers, Int[Tensor, "j"], SceneRatio, Float[Tensor, "3 j 3"]]:
    """Split receivers at shadow edges and average the ratio over each.

    Args:
        receivers: All that the object may reach.
        maps: The object's.
        budget: Most Gaussians that are added by splitting.

    Returns:
        j receivers, some of them pieces; the position in `receivers` that each was or is a piece of; their ratios; and
        the ambient part of their light sums, as `light_sums` gives it.
    """
    done: list[tuple[Receivers, Tensor, SceneRatio, Tensor]] = []
    pending, which = receivers, torch.arange(len(receivers.origin))
    ambient = _sums(pending, maps, sources=False)
    for round_ in range(_MAX_SPLITS + 1):
        ratio, variation = _averaged_ratio(pending, maps, ambient)
        axis = variation.argmax(1)
        wanted = variation.max(1).values
        wanted = torch.where((wanted > _VARIATION) & (pending.gaussians.opacities > _FAINTEST), wanted, 0)
        room = budget // (PIECES - 1)
        if round_ == _MAX_SPLITS or room == 0 or not bool((wanted > 0).any()):
            done.append((pending, which, ratio, ambient))
            break
        order = wanted.argsort(descending=True)[: min(room, int((wanted > 0).sum()))]
        keep = torch.ones(len(wanted), dtype=torch.bool)
        keep[order] = False
        kept = SceneRatio(shadow=ratio.shadow[keep], bounce=ratio.bounce[keep], slope=ratio.slope[keep])
        done.append((pending.select(keep), which[keep], kept, ambient[:, keep]))
        parents = pending.select(order)
        pieces, parent = split_along(parents.gaussians, axis[order])
        pending = replace(parents.select(parent), gaussians=pieces)
        which, ambient = which[order][parent], ambient[:, order][:, parent]
        # ambient light differs between pieces only where the whole was broad
        anew = _broad(parents.gaussians, maps)[parent].nonzero()[:, 0]
        ambient[:, anew] = _sums(pending.select(anew), maps, sources=False)
        budget -= (PIECES - 1) * len(order)
    joined = Receivers(
        gaussians=concatenate([r.gaussians for r, _, _, _ in done]),
        normals=torch.cat([r.normals for r, _, _, _ in done]),
        sample_visibility=torch.cat([r.sample_visibility for r, _, _, _ in done]),
        surface=torch.cat([r.surface for r, _, _, _ in done]),
        origin=torch.cat([r.origin for r, _, _, _ in done]),
    )
    ratios = SceneRatio(
        # not shadow itself: this rounds it to the precision near 1, as all results so far have it
        shadow=1 - (1 - torch.cat([ratio.shadow for _, _, ratio, _ in done])),
        bounce=torch.cat([ratio.bounce for _, _, ratio, _ in done]),
        slope=torch.cat([ratio.slope for _, _, ratio, _ in done]),
    )
    return joined, torch.cat([w for _, w, _, _ in done]), ratios, torch.cat([a for *_, a in done], 1)


def _broad(gaussians: Gaussians, maps: ObjectShadowMaps) -> Bool[Tensor, "m"]:
    """Whether ambient light may vary over a Gaussian: its edges are no finer than a part of the object."""
    return gaussians.scales.max(1).values > _BROAD * maps.ambient_maps.window.radius


def _averaged_ratio(
    receivers: Receivers, maps: ObjectShadowMaps, ambient: Float[Tensor, "3 m 3"]
) -> tuple[SceneRatio, Float[Tensor, "m 3"]]:
    """Ratio averaged over each Gaussian, and how much it varies along each own axis (0 along narrow ones).

    Variation at a point is weighted by the Gaussian's alpha there, as far as it is visible.
    """
    g = receivers.gaussians
    by_sources = _sums(receivers, maps, sources=True)
    ratio, variation = ratio_from_sums(by_sources + ambient), torch.zeros(g.count, 3)
    smallest = _FINEST * maps.ambient_maps.window.radius / math.sqrt(PIECE_WIDTH)
    broad = _broad(g, maps)
    fine = ((g.scales.max(1).values > smallest) & ~broad).nonzero()[:, 0]
    lit = bool(by_sources.any())
    fine = _at_an_edge(receivers, maps, fine, (by_sources, ambient)) if lit else fine[:0]
    _fill_in(ratio, variation, receivers, maps, which=fine, ambient=ambient[:, fine])
    _fill_in(ratio, variation, receivers, maps, which=broad.nonzero()[:, 0], ambient=None)
    penumbra = _in_penumbra(g, by_sources, ratio, smallest)
    _fill_in_slope(ratio, receivers, maps, penumbra, ambient=ambient)
    variation[g.scales < smallest] = 0
    return ratio, variation


def _sums(receivers: Receivers, maps: ObjectShadowMaps, *, sources: bool, points: Tensor | None = None) -> Tensor:
    """Light sums at every receiver's centre, or at `points`, as many for each receiver."""
    if points is None:
        points = receivers.gaussians.means[:, None]
    count = points.shape[1]
    normals, shares = (t.repeat_interleave(count, 0) for t in (receivers.normals, receivers.sample_visibility))
    return light_sums(maps, points.reshape(-1, 3), normals, sample_visibility=shares, sources=sources)


def _at_an_edge(
    receivers: Receivers,
    maps: ObjectShadowMaps,
    which: Int[Tensor, "f"],
    center_sums: tuple[Float[Tensor, "3 m 3"], Float[Tensor, "3 m 3"]],
) -> Int[Tensor, "g"]:
    """Those of `which` whose rims receive another share of the light than their centres."""
    if not len(which):
        return which
    by_sources, by_ambient = center_sums
    part, ambient = receivers.select(which), by_ambient[:, which, None]
    rims = _points(part.gaussians, torch.tensor([[RIM, -RIM, 0.0, 0.0], [0.0, 0.0, RIM, -RIM]]))
    at_rims = _sums(part, maps, sources=True, points=rims).reshape(3, len(which), -1, 3) + ambient
    at_center = by_sources[:, which, None] + ambient
    changes = (at_rims[1] / at_rims[0].clamp_min(1e-9) - at_center[1] / at_center[0].clamp_min(1e-9)).abs()
    return which[changes.amax((1, 2)) > _EDGE]


def _fill_in(
    ratio: SceneRatio,
    variation: Float[Tensor, "m 3"],
    receivers: Receivers,
    maps: ObjectShadowMaps,
    *,
    which: Int[Tensor, "f"],
    ambient: Float[Tensor, "3 f 3"] | None,
) -> None:
    """Average over the Gaussians `which` from points along both wide axes, and along the diagonals between them.

    `ambient`, if given, is constant over each: they are narrow, and not sampled along the diagonals.
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
    there = ratio_from_sums(sums)
    shadow = _with_center(there.shadow.reshape(len(which), lines, len(beside), 3), ratio.shadow[which])
    bounce = _with_center(there.bounce.reshape(len(which), lines, len(beside), 3), ratio.bounce[which])
    # mostly the centre of a Gaussian is visible: weights exp(-x^2), narrower than its alpha exp(-x^2 / 2)
    weight = torch.exp(-(line**2))[:, None]
    weight = weight / weight.sum()
    ratio.shadow[which] = _ellipse_mean((shadow * weight).sum(2), ratio.shadow[which]).clamp(0, 1)
    ratio.bounce[which] = _ellipse_mean((bounce * weight).sum(2), ratio.bounce[which]).clamp_min(0)
    alpha = part.gaussians.opacities[:, None, None] * torch.exp(-0.5 * line**2)
    moves = ((shadow - shadow.mean(2, keepdim=True)).abs().amax(3) * alpha).amax(2)
    if lines > 2:
        # half of what varies along a diagonal is along either axis
        moves = torch.maximum(moves[:, :2], 0.5 * moves[:, 2:].amax(1, keepdim=True))
    along = (((shadow + bounce).mean(3) * weight[:, 0] * line).sum(2) / (weight[:, 0] * line**2).sum())[:, :2]
    ratio.slope[which] = _SHOWS_BEHIND * _in_world(part.gaussians, along)
    variation[which[:, None], part.gaussians.scales.argsort(1, descending=True)[:, :2]] = moves


def _fill_in_slope(
    ratio: SceneRatio,
    receivers: Receivers,
    maps: ObjectShadowMaps,
    which: Int[Tensor, "p"],
    *,
    ambient: Float[Tensor, "3 m 3"],
) -> None:
    """The slope of the Gaussians `which` from points beside their centres; ambient light is constant over each."""
    if not len(which):
        return
    part = receivers.select(which)
    beside = _points(part.gaussians, torch.eye(2))
    sums = _sums(part, maps, sources=True, points=beside) + ambient[:, which].repeat_interleave(2, 1)
    there = ratio_from_sums(sums)
    here = (ratio.shadow[which] + ratio.bounce[which]).mean(1, keepdim=True)
    along = (there.shadow + there.bounce).mean(1).reshape(-1, 2) - here
    ratio.slope[which] = _SHOWS_BEHIND * _in_world(part.gaussians, along)


def _with_center(beside: Float[Tensor, "f l s 3"], center: Float[Tensor, "f 3"]) -> Float[Tensor, "f l t 3"]:
    """Values along lines, t = s + 1, from those at all steps but the centre."""
    half = beside.shape[2] // 2
    there = center[:, None, None].expand(-1, beside.shape[1], 1, 3)
    return torch.cat([beside[:, :, :half], there, beside[:, :, half:]], 2)


def _in_penumbra(
    gaussians: Gaussians, by_sources: Float[Tensor, "3 m 3"], ratio: SceneRatio, smallest: float
) -> Int[Tensor, "p"]:
    """Receivers in a penumbra that were too narrow to be averaged, yet are wide enough that their slope is visible."""
    without, with_object, _ = by_sources.mean(-1)
    partly = (with_object > _EDGE * without) & (with_object < (1 - _EDGE) * without)
    widest = gaussians.scales.max(1).values
    unknown = (ratio.slope == 0).all(1)
    visible = (widest > _NARROWEST * smallest) & (gaussians.opacities > _FAINTEST)
    return (partly & unknown & visible).nonzero()[:, 0]


def _in_world(gaussians: Gaussians, along: Float[Tensor, "n 2"]) -> Float[Tensor, "n 3"]:
    """World vectors from components along the two widest axes."""
    return (_widest(gaussians)[1] @ along[..., None])[..., 0]


def _ellipse_mean(along: Float[Tensor, "f l 3"], center: Float[Tensor, "f 3"]) -> Float[Tensor, "f 3"]:
    """Mean over an ellipse from the means along its two axes: their differences from the centre add up."""
    return along[:, 0] + along[:, 1] - center


def _points(gaussians: Gaussians, offsets: Float[Tensor, "2 p"]) -> Float[Tensor, "n p 3"]:
    """Points at `offsets`, in standard deviations along the two widest axes."""
    widths, axes = _widest(gaussians)
    return gaussians.means[:, None] + ((axes * widths[:, None]) @ offsets).transpose(1, 2)


def _widest(gaussians: Gaussians) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 3 2"]]:
    """The two largest scales, and their axes as columns, world frame."""
    widths, axes = gaussians.scales.sort(1, descending=True)
    return widths[:, :2], torch.gather(gaussians.rotations, 2, axes[:, None, :2].expand(-1, 3, -1))


# the layer around a receiver
_LAYER_NEIGHBOURS = 16  # gaussians that form the layer around one, as for its normal
_LEVEL_NEIGHBOURS = 48  # gaussians over whose heights the middle is taken
_LAYER_DEVIATIONS = 3.0  # standard deviations of the layer's height between its middle and its top


def above_layer(gaussians: Gaussians, normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """For each Gaussian the point on its normal's line at the top of the layer of its neighbours.

    The height's variance is that of the neighbours' centres and their own mean variance along the normal.

    Args:
        gaussians: n Gaussians.
        normals: Unit, of their surfaces.
    """
    middle, deviation = _layer(gaussians, normals, _LAYER_NEIGHBOURS)
    return gaussians.means + (middle + _LAYER_DEVIATIONS * deviation)[:, None] * normals


def layer_middle(gaussians: Gaussians, normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """For each Gaussian the point on its normal's line in the middle of the layer of its neighbours.

    Args:
        gaussians: n Gaussians.
        normals: Unit, of their surfaces.
    """
    return gaussians.means + _layer(gaussians, normals, _LEVEL_NEIGHBOURS)[0][:, None] * normals


def _layer(
    gaussians: Gaussians, normals: Float[Tensor, "n 3"], count: int
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Mean and standard deviation of the layer's height over each Gaussian's centre."""
    if not gaussians.count:
        return torch.zeros(0), torch.zeros(0)
    near = nearest_neighbours(gaussians.means, count=count)
    heights = ((gaussians.means[near] - gaussians.means[:, None]) * normals[:, None]).sum(-1)
    own = ((torch.einsum("nij,ni->nj", gaussians.rotations, normals) * gaussians.scales) ** 2).sum(1)
    return heights.mean(1), (heights.var(1, correction=0) + own[near].mean(1)).sqrt()
