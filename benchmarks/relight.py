"""Time of a light transfer at the size of a real capture: 300k Gaussians that may receive, 50k that cast.

`python benchmarks/relight.py`. A synthetic courtyard; prints the whole transfer, then one after a move of the object.
The light is given: to estimate it is timed beside it.
"""

import math
import time

import numba
import torch

from splatgraft.core.bounds import bounding_sphere
from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.composite import Composite, PlacedObject
from splatgraft.core.directions import even_directions, frames_along
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.rotations import quaternion_from_rotation
from splatgraft.core.similarity import Similarity
from splatgraft.core.spherical_harmonics import dc_from_rgb
from splatgraft.relighting import Light, LightSource, SourceScene, relight
from splatgraft.relighting.light.estimate import estimate_light
from splatgraft.relighting.light.light import fit_ambient
from splatgraft.runtime.memo import Memo

RECEIVERS, OCCLUDERS, ORIGIN = 300_000, 50_000, 20_000


def surfels(points: torch.Tensor, normals: torch.Tensor, width: float, gray: float) -> Gaussians:
    n = len(points)
    rotations = frames_along(-normals).transpose(1, 2)
    log_scales = torch.tensor([width, width, 0.1 * width]).log().repeat(n, 1)
    sh = dc_from_rgb(torch.full((n, 1, 3), gray))
    return Gaussians(points, log_scales, quaternion_from_rotation(rotations), torch.full((n,), 2.0), sh)


def courtyard(count: int) -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    floor = (torch.rand(count, 2, generator=generator) - 0.5) * 6
    points = torch.cat([floor, 0.02 * torch.sin(3 * floor[:, :1])], 1)
    return surfels(points, torch.tensor([[0.0, 0.0, 1.0]]).repeat(count, 1), 0.02 * (300_000 / count) ** 0.5, 0.5)


def main() -> None:
    numba.set_num_threads(2)
    torch.set_num_threads(2)
    scene = courtyard(RECEIVERS)
    around = even_directions(OCCLUDERS)
    ball = surfels(0.4 * around + torch.tensor([0.0, 0.0, 0.45]), around, 0.006, 0.6)
    turns = torch.arange(36) / 36 * 2 * math.pi
    eyes = torch.stack([2 * turns.cos(), 2 * turns.sin(), torch.full((36,), 1.2)], 1)
    cameras = pinhole(look_at(eyes, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0])), 300.0, width=352, height=248)
    sun = LightSource(direction=(0.6, 0.0, 0.8), irradiance=(3.0, 2.8, 2.5), uncertainty_deg=5.0, name="sun")
    light = Light(sources=(sun,), ambient=fit_ambient(torch.tensor([0.5, 0.6, 0.8])))
    origin = SourceScene(courtyard(ORIGIN).with_sh_degree(3), cameras)

    def transfer(shift: float, cache: Memo) -> tuple[float, float]:
        moved = Similarity(1.0, torch.eye(3), torch.tensor([shift, 0.0, 0.0]))
        composite = Composite(scene, (PlacedObject(ball, moved),), erased)
        wall, cpu = time.perf_counter(), time.process_time()
        relight(composite, cameras, sources=(origin,), light=light, cache=cache)
        return time.perf_counter() - wall, time.process_time() - cpu

    erased = torch.zeros(RECEIVERS, dtype=torch.bool)
    transfer(0.0, Memo())
    whole, moves = [], []
    for _ in range(3):
        cache = Memo()
        whole.append(transfer(0.0, cache))
        moves += [transfer(0.1, cache), transfer(-0.1, cache)]
    start = time.perf_counter()
    estimate_light(scene, bounding_sphere(ball), cameras)
    estimated = time.perf_counter() - start
    print(f"{RECEIVERS} receivers, {OCCLUDERS} occluders, 2 threads; light estimated in {estimated:.2f} s")
    print(f"CPU seconds: whole {min(c for _, c in whole):.2f}, after a move {min(c for _, c in moves):.2f}")
    print(f"seconds={min(w for w, _ in whole):.2f} move_seconds={min(w for w, _ in moves):.2f}")


if __name__ == "__main__":
    main()
