"""Generated captures of an object on a table, with the true masks and a scene like a reconstruction of it.

Each `kind` is one way in which colour alone misleads: `plain` (it does not), `like_the_table` (the object has the
colour of the wooden table), `two_parts` (a dark pot below green leaves, on a dark cloth), `crowded` (others stand
beside it), `footed` (it stands on a ring of the table's colour). `on_a_wall` hangs on one, beside a stain of its own
colour and a shelf, and is photographed from the front.
"""

import math
from dataclasses import dataclass, replace

import torch
from shapes import UP, surfels
from torch import Tensor

from splatgraft.core.cameras import Cameras, look_at, pinhole
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.spherical_harmonics import dc_from_rgb
from splatgraft.rendering import render

KINDS = ("plain", "like_the_table", "two_parts", "crowded")
TABLE, WALL, FOOT = 0.7, 1.0, 0.04
WOOD, GREEN, DARK, CLAY = (0.55, 0.38, 0.24), (0.25, 0.42, 0.16), (0.18, 0.16, 0.16), (0.75, 0.30, 0.18)


@dataclass(frozen=True)
class ObjectCapture:
    """Pictures of a scene with an object, its true masks, and Gaussians near the true ones."""

    cameras: Cameras
    images: list[Tensor]
    """sRGB, (h, w, 3)."""
    masks: list[Tensor]
    """1 on the object, (h, w)."""
    scene: Gaussians
    """Gaussians displaced at random, as after a short reconstruction, and with floaters."""
    is_object: Tensor
    """Whether each Gaussian is the object's."""


def object_capture(kind: str, *, views: int = 12, size: tuple[int, int] = (160, 120), seed: int = 0) -> ObjectCapture:
    generator = torch.Generator().manual_seed(seed)
    object_, rest = _object(kind, generator), _surroundings(kind, generator)
    scene = concatenate([object_, rest])
    is_object = torch.arange(scene.count) < object_.count
    cameras = _cameras_before_wall(views, size) if kind == "on_a_wall" else _cameras(views, size)
    drawn = render(scene, cameras, features=is_object[:, None].float())
    noise = 0.01 * torch.randn(drawn.color.shape, generator=generator)
    moved = scene.means + 0.006 * torch.randn(scene.count, 3, generator=generator)
    count = 60
    floaters = Gaussians(
        means=(torch.rand(count, 3, generator=generator) - 0.5) * 2 + torch.tensor([0, 0, TABLE + 0.6]),
        log_scales=torch.full((count, 3), math.log(0.03)),
        quaternions=torch.randn(count, 4, generator=generator),
        opacity_logits=torch.full((count,), -2.0),
        sh=torch.zeros(count, 1, 3),
    )
    return ObjectCapture(
        cameras=cameras,
        images=list((drawn.color + noise).clamp(0, 1)),
        masks=list((drawn.features[..., 0] > 0.5).float()),
        scene=concatenate([replace(scene, means=moved), floaters]),
        is_object=torch.cat([is_object, torch.zeros(count, dtype=torch.bool)]),
    )


def _cameras(views: int, size: tuple[int, int]) -> Cameras:
    turn = torch.arange(views) / views * 2 * math.pi
    height = TABLE + 0.35 + 0.25 * (3 * turn).cos()
    eyes = torch.stack([1.1 * turn.cos(), 1.1 * turn.sin(), height], 1)
    return pinhole(
        look_at(eyes, torch.tensor([0.0, 0, TABLE + 0.15]), UP), 0.95 * size[0], width=size[0], height=size[1]
    )


def _cameras_before_wall(views: int, size: tuple[int, int]) -> Cameras:
    turn = torch.linspace(-0.8, 0.8, views)
    eyes = torch.stack([1.3 * turn.sin(), WALL - 1.3 * turn.cos(), 1.2 + 0.3 * (5 * turn).sin()], 1)
    return pinhole(look_at(eyes, torch.tensor([0.0, WALL, 1.2]), UP), 0.95 * size[0], width=size[0], height=size[1])


def _object(kind: str, generator: torch.Generator) -> Gaussians:
    if kind == "two_parts":
        pot = cylinder((0, 0, TABLE), radius=0.09, height=0.12, srgb=DARK, generator=generator)
        leaves = [
            ball((x, y, TABLE + z), radius=0.07, srgb=GREEN, generator=generator)
            for x, y, z in ((0.05, 0.0, 0.2), (-0.06, 0.03, 0.22), (0.0, -0.06, 0.27), (0.01, 0.05, 0.3))
        ]
        return concatenate([pot, *leaves])
    if kind == "footed":
        ring = cylinder((0, 0, TABLE), radius=0.1, height=FOOT, srgb=WOOD, generator=generator)
        return concatenate(
            [ring, cylinder((0, 0, TABLE + FOOT), radius=0.1, height=0.2, srgb=CLAY, generator=generator)]
        )
    if kind == "on_a_wall":
        plate = sheet((0, WALL - 0.03, 1.2), (0.12, 0, 0), (0, 0, 0.15), srgb=WOOD, generator=generator)
        return concatenate([plate, ball((0, WALL - 0.13, 1.22), radius=0.1, srgb=CLAY, generator=generator)])
    color = WOOD if kind == "like_the_table" else CLAY
    parts = [cylinder((0, 0, TABLE), radius=0.1, height=0.2, srgb=color, generator=generator)]
    return concatenate([*parts, ball((0, 0, TABLE + 0.24), radius=0.08, srgb=color, generator=generator)])


def _surroundings(kind: str, generator: torch.Generator) -> Gaussians:
    if kind == "on_a_wall":
        wall = sheet((0, WALL, 1.2), (1.2, 0, 0), (0, 0, 1), srgb=(0.7, 0.68, 0.62), generator=generator, width=0.03)
        stain = sheet((-0.3, WALL - 0.002, 1.25), (0.3, 0, 0), (0, 0, 0.2), srgb=WOOD, generator=generator)
        shelf = sheet((0.1, WALL - 0.06, 1.62), (0.5, 0, 0), (0, 0, 0.04), srgb=DARK, generator=generator)
        return concatenate([wall, stain, shelf])
    parts = [
        sheet((0, 0, TABLE), (0.5, 0, 0), (0, 0.4, 0), srgb=DARK if kind == "two_parts" else WOOD, generator=generator),
        sheet((0, 0, 0), (2.5, 0, 0), (0, 2.5, 0), srgb=(0.45, 0.45, 0.5), generator=generator, width=0.05),
    ]
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        along = (0, 2.5, 0) if x else (2.5, 0, 0)
        place = (2.5 * x, 2.5 * y, 1.25)
        color = (0.35, 0.45, 0.3) if x + y > 0 else (0.7, 0.68, 0.62)
        parts.append(sheet(place, along, (0, 0, 1.25), srgb=color, generator=generator, width=0.06))
    if kind == "crowded":
        parts += [
            cylinder((x, y, TABLE), radius=0.05, height=0.12, srgb=color, generator=generator)
            for x, y, color in ((0.32, 0.1, GREEN), (-0.3, -0.12, CLAY), (0.05, 0.32, DARK))
        ]
    return concatenate(parts)


def sheet(center, u, v, *, srgb, generator: torch.Generator, width: float = 0.02) -> Gaussians:
    """Return a textured parallelogram center +- u +- v."""
    middle, u, v = (torch.tensor(x, dtype=torch.float32) for x in (center, u, v))
    rows, columns = (max(2, math.ceil(2 * float(x.norm()) / width / 1.2)) for x in (u, v))
    a, b = torch.meshgrid(torch.linspace(-1, 1, rows), torch.linspace(-1, 1, columns), indexing="ij")
    points = middle + a.reshape(-1, 1) * u + b.reshape(-1, 1) * v
    normal = torch.nn.functional.normalize(torch.linalg.cross(u, v), dim=0).expand(len(points), 3)
    return _textured(points, normal, srgb, width=width, generator=generator)


def ball(center, *, radius: float, srgb, generator: torch.Generator, count: int = 250) -> Gaussians:
    normals = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    width = 1.6 * radius / math.sqrt(count) * 2
    return _textured(torch.tensor(center) + radius * normals, normals, srgb, width=width / 2, generator=generator)


def cylinder(foot, *, radius: float, height: float, srgb, generator: torch.Generator) -> Gaussians:
    width = 0.012
    around, rows = math.ceil(2 * math.pi * radius / width), math.ceil(height / width)
    turn, level = torch.meshgrid(
        torch.arange(around) / around * 2 * math.pi, (torch.arange(rows) + 0.5) / rows * height, indexing="ij"
    )
    out = torch.stack([turn.cos(), turn.sin(), torch.zeros_like(turn)], -1).reshape(-1, 3)
    side = torch.tensor(foot, dtype=torch.float32) + radius * out + level.reshape(-1, 1) * UP
    x, y = torch.meshgrid(*[torch.arange(-radius, radius, width)] * 2, indexing="ij")
    disc = torch.stack([x, y, torch.zeros_like(x)], -1).reshape(-1, 3)
    disc = disc[disc.norm(dim=1) < radius]
    top = torch.tensor(foot, dtype=torch.float32) + disc + height * UP
    points, normals = torch.cat([side, top]), torch.cat([out, UP.expand(len(top), 3)])
    return _textured(points, normals, srgb, width=0.8 * width, generator=generator)


def _textured(points: Tensor, normals: Tensor, srgb, *, width: float, generator: torch.Generator) -> Gaussians:
    """Return surfels with colours that vary from spot to spot by a tenth, like wood and cloth."""
    shade = 1 + 0.1 * torch.randn(len(points), 1, generator=generator)
    colors = (torch.tensor(srgb) * shade).clamp(0, 1)
    return replace(surfels(points, normals, width=width), sh=dc_from_rgb(colors)[:, None])


def iou(a: Tensor, b: Tensor) -> float:
    """Return the intersection over union of two masks; 1 if both are empty."""
    either = ((a > 0.5) | (b > 0.5)).sum()
    return float(((a > 0.5) & (b > 0.5)).sum() / either) if either else 1.0
