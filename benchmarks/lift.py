"""Compare the closed form of lifting masks with 10K iterations of binary cross-entropy, on held-out views.

Every 8th view of the capture is held out of reconstruction and lifting. Both features select the object at the same
threshold. The pixels of the object in a held-out view are those with an object weight above one half. They are compared
with the true mask.
"""

import time
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from jaxtyping import Bool
from torch import Tensor

from splatgraft.core.gaussians import Gaussians
from splatgraft.core.posed_images import PosedImages, held_out
from splatgraft.formats import read_capture, read_gaussians, write_gaussians
from splatgraft.reconstruction import ReconstructOptions, reconstruct
from splatgraft.rendering import RenderOptions, view_operator
from splatgraft.segmentation import LiftOptions, SelectOptions, lift_masks, select_object

REPOSITORY = Path(__file__).parents[1]


@dataclass(frozen=True)
class Lift:
    """Compare both ways of lifting masks."""

    capture: Path = REPOSITORY / "data" / "vase"
    """A capture with true masks."""
    iterations: int = 10_000
    """Number of iterations of the cross-entropy training."""
    cache: Path = REPOSITORY / "build" / "benchmarks"
    """Folder that keeps the reconstructed scene between runs."""
    reconstruct_iterations: int = 2000
    """Number of iterations of the reconstruction."""


def main(options: Lift) -> None:
    capture = read_capture(options.capture)
    if not capture.mask_paths or any(path is None for path in capture.mask_paths):
        raise SystemExit(f"{options.capture}: expected a mask for every image, found some without")
    testing = held_out(len(capture))
    training, tests = capture.select(~testing), capture.select(testing)
    scene = scene_of(training, options)
    print(f"{scene.count} Gaussians; {len(training)} views to lift from, {len(tests)} held out")

    lift(scene, training.select(torch.arange(len(training)) == 0), LiftOptions())  # compiles
    _, closed_s, closed_cpu_s = timed(scene, capture, LiftOptions())
    print(f"closed form, all {len(capture)} masks: {closed_s:.2f} s ({closed_cpu_s:.2f} CPU-s)")
    closed = lift(scene, training, LiftOptions())
    lift(scene, training, LiftOptions(method="bce", iterations=2))  # compiles
    bce, bce_s, bce_cpu_s = timed(scene, training, LiftOptions(method="bce", iterations=options.iterations))
    print(f"cross-entropy, {options.iterations} iterations: {bce_s:.2f} s ({bce_cpu_s:.2f} CPU-s)")

    for keep in ("all", "largest", "substantial"):
        objects = [select_object(scene, feature, SelectOptions(keep=keep)) for feature in (closed, bce)]
        scores = [mean_iou(scene, chosen, tests) for chosen in objects]
        print(f"pieces kept: {keep}; chosen {[int(o.sum()) for o in objects]}, held-out IoU {scores}")
    print(f"closed_form_s={closed_s:.2f} bce_s={bce_s:.2f} iou_closed={scores[0]:.4f} iou_bce={scores[1]:.4f}")


def scene_of(training: PosedImages, options: Lift) -> Gaussians:
    path = options.cache / f"{options.capture.name}_{options.reconstruct_iterations}.ply"
    if path.is_file():
        return read_gaussians(path)
    options.cache.mkdir(parents=True, exist_ok=True)
    print(f"reconstructing {options.capture} (kept in {path})")
    scene = reconstruct(training, ReconstructOptions(iterations=options.reconstruct_iterations), progress=tenth)
    write_gaussians(path, scene)
    return scene


def tenth(done: int, total: int, message: str) -> None:
    if done % max(total // 10, 1) == 0:
        print(f"  {done}/{total} {message}", flush=True)


def masks_of(capture: PosedImages) -> list[Tensor]:
    found = [capture.mask(index) for index in range(len(capture))]
    return [mask for mask in found if mask is not None]


def lift(scene: Gaussians, capture: PosedImages, options: LiftOptions) -> Tensor:
    return lift_masks(scene, capture.cameras, masks_of(capture), options)


def timed(scene: Gaussians, capture: PosedImages, options: LiftOptions) -> tuple[Tensor, float, float]:
    masks = masks_of(capture)
    wall, cpu = time.perf_counter(), time.process_time()
    feature = lift_masks(scene, capture.cameras, masks, options)
    return feature, time.perf_counter() - wall, time.process_time() - cpu


def mean_iou(scene: Gaussians, chosen: Bool[Tensor, " n"], tests: PosedImages) -> float:
    scores = []
    for camera, mask in zip(tests.cameras, masks_of(tests), strict=True):
        shown = view_operator(scene, camera, RenderOptions()).blend(chosen.float()[:, None])[..., 0] > 0.5
        scores.append(float((shown & (mask > 0.5)).sum() / (shown | (mask > 0.5)).sum()))
    return sum(scores) / len(scores)


if __name__ == "__main__":
    torch.set_num_threads(2)
    main(tyro.cli(Lift))
