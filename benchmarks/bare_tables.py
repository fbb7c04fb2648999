"""Renders rooms with a bare table: photographs pose its cameras by what stands around it, its plain top has no points.

`benchmarks/geometry.py` measures how right the top of the table is in a reconstruction.
"""

import json
import random
import shutil
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from splatgraft.core.cameras import Cameras
from splatgraft.core.images import LUMINANCE, read_rgb
from splatgraft.formats import read_capture, write_capture
from splatgraft_paper.synthesis import furniture
from splatgraft_paper.synthesis.benchmark import gather_capture, rendered_cameras, sparse_points
from splatgraft_paper.synthesis.furniture import Palette, Parts, box, placed
from splatgraft_paper.synthesis.jobs import Job, RenderSize, Take, render_job
from splatgraft_paper.synthesis.scene import Color, Lamp, Material, Part, Place, Scene, World, capture_cameras

TOP_SIZE, TOP_HEIGHT = (1.2, 0.8), 0.72  # metres; the top lies on z = TOP_HEIGHT, centred at x = y = 0
_TOP_TOLERANCE = 0.01  # metres off the plane; 3 pixels of a camera at 1 m, 18 steps of a float16 depth
_TOP_MARGIN = 0.015  # metres; twice the bevel of the edges
_ROOM, _ROOM_HEIGHT, _WALL = 4.2, 2.6, 0.12  # metres
_SIZE, _VIEWS = RenderSize(352, 248, 8), 36
_LOOKED_AT_HEIGHT = 0.3  # metres; the cameras keep the distance that a vase of this height has
_POINTS = 5000  # structure from motion finds a few thousand points in 36 pictures of this size
_WINDOW_PX, _MIN_GRADIENT = 5, 0.02  # sRGB per pixel; 5 of 255 levels, in the direction that changes least
_WHITE, _WARM = (1.0, 0.97, 0.92), (1.0, 0.85, 0.65)


@dataclass(frozen=True)
class Table:
    """Settings that differ between the rooms."""

    albedo: Color
    """Albedo of the table's top, linear RGB."""
    exposure: float
    """Factor on Blender's radiance, by which the top is neither black nor clipped; set by hand."""
    is_spot: bool = False
    """Whether a spot lamp lights the top in a dark room."""


TABLES = {
    "white": Table((0.8, 0.8, 0.8), exposure=0.24),
    "black": Table((0.02, 0.02, 0.02), exposure=0.4),
    "spot": Table((0.22, 0.22, 0.22), exposure=5.0, is_spot=True),
}


def bare_table(name: str) -> Scene:
    """Describe the room of one table; all rooms are furnished alike."""
    wanted = TABLES[name]
    rng = random.Random("bare table")
    palette = Palette(rng)
    top = Material("plain", wanted.albedo, wanted.albedo, 1.0)
    wide, deep = TOP_SIZE
    table = (
        box((wide, deep, 0.04), (0, 0, TOP_HEIGHT - 0.02), top, 0.006),
        *furniture.legs(wide - 0.06, deep - 0.06, TOP_HEIGHT - 0.04, 0.05, palette.wood()),
    )
    blue, red = (
        Material("checker", (0.05, 0.1, 0.4), (0.7, 0.7, 0.6), scale=1.5),
        replace(palette.rug(), scale=4.0, bump=0),
    )
    things = (
        Part("cylinder", (0.09, 0.09, 0.12), (-0.45, 0.27, TOP_HEIGHT + 0.06), blue),
        box((0.15, 0.1, 0.06), (0.44, -0.28, TOP_HEIGHT + 0.03), red),
    )
    side = _ROOM / 2 - 0.35
    around, footprints = [], []
    standing = (
        (furniture.shelf(rng, palette, 1.0, 1.8), (-0.9, side, 0.0)),
        (furniture.plant(rng, palette, 1.1), (side, side, 0.0)),
        (furniture.cabinet(rng, palette, 1.0, 0.8), (side, -0.8, -np.pi / 2)),
        (furniture.chair(rng, palette), (-side, -0.2, np.pi / 2)),
        (furniture.cabinet(rng, palette, 0.6, 0.5), (-0.7, -side, np.pi)),
    )
    for parts, (x, y, yaw) in standing:
        around += placed(parts, (x, y, 0), yaw)
        footprints.append(((x - 0.35, y - 0.35, 0.0), (x + 0.35, y + 0.35, 1.9)))
    daylight = Lamp("area", _WHITE, 110, (0.9, _ROOM / 2 - 0.15, 1.5), (0, -1, -0.1), 1.2, 1.1)
    lamps = (daylight, Lamp("area", _WARM, 60, (0.2, 0, _ROOM_HEIGHT - 0.1), (0, 0, -1), 0.4, 0.4))
    if wanted.is_spot:
        above = (0.05, -0.03, TOP_HEIGHT + 0.75)
        lamps = (replace(daylight, power=5), Lamp("spot", _WARM, 16, above, (0, 0, -1), 0.02))
    reach = _ROOM / 2 - 0.25
    half = (wide / 2, deep / 2)
    return Scene(
        name="bare_table",
        kind="bare_table",
        parts=(*_shell(rng, palette, pane=0.15 if wanted.is_spot else 3.0), *table, *things, *around),
        lamps=lamps,
        world=World("color"),
        places=(Place((0, 0, TOP_HEIGHT), 0.3, 1.0),),
        bounds=((-reach, -reach, 0.35), (reach, reach, _ROOM_HEIGHT - 0.3)),
        obstacles=(((-half[0], -half[1], 0.0), (half[0], half[1], TOP_HEIGHT + 0.06)), *footprints),
    )


def _shell(rng: random.Random, palette: Palette, *, pane: float) -> Parts:
    """Floor, ceiling, walls with pictures, and a window whose pane emits light."""
    wide, half = _ROOM + 2 * _WALL, (_ROOM + _WALL) / 2
    wall, glow = palette.wall(), Material("plain", _WHITE, _WHITE, 0.3, emission=pane)
    frame = Material("plain", (0.2, 0.13, 0.08), (0.2, 0.13, 0.08), 0.4)
    sizes = (
        ((_WALL, wide), (-half, 0)),
        ((_WALL, wide), (half, 0)),
        ((wide, _WALL), (0, -half)),
        ((wide, _WALL), (0, half)),
    )
    walls = [box((*size, _ROOM_HEIGHT), (*at, _ROOM_HEIGHT / 2), wall, 0) for size, at in sizes]
    y = _ROOM / 2 - 0.01
    window = [box((1.3, 0.02, 1.2), (0.9, y, 1.5), glow, 0)]
    window += [box((0.06, 0.08, 1.3), (0.9 + 0.65 * side, y, 1.5), frame) for side in (-1, 0, 1)]
    window += [box((1.36, 0.08, 0.06), (0.9, y, 1.5 + 0.62 * side), frame) for side in (-1, 1)]
    pictures: list[Part] = []
    for side, along, yaw in ((-1, 0.9, np.pi / 2), (-1, -1.0, np.pi / 2), (1, 0.6, -np.pi / 2), (1, -0.6, -np.pi / 2)):
        pictures += placed(furniture.picture(rng, palette), (side * (_ROOM / 2 - 0.02), along, 1.5), yaw)
    for along in (-0.9, 0.8):
        pictures += placed(furniture.picture(rng, palette), (along, -_ROOM / 2 + 0.02, 1.4), np.pi)
    floor = box((wide, wide, 0.1), (0, 0, -0.05), palette.floor("office"), 0)
    ceiling = box((wide, wide, 0.1), (0, 0, _ROOM_HEIGHT + 0.05), palette.ceiling(), 0)
    return (floor, ceiling, *walls, *window, *pictures)


def render_bare(out: Path, blender_python: Path) -> None:
    """Render what is missing of all tables, each as a capture in OUT/NAME with depth/NNNN.npy."""
    for name, table in TABLES.items():
        scene = bare_table(name)
        job = Job(
            scene=scene,
            objects={},
            cameras=capture_cameras(scene, scene.places[0], _LOOKED_AT_HEIGHT, _VIEWS, seed=0),
            takes=(Take("target", scene=True, passes=("color", "depth")),),
            size=_SIZE,
            provenance={"scene": scene.name, "licence": "own render"},
        )
        rendered, folder = out / "renders" / name, out / name
        rendered.mkdir(parents=True, exist_ok=True)
        # the worker takes an exposure that it finds; its own would make a black top grey and clip a spot of light
        (rendered / "exposure.json").write_text(
            json.dumps({job.takes[0].exposure_group: table.exposure}), encoding="utf-8"
        )
        render_job(job, rendered, blender_python)
        gather_capture(rendered, "target", folder, passes=("images", "depth"), points=False)
        points, colors = _points_with_texture(rendered / "target", rendered_cameras(rendered, _stems()))
        write_capture(folder, replace(read_capture(folder), points=points, point_colors=colors))
        print(f"{folder}: {len(points)} points, {int(is_table_top(points).sum())} on the table's top", flush=True)


def _stems() -> tuple[str, ...]:
    return tuple(f"{i:04d}" for i in range(_VIEWS))


def _points_with_texture(rendered: Path, cameras: Cameras) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    """Points of pixels that structure from motion could match: depth is removed elsewhere, as if there were sky."""
    with tempfile.TemporaryDirectory() as name:
        for stem in _stems():
            picture = rendered / f"{stem}.png"
            shutil.copyfile(picture, Path(name) / picture.name)
            depth = np.load(rendered / f"{stem}_depth.npy", allow_pickle=False)
            np.save(Path(name) / f"{stem}_depth.npy", depth * has_texture(read_rgb(picture)).numpy())
        return sparse_points(Path(name), cameras, count=_POINTS)


def has_texture(picture: Float[Tensor, "h w 3"]) -> Bool[Tensor, "h w"]:
    """Pixels around which brightness changes in every direction, as corner detectors want it (Shi and Tomasi 1994).

    The smaller eigenvalue of the gradients' second moments in a window has to exceed a bound: a straight edge, as that
    of a table or of its shadow, cannot be matched along itself.
    """
    down, right = torch.gradient(picture @ LUMINANCE)
    moments = torch.stack([right * right, right * down, down * down])
    xx, xy, yy = functional.avg_pool2d(moments, _WINDOW_PX, 1, _WINDOW_PX // 2)
    smaller = (xx + yy) / 2 - (((xx - yy) / 2) ** 2 + xy**2).sqrt()
    return smaller > _MIN_GRADIENT**2


def is_table_top(points: Float[Tensor, "*n 3"]) -> Bool[Tensor, "*n"]:
    """Which points lie on the table's top, inside of its bevelled edges."""
    x, y, z = points.unbind(-1)
    inside = (x.abs() < TOP_SIZE[0] / 2 - _TOP_MARGIN) & (y.abs() < TOP_SIZE[1] / 2 - _TOP_MARGIN)
    return inside & ((z - TOP_HEIGHT).abs() < _TOP_TOLERANCE)
