"""A place's light evidence and estimate as maps of fixed size, upright: what a network learns the light from.

A map has a row per height and a column per azimuth, so that a turn about the up axis only shifts its columns. What is
known per direction is averaged over the directions near a cell; what is known per surface over the surfaces whose
normal is near it.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatgraft.core.directions import frames_along
from splatgraft.relighting.light.estimate import EstimatedLight
from splatgraft.relighting.light.radiance_model import LightEvidence
from splatgraft.relighting.light.surroundings import DIRECTIONS

ROWS, COLUMNS = 12, 24
"""Cells of 15 degrees; row 0 is straight up."""
MAPS = (
    "seen",
    "seen far away",
    "red",
    "green",
    "blue",
    "clipped",
    "nearness",
    "estimated",
    "estimated unseen",
    "estimated clipped",
    "surfaces' weight",
    "surfaces' brightness",
    "surfaces' residual",
    "open sky of surfaces",
    "highlights explained alone",
)
"""What the maps of a description are."""
NUMBERS = (
    "log brightness of surfaces",
    "scatter of log brightness",
    "root mean square residual",
    "probability of the best maximum",
    "highlights' part of colour",
    "tint red over green",
    "tint blue over green",
)
"""What its single numbers are."""
_DARKEST = 1e-3
_DIRECTION_WIDTH = math.radians(8)
"""Radians; standard deviation of the weight of directions around a cell."""
_NORMAL_WIDTH = math.radians(20)
"""The same of surfaces' normals: there are few."""


@dataclass(frozen=True)
class PlaceDescription:
    """The light evidence at a place; maps are upright, with an arbitrary azimuth."""

    maps: Float[Tensor, "f 12 24"]
    """As `MAPS` lists them; logarithms base 2 of linear radiance, shares in [0, 1]."""
    numbers: Float[Tensor, "g"]
    """As `NUMBERS` lists them."""


def cell_directions() -> Float[Tensor, "12 24 3"]:
    """Unit direction of each cell's middle, upright frame: +z is up, the first column is near +x."""
    height = math.pi / 2 - (torch.arange(ROWS) + 0.5) * math.pi / ROWS
    turn = (torch.arange(COLUMNS) + 0.5) * 2 * math.pi / COLUMNS
    flat = height.cos()[:, None]
    return torch.stack([flat * turn.cos(), flat * turn.sin(), height.sin()[:, None].expand(ROWS, COLUMNS)], -1)


def cell_solid_angles() -> Float[Tensor, "12 24"]:
    """Steradians; they sum to 4 pi."""
    edges = torch.cos(torch.arange(ROWS + 1) * math.pi / ROWS)
    return ((edges[:-1] - edges[1:]) * 2 * math.pi / COLUMNS)[:, None].expand(ROWS, COLUMNS)


def cell_of(towards: Float[Tensor, "n 3"]) -> Int[Tensor, "n"]:
    """Index of the cell that each upright direction lies in, row by row."""
    row = (towards[:, 2].clamp(-1, 1).acos() / math.pi * ROWS).long().clamp_max(ROWS - 1)
    turn = torch.atan2(towards[:, 1], towards[:, 0]) % (2 * math.pi)
    return row * COLUMNS + (turn / (2 * math.pi) * COLUMNS).long().clamp_max(COLUMNS - 1)


def upright_from_world(up: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """A rotation whose rows are two horizontal axes and `up`: it takes world directions to the upright frame."""
    return frames_along(-up[None])[0]


def around_cells(
    values: Float[Tensor, "n c"], directions: Float[Tensor, "n 3"], width: float, weights: Float[Tensor, "n"]
) -> tuple[Float[Tensor, "12 24 c"], Float[Tensor, "12 24"]]:
    """Means of values over the directions near each cell, and the sums of weights there.

    Args:
        values: Per direction.
        directions: Unit, upright frame.
        width: Radians; standard deviation of the weight by angle.
        weights: Of the directions, none negative.
    """
    cells = cell_directions().reshape(-1, 3)
    near = ((cells @ directions.T - 1) / width**2).exp() * weights
    total = near.sum(1)
    mean = near @ values / total.clamp_min(1e-9)[:, None]
    return mean.reshape(ROWS, COLUMNS, -1), total.reshape(ROWS, COLUMNS)


def describe_place(found: EstimatedLight) -> PlaceDescription:
    """Describe what is known at the place of an estimate, and the estimate itself."""
    evidence = found.evidence
    turned = DIRECTIONS @ upright_from_world(evidence.up).T
    even = torch.ones(len(DIRECTIONS))
    of_directions = _direction_values(found)
    by_direction = around_cells(of_directions, turned, _DIRECTION_WIDTH, even)[0]
    by_normal = _surface_maps(found)
    maps = torch.cat([by_direction[..., :10], by_normal, by_direction[..., 10:]], -1)
    return PlaceDescription(maps.permute(2, 0, 1).contiguous(), _numbers(found))


def _direction_values(found: EstimatedLight) -> Float[Tensor, "k c"]:
    evidence, hidden = found.evidence, found.hidden
    around, far = evidence.around, evidence.far
    estimated = hidden.radiance(evidence, found.tint).mean(1)
    nearness = evidence.surfaces.region.radius / around.distance.clamp_min(1e-3)
    columns = [
        around.seen,
        far.seen,
        *_log(around.radiance).unbind(1),
        evidence.visible_sources,
        nearness.clamp(0, 4),
        _log(estimated),
        _log(hidden.unseen * (1 - around.seen).clamp_min(0)),
        _log(hidden.clipped * evidence.visible_sources),
        _explained_by_each(evidence),
    ]
    return torch.stack([column.float() for column in columns], 1)


def _explained_by_each(evidence: LightEvidence) -> Float[Tensor, "k"]:
    """Share of the view-dependent change that light from one direction alone explains."""
    found, k = evidence.highlights, len(DIRECTIONS)
    if found is None:
        return torch.zeros(k)
    return found.explained_with_more(torch.zeros(k), torch.arange(k), torch.ones(k))


def _surface_maps(found: EstimatedLight) -> Float[Tensor, "12 24 4"]:
    surfaces = found.evidence.surfaces
    if not len(surfaces.points):
        return torch.zeros(ROWS, COLUMNS, 4)
    normals = surfaces.normals @ upright_from_world(found.evidence.up).T
    values = torch.stack([_log(surfaces.colors.mean(1)), found.hidden.residual, surfaces.visibility.mean(1)], 1)
    mean, total = around_cells(values, normals, _NORMAL_WIDTH, surfaces.weights)
    # where no surface faces, the mean of all
    known = (total / (total + 0.01))[..., None]
    everywhere = (surfaces.weights[:, None] * values).sum(0) / surfaces.weights.sum().clamp_min(1e-9)
    return torch.cat([known, known * mean + (1 - known) * everywhere], -1)


def _numbers(found: EstimatedLight) -> Float[Tensor, "g"]:
    surfaces, highlights = found.evidence.surfaces, found.evidence.highlights
    weights = surfaces.weights / surfaces.weights.sum().clamp_min(1e-9)
    brightness = _log(surfaces.colors.mean(1))
    mean = float((weights * brightness).sum())
    part = 0.0 if highlights is None else math.sqrt(highlights.variance) / max(2**mean, _DARKEST)
    return torch.tensor(
        [
            mean,
            float((weights * (brightness - mean) ** 2).sum()) ** 0.5,
            float((weights * found.hidden.residual**2).sum()) ** 0.5,
            found.hidden.weights[0],
            part,
            float((found.tint[0] / found.tint[1].clamp_min(1e-3)).clamp_min(1e-2).log2()),
            float((found.tint[2] / found.tint[1].clamp_min(1e-3)).clamp_min(1e-2).log2()),
        ]
    )


def _log(values: Tensor) -> Tensor:
    return values.clamp_min(_DARKEST).log2()
