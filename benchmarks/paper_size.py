"""Measure the paper's work after reconstruction at a given size: lift, relight, render, consolidate.

`python benchmarks/paper_size.py --views 200 --size 704x496 --gaussians 300000` is the paper's size. Its Table 4 and the
costs under it: 40 s for features, 3 to 15.5 minutes for consolidating on an H100. The scene is synthetic with a fixed
seed: a courtyard with a ball on it, which has a sixth of the Gaussians. The same command uses CUDA if there is a card.
One line per part, and a last line of JSON:

    part=lift seconds=.. cpu_seconds=.. peak_mb=..

Masks are the ball's own coverage. The consolidated images are the relit renders with a smooth error of brightness and
colour for each view, like an image model's. relight splits the Gaussians that the edge of the shadow crosses. render
and consolidate therefore work on the `gaussians_relit` of the last line. At toy sizes the floor has few wide Gaussians,
so this number is many times the given one.
"""

import argparse
import json
import math
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import TypeVar

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # as cli.py does; read when torch and numba load

import torch
from relight import courtyard, surfels
from torch import Tensor

from splatgraft.compositing.composite import Composite, PlacedObject
from splatgraft.consolidation import ConsolidateOptions, consolidate
from splatgraft.core.cameras import Cameras, look_at, pinhole
from splatgraft.core.directions import even_directions
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.image_metrics import psnr
from splatgraft.core.similarity import Similarity
from splatgraft.relighting import Light, LightSource, SourceScene, relight
from splatgraft.relighting.light.light import fit_ambient
from splatgraft.rendering import render, view_operator
from splatgraft.runtime.lazy_sequence import LazySequence
from splatgraft.runtime.process import peak_memory_bytes, reset_peak_memory
from splatgraft.segmentation import LiftOptions, lift_masks

T = TypeVar("T")


@dataclass(frozen=True)
class Size:
    """Size of the work."""

    views: int = 24
    width: int = 352
    height: int = 248
    gaussians: int = 30_000
    device: str = "cpu"
    passes: int = 12
    """Number of passes of `consolidate`'s descent over all views."""


@dataclass(frozen=True)
class Part:
    """Cost of one part."""

    part: str
    seconds: float
    """Wall time."""
    cpu_seconds: float
    peak_mb: float
    """Peak resident memory, or the card's if there is one."""


def scene_of(size: Size) -> tuple[Composite, Cameras, Light]:
    """Return the composite, its cameras and the light at the object's place; deterministic in the size."""
    count = size.gaussians // 6
    around = even_directions(count)
    # as wide as their distance on the ball, so that the ball is closed at every number
    width = 0.4 * math.sqrt(4 * math.pi / count)
    ball = surfels(0.4 * around + torch.tensor([0.0, 0.0, 0.4]), around, width, 0.6).with_sh_degree(3)
    floor = courtyard(size.gaussians - count).with_sh_degree(3)
    turns = torch.arange(size.views) / size.views * 2 * math.pi
    eyes = torch.stack([2 * turns.cos(), 2 * turns.sin(), 1.2 + 0.4 * (3 * turns).sin()], 1)
    poses = look_at(eyes, torch.tensor([0.0, 0.0, 0.2]), torch.tensor([0.0, 0.0, 1.0]))
    cameras = pinhole(poses, 0.85 * size.width, width=size.width, height=size.height)
    sun = LightSource(direction=(0.6, 0.0, 0.8), irradiance=(3.0, 2.8, 2.5), uncertainty_deg=5.0, name="sun")
    light = Light(sources=(sun,), ambient=fit_ambient(torch.tensor([0.5, 0.6, 0.8])))
    placed = PlacedObject(ball, Similarity.identity())
    return Composite(floor, (placed,), torch.zeros(floor.count, dtype=torch.bool)), cameras, light


def spoilt(image: Tensor, view: int) -> Tensor:
    """Return the image with a gradient of brightness and a tint of its own, like an image model's single views."""
    generator = torch.Generator().manual_seed(view)
    gain = 1 + 0.1 * torch.randn(3, generator=generator) + 0.1 * torch.linspace(-1, 1, image.shape[1])[:, None]
    return (image * gain.to(image)).clamp(0, 1)


def measure(size: Size, say: Callable[[str], None] = print) -> dict[str, object]:
    """Run all parts and return the fields of the last line."""
    device = torch.device(size.device)
    composite, cameras, light = scene_of(size)
    parts: list[Part] = []

    def timed(name: str, work: Callable[[], T]) -> T:
        reset_peak_memory()
        if device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(device)
        wall, cpu = time.perf_counter(), time.process_time()
        found = work()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        peak = torch.cuda.max_memory_allocated(device) if device.type == "cuda" else peak_memory_bytes()
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        parts.append(Part(name, round(wall, 3), round(cpu, 3), round(peak / 2**20, 1)))
        say(f"part={name} seconds={wall:.2f} cpu_seconds={cpu:.2f} peak_mb={peak / 2**20:.0f}")
        return found

    _compile(device)
    merged, is_object = composite.merged()
    merged, seen_by = merged.to(device), cameras.to(device)
    masks = [_coverage(merged, is_object.to(device), camera) for camera in seen_by]
    feature = timed("lift", lambda: lift_masks(merged, seen_by, masks, LiftOptions()))
    wrong = int(((feature.cpu() > 0.75) != is_object)[feature.cpu() > 0].sum())
    source = SourceScene(courtyard(max(size.gaussians // 10, 500)).with_sh_degree(3), cameras)
    relit = timed("relight", lambda: relight(composite, cameras, sources=[source], light=light).bake()[0])
    scene = relit.to(device)
    images = timed("render", lambda: [_picture(scene, camera).cpu() for camera in seen_by])
    harmonized = LazySequence(len(images), lambda index: spoilt(images[index], index).to(device))
    options = replace(ConsolidateOptions(), polish_passes=size.passes)
    since = time.process_time()

    def progress(done: int, total: int, text: str) -> None:
        if done < 10 or done % 200 == 0:
            say(f"consolidate {done}/{total} cpu_seconds={time.process_time() - since:.0f} {text}")

    result = timed("consolidate", lambda: consolidate(scene, seen_by, harmonized, options, progress=progress))
    before = float(psnr(spoilt(images[0], 0), images[0]))
    after = float(psnr(_picture(result, seen_by[0]).cpu(), images[0]))
    return {
        **asdict(size),
        "card": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
        "parts": [asdict(part) for part in parts],
        "gaussians_relit": scene.count,
        "lifted_wrong": wrong,
        "psnr_of_a_spoilt_view": round(before, 2),
        "psnr_consolidated": round(after, 2),
    }


def _compile(device: torch.device) -> None:
    """Run everything once on a few Gaussians, so that compilation is not measured."""
    composite, cameras, light = scene_of(Size(views=10, width=48, height=32, gaussians=600))
    merged, is_object = composite.merged()
    merged, seen_by = merged.to(device), cameras.to(device)
    masks = [_coverage(merged, is_object.to(device), camera) for camera in seen_by]
    lift_masks(merged, seen_by, masks, LiftOptions())
    relight(composite, cameras, sources=[None], light=light)
    images = [_picture(merged, camera) for camera in seen_by]
    consolidate(merged, seen_by, [0.9 * image for image in images], ConsolidateOptions(polish_passes=1))


def _coverage(scene: Gaussians, is_object: Tensor, camera: Cameras) -> Tensor:
    return (view_operator(scene, camera).blend(is_object.float()[:, None])[..., 0] > 0.5).float()


@torch.no_grad()
def _picture(scene: Gaussians, camera: Cameras) -> Tensor:
    return render(scene, camera).color[0].clamp(0, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=Size.views)
    parser.add_argument("--size", default="352x248", help="pixels")
    parser.add_argument("--gaussians", type=int, default=Size.gaussians)
    parser.add_argument("--passes", type=int, default=Size.passes)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    args = parser.parse_args()
    width, height = map(int, args.size.split("x"))
    size = Size(args.views, width, height, args.gaussians, args.device, args.passes)
    print(json.dumps(measure(size)))


if __name__ == "__main__":
    main()
