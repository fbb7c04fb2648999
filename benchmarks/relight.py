"""Measure the time of a light transfer of an object of 50,000 Gaussians into targets of 100,000 to 1,000,000.

`python benchmarks/relight.py`. The scene is a synthetic courtyard. Printed are the first transfer, with its estimates
of both lights, and the cost of a later move of the object. `--cpu` counts CPU seconds, for machines with other work.
"""

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numba
import torch

from splatgraft.compositing.composite import Composite, PlacedObject
from splatgraft.core.bounds import bounding_sphere
from splatgraft.core.cameras import look_at, pinhole
from splatgraft.core.directions import even_directions, frames_along
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.rotations import quaternion_from_rotation
from splatgraft.core.similarity import Similarity
from splatgraft.core.spherical_harmonics import dc_from_rgb
from splatgraft.relighting import Light, LightSource, RelightOptions, SourceScene, relight
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.cast_shadows import cast_shadows
from splatgraft.relighting.layers import assemble_layers
from splatgraft.relighting.light.light import fit_ambient
from splatgraft.relighting.prepared_object import capture_object, find_source_light, prepare_object
from splatgraft.relighting.scene_light import SceneLight, find_scene_light

COUNTS, OCCLUDERS, ORIGIN, REPEATS = (100_000, 300_000, 1_000_000), 50_000, 20_000, 3


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


@dataclass(frozen=True)
class Times:
    """Seconds."""

    first: float
    """First transfer of a composite, with the lights of both places estimated."""
    given: float
    """First transfer of a composite, with the new light given."""
    move: float
    """Transfer after a move under a known light, fitted to the views, as a file holds it."""
    draft: float
    """Transfer after a move, not fitted to the views, as the editor shows it during a drag."""


def measure(count: int, *, repeats: int, clock: Callable[[], float] = time.perf_counter) -> Times:
    """Return the best of some runs on a target of `count` Gaussians."""
    scene = courtyard(count)
    around = even_directions(OCCLUDERS)
    ball = surfels(0.4 * around + torch.tensor([0.0, 0.0, 0.45]), around, 0.006, 0.6)
    turns = torch.arange(36) / 36 * 2 * math.pi
    eyes = torch.stack([2 * turns.cos(), 2 * turns.sin(), torch.full((36,), 1.2)], 1)
    cameras = pinhole(look_at(eyes, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0])), 300.0, width=352, height=248)
    sun = LightSource(direction=(0.6, 0.0, 0.8), irradiance=(3.0, 2.8, 2.5), uncertainty_deg=5.0, name="sun")
    light = Light(sources=(sun,), ambient=fit_ambient(torch.tensor([0.5, 0.6, 0.8])))
    origin = SourceScene(courtyard(ORIGIN).with_sh_degree(3), cameras)
    erased = torch.zeros(count, dtype=torch.bool)

    def placed_at(shift: float) -> Composite:
        moved = Similarity(1.0, torch.eye(3), torch.tensor([shift, 0.0, 0.0]))
        return Composite(scene, (PlacedObject(ball, moved),), erased)

    def first_seconds(given: Light | None) -> float:
        start = clock()
        relight(placed_at(0.0), cameras, sources=(origin,), light=given)
        return clock() - start

    composite, options = placed_at(0.0), RelightOptions()
    spheres = [bounding_sphere(composite.objects[0].in_target())]
    there = find_scene_light(CapturedScene(scene, cameras), spheres, light=light, reach=options.reach)
    assert isinstance(there, SceneLight)
    captured = capture_object(ball, origin, cameras, source_light=find_source_light(ball, origin))
    prepared = prepare_object(composite.objects[0], captured, there.light, number=1)

    def move_seconds(shift: float, views: int) -> float:
        start = clock()
        composite = placed_at(shift)
        new_scene = there.moved([bounding_sphere(composite.objects[0].in_target())])
        assert isinstance(new_scene, SceneLight)
        moved = prepared.moved(composite.objects[0], new_scene.light)
        assert moved is not None
        merged, is_object = composite.merged()
        budget = options.budget(merged.count)
        drawn = merged.select(~is_object)
        shadows = cast_shadows(new_scene, [moved], drawn, views=cameras.spread(views), budget=budget)
        assemble_layers(merged, new_scene, [moved], shadows)
        return clock() - start

    first = min(first_seconds(None) for _ in range(repeats))
    given = min(first_seconds(light) for _ in range(repeats))
    move = min(move_seconds(shift, options.fitted_views) for _ in range(repeats) for shift in (0.1, -0.1))
    draft = min(move_seconds(shift, 0) for _ in range(repeats) for shift in (0.12, -0.12))
    return Times(first, given, move, draft)


def main() -> None:
    """Print a row per size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("counts", nargs="*", type=int, default=COUNTS, help="Gaussians of the target")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=REPEATS)
    parser.add_argument("--cpu", action="store_true", help="count CPU seconds of all threads")
    args = parser.parse_args()
    numba.set_num_threads(args.threads)
    torch.set_num_threads(args.threads)
    clock = time.process_time if args.cpu else time.perf_counter
    measure(20_000, repeats=1)  # compiles
    unit = "CPU seconds" if args.cpu else "seconds"
    print(
        f"{OCCLUDERS} Gaussians of the object, {ORIGIN} of its source, {args.threads} threads; {unit}, "
        f"best of {args.repeats}"
    )
    print("| Gaussians of the target | first transfer | new light given | after a move | draft after a move |")
    print("| --- | --- | --- | --- | --- |")
    for count in args.counts:
        found = measure(count, repeats=args.repeats, clock=clock)
        print(f"| {count} | {found.first:.2f} | {found.given:.2f} | {found.move:.2f} | {found.draft:.2f} |", flush=True)


if __name__ == "__main__":
    main()
