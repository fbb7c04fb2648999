"""Receivers of shadows: an object's shadow and bounce on Gaussians, and splitting of wide ones at shadow edges.

A Gaussian has one colour, so a Gaussian wider than a shadow's edge cannot show it. `shade_receivers` repeats:

1. Compute the ratio at the centre of each Gaussian.
2. While the budget lasts, split the Gaussians with the largest variation along an axis (`_most_varying_axis`).

A plain surface is a layer of Gaussians whose centres lie above and below it. The layer's middle (`layer_middle`) is the
surface. Visibility is tested above its top (`layer_height`), because upper Gaussians would shadow lower ones (acne).
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
"""Radius of a Gaussian's rim, standard deviations; its alpha is below 0.05 beyond."""
_LINES = torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.7, 0.7], [0.7, -0.7]])  # directions, in the two widest axes

# which receivers are split; set by hand
_MAX_SPLITS = 12  # most splits of one Gaussian and its pieces, one after another
_BROAD = 0.1  # object radii (standard deviation); ambient light is compared over wider Gaussians alone
_FINEST = 0.02  # object radii (standard deviation); no piece gets narrower
_VARIATION = 0.003  # share of light times alpha below which a Gaussian is not split; small because many overlap
_FAINTEST = 0.05  # opacity below which a Gaussian is not split
_EDGE = 0.02  # share of light by which rim and centre differ at an edge; a rim shows a twentieth of it


@dataclass(frozen=True)
class Receivers:
    """m Gaussians of the scene that may be in an object's shadow, with their normals and visibility."""

    gaussians: Gaussians
    """World frame."""
    normals: Float[Tensor, "m 3"]
    """Unit, world frame."""
    sample_visibility: Float[Tensor, "m k"]
    """Share of every light sample that the scene lets through, in [0, 1]."""
    surface: Float[Tensor, "m 3"]
    """Point of the surface that each one shows, world units; pieces keep the point of their whole."""
    origin: Int[Tensor, "m"]
    """Position in the list that each one was taken from."""

    def select(self, which: Tensor) -> "Receivers":
        """Select receivers by a mask or by indices."""
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
    """Split receivers at shadow edges, and compute the ratio at the centre of each.

    Args:
        receivers: All receivers that the object may reach.
        maps: The object's shadow maps.
        budget: Largest number of Gaussians that splitting adds.

    Returns:
        j receivers, some of them pieces; the position in `receivers` of each or of its whole; their ratios; and the
        ambient part of their light sums, as `light_sums` gives it.
    """
    done: list[tuple[Receivers, Tensor, SceneRatio, Tensor]] = []
    pending, which = receivers, torch.arange(len(receivers.origin))
    ambient = _sums(pending, maps, sources=False)
    for round_ in range(_MAX_SPLITS + 1):
        by_sources = _sums(pending, maps, sources=True)
        ratio, room = ratio_from_sums(by_sources + ambient), budget // (PIECES - 1)
        if round_ == _MAX_SPLITS or room == 0:
            break
        axis, wanted = _most_varying_axis(pending, maps, (by_sources, ambient), ratio)
        if not bool((wanted > 0).any()):
            break
        order = wanted.argsort(descending=True)[: min(room, int((wanted > 0).sum()))]
        keep = torch.ones(len(wanted), dtype=torch.bool)
        keep[order] = False
        done.append((pending.select(keep), which[keep], ratio.select(keep), ambient[:, keep]))
        parents = pending.select(order)
        pieces, parent = split_along(parents.gaussians, axis[order])
        pending = replace(parents.select(parent), gaussians=pieces)
        which, ambient = which[order][parent], ambient[:, order][:, parent]
        # ambient light differs between the pieces of a broad Gaussian alone
        anew = _broad(parents.gaussians, maps)[parent].nonzero()[:, 0]
        ambient[:, anew] = _sums(pending.select(anew), maps, sources=False)
        budget -= (PIECES - 1) * len(order)
    done.append((pending, which, ratio, ambient))
    joined = Receivers(
        gaussians=concatenate([r.gaussians for r, _, _, _ in done]),
        normals=torch.cat([r.normals for r, _, _, _ in done]),
        sample_visibility=torch.cat([r.sample_visibility for r, _, _, _ in done]),
        surface=torch.cat([r.surface for r, _, _, _ in done]),
        origin=torch.cat([r.origin for r, _, _, _ in done]),
    )
    ratios = SceneRatio(
        shadow=torch.cat([ratio.shadow for _, _, ratio, _ in done]),
        bounce=torch.cat([ratio.bounce for _, _, ratio, _ in done]),
        slope=torch.cat([ratio.slope for _, _, ratio, _ in done]),
    )
    return joined, torch.cat([w for _, w, _, _ in done]), ratios, torch.cat([a for *_, a in done], 1)


def _broad(gaussians: Gaussians, maps: ObjectShadowMaps) -> Bool[Tensor, "m"]:
    """Select Gaussians so wide that ambient light may vary over them."""
    return gaussians.scales.max(1).values > _BROAD * maps.sphere.radius


def _most_varying_axis(
    receivers: Receivers,
    maps: ObjectShadowMaps,
    center_sums: tuple[Float[Tensor, "3 m 3"], Float[Tensor, "3 m 3"]],
    ratio: SceneRatio,
) -> tuple[Int[Tensor, "m"], Float[Tensor, "m"]]:
    """Find the axis along which each Gaussian's shadow varies most visibly, and that variation; 0 if it is too small.

    Variation at a point is weighted by the Gaussian's alpha there. It is 0 along axes too narrow to split.

    Args:
        receivers: The m Gaussians.
        maps: The object's shadow maps.
        center_sums: Light sums at their centres by the sources, and by the ambient light.
        ratio: Ratios at their centres.
    """
    g, (by_sources, ambient) = receivers.gaussians, center_sums
    variation = torch.zeros(g.count, 3)
    smallest = _FINEST * maps.sphere.radius / math.sqrt(PIECE_WIDTH)
    broad = _broad(g, maps)
    fine = ((g.scales.max(1).values > smallest) & ~broad).nonzero()[:, 0]
    fine = _at_an_edge(receivers, maps, fine, center_sums) if bool(by_sources.any()) else fine[:0]
    for which, is_broad in ((fine, False), (broad.nonzero()[:, 0], True)):
        if len(which):
            part, shadow = receivers.select(which), ratio.shadow[which]
            moves = _variation(part, maps, shadow, ambient[:, which], broad=is_broad)
            variation = variation.index_copy(0, which, moves)
    most, axis = torch.where(g.scales < smallest, 0, variation).max(1)
    return axis, torch.where((most > _VARIATION) & (g.opacities > _FAINTEST), most, 0)


def _sums(receivers: Receivers, maps: ObjectShadowMaps, *, sources: bool, points: Tensor | None = None) -> Tensor:
    """Compute light sums at every receiver's centre, or at its own `points` (receiver, point, axis)."""
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
    """Select from `which` the receivers whose rims get another share of the light than their centres."""
    if not len(which):
        return which
    by_sources, by_ambient = center_sums
    part, ambient = receivers.select(which), by_ambient[:, which, None]
    rims = _points(part.gaussians, torch.tensor([[RIM, -RIM, 0.0, 0.0], [0.0, 0.0, RIM, -RIM]]))
    at_rims = _sums(part, maps, sources=True, points=rims).reshape(3, len(which), -1, 3) + ambient
    at_center = by_sources[:, which, None] + ambient
    changes = (at_rims[1] / at_rims[0].clamp_min(1e-9) - at_center[1] / at_center[0].clamp_min(1e-9)).abs()
    return which[changes.amax((1, 2)) > _EDGE]


def _variation(
    receivers: Receivers,
    maps: ObjectShadowMaps,
    centers: Float[Tensor, "f 3"],
    ambient: Float[Tensor, "3 f 3"],
    *,
    broad: bool,
) -> Float[Tensor, "f 3"]:
    """Measure the variation of the shadow along each axis of f Gaussians, from points along both wide axes.

    Args:
        receivers: The f Gaussians.
        maps: The object's shadow maps.
        centers: Shadow at their centres.
        ambient: The ambient part of the light sums at their centres.
        broad: Whether ambient light varies over each Gaussian; points along the diagonals are then added.
    """
    g, lines, line = receivers.gaussians, 4 if broad else 2, RIM * torch.tensor([-1, -0.5, 0, 0.5, 1])
    beside = line[line != 0]
    offsets = (_LINES[:lines, :, None] * beside).transpose(0, 1).flatten(1)
    sums = _sums(receivers, maps, sources=True, points=_points(g, offsets))
    if broad:
        sums = sums + _ambient_at(receivers, maps, ambient, offsets).flatten(1, 2)
    else:
        sums = sums + ambient.repeat_interleave(offsets.shape[1], 1)
    there = ratio_from_sums(sums).shadow.reshape(g.count, lines, len(beside), 3)
    half, here = len(beside) // 2, centers[:, None, None].expand(-1, lines, 1, 3)
    shadow = torch.cat([there[:, :, :half], here, there[:, :, half:]], 2)
    alpha = g.opacities[:, None, None] * torch.exp(-0.5 * line**2)
    moves = ((shadow - shadow.mean(2, keepdim=True)).abs().amax(3) * alpha).amax(2)
    if lines > 2:
        # half of what varies along a diagonal is along either axis
        moves = torch.maximum(moves[:, :2], 0.5 * moves[:, 2:].amax(1, keepdim=True))
    wide_axes = g.scales.argsort(1, descending=True)[:, :2]
    return torch.zeros(g.count, 3).scatter(1, wide_axes, moves)


def _ambient_at(
    receivers: Receivers, maps: ObjectShadowMaps, ambient: Float[Tensor, "3 f 3"], offsets: Float[Tensor, "2 p"]
) -> Float[Tensor, "3 f p 3"]:
    """Compute the ambient light sums at offsets, by parabolas through the centre and two points on each wide axis."""
    step = 0.5 * RIM
    points = _points(receivers.gaussians, torch.tensor([[step, -step, 0.0, 0.0], [0.0, 0.0, step, -step]]))
    sums = _sums(receivers, maps, sources=False, points=points).reshape(3, len(points), 2, 2, 3)
    ahead, behind, here = sums[..., 0, :], sums[..., 1, :], ambient[:, :, None]
    slope, curvature = (ahead - behind) / (2 * step), (ahead + behind - 2 * here) / (2 * step**2)
    moved = torch.einsum("sfac,ap->sfpc", slope, offsets) + torch.einsum("sfac,ap->sfpc", curvature, offsets**2)
    return (here + moved).clamp_min(0)


def _points(gaussians: Gaussians, offsets: Float[Tensor, "2 p"]) -> Float[Tensor, "n p 3"]:
    """Compute points at `offsets`, which are in standard deviations along the two widest axes."""
    widths, axes = gaussians.scales.sort(1, descending=True)
    along = torch.gather(gaussians.rotations, 2, axes[:, None, :2].expand(-1, 3, -1)) * widths[:, None, :2]
    return gaussians.means[:, None] + (along @ offsets).transpose(1, 2)


def layer_height(gaussians: Gaussians, normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Compute the height of the surface layer's top over each Gaussian: 3 standard deviations above its middle.

    Args:
        gaussians: n Gaussians.
        normals: Unit normals of their surfaces.

    Returns:
        World units along the normal.
    """
    middle, deviation = _layer(gaussians, normals, 16)  # neighbours, as for a normal
    return middle + 3 * deviation


def layer_middle(gaussians: Gaussians, normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Compute the middle of the surface layer along each Gaussian's normal.

    Args:
        gaussians: n Gaussians.
        normals: Unit normals of their surfaces.

    Returns:
        Points in world units.
    """
    middle, _ = _layer(gaussians, normals, 48)  # neighbours
    return gaussians.means + middle[:, None] * normals


def _layer(
    gaussians: Gaussians, normals: Float[Tensor, "n 3"], count: int
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Compute mean and standard deviation of the layer's height over each Gaussian's centre.

    The variance is that of the neighbours' centres plus their own mean variance along the normal.
    """
    if not gaussians.count:
        return torch.zeros(0), torch.zeros(0)
    near = nearest_neighbours(gaussians.means, count=count)
    heights = ((gaussians.means[near] - gaussians.means[:, None]) * normals[:, None]).sum(-1)
    own = ((torch.einsum("nij,ni->nj", gaussians.rotations, normals) * gaussians.scales) ** 2).sum(1)
    return heights.mean(1), (heights.var(1, correction=0) + own[near].mean(1)).sqrt()
