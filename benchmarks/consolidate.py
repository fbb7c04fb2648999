"""Compare the `fast` method of consolidation with 10K iterations of Adam: `python benchmarks/consolidate.py [CAPTURE]`.

1. A scene is reconstructed from the capture (kept in build/). Every 8th view is held out of all steps.
2. Its colours are changed like those of a naive composite. Both methods fit them to the photographs again, with the
   same loss.
3. Losses are compared on photographs that disagree like independently harmonised views.

The last line reads speedup=.. error_ratio=.. peak_mb=... error_ratio is the larger of the ratios of held-out loss and
held-out RMSE.
"""

import argparse
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from splatgraft.consolidation import ConsolidateOptions, consolidate
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.image_metrics import psnr
from splatgraft.core.posed_images import PosedImages, held_out
from splatgraft.core.spherical_harmonics import dc_from_rgb, rgb_from_dc
from splatgraft.fitting import l1_dssim
from splatgraft.fitting.perceptual_losses import ImageLoss, l1, lpips_vgg, windowed_fourier
from splatgraft.formats import read_capture, read_gaussians, write_gaussians
from splatgraft.reconstruction import ReconstructOptions, reconstruct
from splatgraft.rendering import render
from splatgraft.runtime.process import peak_memory_bytes, reset_peak_memory
from splatgraft_paper.consolidation import PaperDescent, descend_as_paper

ROOT = Path(__file__).parents[1]
LOSSES: dict[str, ImageLoss] = {"fourier": windowed_fourier, "l1-dssim": l1_dssim, "l1": l1}


@dataclass(frozen=True)
class Problem:
    """A composite with wrong colours, its fitted views, and held-out views."""

    composite: Gaussians
    cameras: Cameras
    images: list[Tensor]
    test_cameras: Cameras
    test_images: list[Tensor]

    def pictures(self, scene: Gaussians) -> list[Tensor]:
        """Return renders from the held-out cameras."""
        with torch.no_grad():
            return [render(scene, camera).color[0].clamp(0, 1) for camera in self.test_cameras]

    def errors(self, scene: Gaussians, loss: ImageLoss) -> tuple[float, float, float, float]:
        """Return held-out mean loss, RMSE over all pixels, mean PSNR, and gradient energy over the photographs'."""
        pairs = list(zip(self.pictures(scene), self.test_images, strict=True))
        squares = sum(float(((a - b) ** 2).mean()) for a, b in pairs) / len(pairs)
        energy = sum(gradient_energy(a) for a, _ in pairs) / sum(gradient_energy(b) for _, b in pairs)
        mean_loss = sum(float(loss(a, b)) for a, b in pairs) / len(pairs)
        return mean_loss, squares**0.5, sum(float(psnr(a, b)) for a, b in pairs) / len(pairs), energy


def gradient_energy(image: Tensor) -> float:
    return sum(float(d.abs().mean()) for d in torch.gradient(image, dim=(0, 1)))


def scene_of(capture: PosedImages, cache: Path, iterations: int) -> Gaussians:
    if not cache.is_file():
        cache.parent.mkdir(parents=True, exist_ok=True)
        options = ReconstructOptions(iterations=iterations, budget=25_000, resolution=1.0, eval_every=8)
        print(f"reconstructing {cache} in {iterations} iterations", flush=True)
        write_gaussians(cache, reconstruct(capture, options))
    return read_gaussians(cache)


def spoilt(scene: Gaussians, seed: int = 0) -> Gaussians:
    """Return colours under another light: a smooth gain over space of about 25%, and noise."""
    generator = torch.Generator().manual_seed(seed)
    extent = scene.means.std(0).mean()
    waves = (scene.means / extent) @ torch.randn(3, 3, generator=generator)
    sh = scene.sh.clone()
    sh[:, 0] = dc_from_rgb(rgb_from_dc(sh[:, 0]) * torch.exp(0.25 * waves.sin()))
    sh[:, 0] += 0.3 * torch.randn(sh[:, 0].shape, generator=generator)
    return replace(scene, sh=sh)


def disagreeing(images: list[Tensor], warp_px: float, cell_px: float, seed: int = 0) -> list[Tensor]:
    """Return each image with its own warp, gain (8%), tint (4%) and blur (up to 0.6 px)."""
    return [_spoil_view(image, warp_px, cell_px, seed * 1000 + index) for index, image in enumerate(images)]


def _spoil_view(image: Tensor, warp_px: float, cell_px: float, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    h, w = image.shape[:2]

    def smooth(channels: int, cell: float) -> Tensor:
        knots = torch.randn(1, channels, max(2, round(h / cell)), max(2, round(w / cell)), generator=generator)
        return F.interpolate(knots, (h, w), mode="bicubic", align_corners=True)[0].permute(1, 2, 0)

    flow, shade = warp_px * smooth(2, cell_px), 0.08 * smooth(1, 100.0) + 0.04 * smooth(3, 100.0)
    x, y = torch.arange(w) + 0.5 + flow[..., 0], torch.arange(h)[:, None] + 0.5 + flow[..., 1]
    grid = torch.stack([2 * x / w - 1, 2 * y / h - 1], -1)[None]
    planes = image.permute(2, 0, 1)[None]
    planes = F.grid_sample(planes, grid, mode="bicubic", padding_mode="border", align_corners=False)
    sigma = 0.6 * float(torch.rand((), generator=generator)) + 1e-3
    taps = torch.exp(-(torch.arange(-2.0, 3.0) ** 2) / (2 * sigma**2))
    taps = (taps / taps.sum()).repeat(3, 1)
    planes = F.conv2d(F.pad(planes, (2, 2, 2, 2), mode="replicate"), taps[:, None, None, :], groups=3)
    planes = F.conv2d(planes, taps[:, None, :, None], groups=3)
    return (planes[0].permute(1, 2, 0) * shade.exp()).clamp(0, 1)


def problem_of(capture: PosedImages, scene: Gaussians) -> Problem:
    is_held_out = held_out(len(capture))
    fitted, test_views = capture.select(~is_held_out), capture.select(is_held_out)
    return Problem(
        composite=spoilt(scene),
        cameras=fitted.cameras,
        images=[fitted.image(i) for i in range(len(fitted))],
        test_cameras=test_views.cameras,
        test_images=[test_views.image(i) for i in range(len(test_views))],
    )


def compare_methods(problem: Problem, loss: ImageLoss, iterations: int) -> str:
    """Compare both methods on photographs that agree."""
    options = ConsolidateOptions(loss=loss, view_error=False)
    consolidate(problem.composite, problem.cameras[:2], problem.images[:2], options)  # compiles the kernels
    runs = {
        "fast": partial(consolidate, options=options),
        "fast with tint and flow per view (the default)": partial(consolidate, options=ConsolidateOptions(loss=loss)),
        "paper": partial(descend_as_paper, settings=PaperDescent(loss, iterations)),
    }
    results = {}
    for name, run in runs.items():
        reset_peak_memory()
        wall, cpu = time.perf_counter(), time.process_time()
        scene = run(problem.composite, problem.cameras, problem.images)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        error = problem.errors(scene, loss)
        results[name] = (wall, cpu, peak_memory_bytes() / 2**20, *error)
        print(
            f"{name}: {wall:.1f} s, {cpu:.1f} CPU-s, peak {results[name][2]:.0f} MiB; held out: "
            f"loss {error[0]:.5f}, rmse {error[1]:.5f}, {error[2]:.2f} dB, sharpness {error[3]:.3f}",
            flush=True,
        )
    fast, paper = results["fast"], results["paper"]
    # `fast` without tint and flow, so that both methods minimise the same loss; CPU time, because other load during
    # one of the runs would distort wall times
    ratio = max(fast[3] / paper[3], fast[4] / paper[4])
    return f"speedup={paper[1] / fast[1]:.1f} error_ratio={ratio:.3f} peak_mb={fast[2]:.0f}"


def compare_losses(problem: Problem, passes: int) -> None:
    """Compare losses on views that disagree, measured on held-out photographs that agree."""
    losses = dict(LOSSES)
    try:
        losses["lpips"] = lpips_vgg()
    except ValueError as error:
        print(f"without LPIPS: {error}")
    settings = {"A: 0.8 px": (0.8, 44.0), "B: 1.5 px": (1.5, 44.0), "C: fine jitter": (0.8, 8.0)}
    rows = [("equations alone", ConsolidateOptions(polish_passes=0, view_error=False))]
    rows += [
        (name, ConsolidateOptions(loss=loss, view_error=False, polish_passes=passes)) for name, loss in losses.items()
    ]
    rows += [("per-view tint and flow, equations alone", ConsolidateOptions(polish_passes=0))]
    rows += [
        (f"per-view tint and flow, {name}", ConsolidateOptions(loss=loss, polish_passes=passes))
        for name, loss in losses.items()
    ]
    rows += [("default", ConsolidateOptions())]
    print("| fitted with | " + " | ".join(settings) + " | (PSNR dB / sharpness, held out, clean)")
    images = {name: disagreeing(problem.images, *setting) for name, setting in settings.items()}
    single = (
        f"{sum(float(psnr(a, b)) for a, b in zip(spoilt_ones, problem.images, strict=True)) / len(spoilt_ones):.2f}"
        for spoilt_ones in images.values()
    )
    print("| the views themselves | " + " | ".join(single) + " |", flush=True)
    for name, options in rows:
        cells = []
        for spoilt_ones in images.values():
            scene = consolidate(problem.composite, problem.cameras, spoilt_ones, options)
            _, _, decibel, energy = problem.errors(scene, l1)
            cells.append(f"{decibel:.2f} / {energy:.3f}")
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capture", nargs="?", type=Path, default=ROOT / "data" / "room")
    parser.add_argument("--iterations", type=int, default=10_000, help="of Adam")
    parser.add_argument("--loss", choices=sorted(LOSSES), default="fourier")
    parser.add_argument("--scene-iterations", type=int, default=2000, help="of the reconstruction to work on")
    parser.add_argument("--resolution", type=float, default=1.0)
    parser.add_argument("--losses", choices=["compare", "skip"], default="compare")
    parser.add_argument("--passes", type=int, default=12, help="of each loss over the views that disagree")
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    capture = read_capture(args.capture).resized(args.resolution)
    cache = ROOT / "build" / "consolidate" / f"{args.capture.resolve().name}_{capture.cameras.width}.ply"
    problem = problem_of(capture, scene_of(capture, cache, args.scene_iterations))
    start = problem.errors(problem.composite, LOSSES[args.loss])
    print(
        f"{len(problem.cameras)} views of {capture.cameras.width}x{capture.cameras.height}, "
        f"{problem.composite.count} Gaussians; composite, held out: {start[2]:.2f} dB"
    )
    if args.losses == "compare":
        compare_losses(problem, args.passes)
    print(compare_methods(problem, LOSSES[args.loss], args.iterations))


if __name__ == "__main__":
    main()
