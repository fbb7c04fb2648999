"""Measure quality, time and memory of reconstructions: `python benchmarks/captures.py FOLDER [--quality draft ..]`.

Every capture in FOLDER is reconstructed in a process of its own, with every 8th view held out. Captures without poses
(a folder of photos) are first posed by `splatgraft capture`. `--device cuda` uses a card. One line each:

    capture=NAME quality=standard device=cpu views=9 longest_px=960 psnr=.. psnr_fit=.. ssim=.. flip=.. seconds=.. ..

psnr, ssim and flip compare with the photographed views. psnr_fit first maps the colours of each render to its photo by
a least-squares affine map, which removes exposure and white balance. CPU seconds count all threads of the
reconstruction; neither time includes structure from motion.

`--object` cuts the object by the masks of the fitted photos (the capture's own, or `--masks FOLDER` by their names) and
fits it alone as `segment` does. Two more lines compare it inside the held-out masks, before (`cut`) and after. Their
seconds are those of cutting and fitting alone.

Every quality fits photos of its own size, and is compared at that size. `--longest-px` gives other sizes, one line for
each. Small pictures are easier to match, so figures of two qualities can be compared at one size only.
"""

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # as cli.py does; read when torch and numba load

import torch

from splatgraft.core.flip import flip
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.image_metrics import fit_color, psnr, ssim
from splatgraft.core.images import list_images
from splatgraft.core.posed_images import PosedImages, held_out
from splatgraft.folders.capture_files import has_poses, read_view_gains
from splatgraft.folders.object_masks import with_mask_folder
from splatgraft.formats import read_capture
from splatgraft.reconstruction import ReconstructOptions, reconstruct
from splatgraft.rendering import RenderOptions, render
from splatgraft.runtime.process import peak_memory_bytes, reset_peak_memory
from splatgraft.segmentation import SolidifyOptions, segment
from splatgraft.steps.segment import SOLID_SIDE_PX

EVERY = 8
FEWEST_PHOTOS = 3


def find_captures(folder: Path) -> list[Path]:
    """Return folders with poses and folders of photos, at or below `folder` but not below another capture."""
    if has_poses(folder) or len(list_images(folder)) >= FEWEST_PHOTOS:
        return [folder]
    below = sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
    return [capture for path in below for capture in find_captures(path)]


def name_of(capture: Path) -> str:
    """Return the folder's name, or its parent's if the name only means images."""
    return capture.resolve().parent.name if capture.name in {"images", "photos"} else capture.resolve().name


def posed(capture: Path, work: Path) -> Path:
    """Return `capture` if it has poses, else the result of `splatgraft capture` in `work`, which is kept."""
    if has_poses(capture):
        return capture
    out = work / name_of(capture)
    if not has_poses(out):
        work.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, "-m", "splatgraft", "capture", str(capture), "--out", str(out)]
        subprocess.run(command, check=True, stdout=sys.stderr)
    return out


def measure(name: str, args: argparse.Namespace) -> None:
    """Reconstruct and print a line for each size, by default the size of the fitted photos."""
    capture, line = read_capture(args.folder), f"capture={name} quality={args.quality[0]} device={args.device}"
    options = ReconstructOptions(quality=args.quality[0], eval_every=EVERY, device=args.device)
    reset_peak_memory()
    begin, begin_cpu = time.perf_counter(), time.process_time()
    scene = reconstruct(capture, options).to("cpu")
    cost = f"{cost_since(begin, begin_cpu, scene)} peak_mb={peak_memory_bytes() / 2**20:.0f}"
    sizes = [capture.limited(size) for size in args.longest_px] or [options.served(capture)]
    for photos in (size.select(held_out(len(size), EVERY)) for size in sizes):
        print(f"{line} {compare(scene, photos)} {cost}", flush=True)
    if not args.object:
        return
    photos = with_mask_folder(capture, args.masks, args.folder).limited(SOLID_SIDE_PX)
    not_fitted = set(capture.select(held_out(len(capture), EVERY)).cameras.names)
    testing = torch.tensor([name in not_fitted for name in photos.cameras.names])
    training = photos.select(~testing)
    fitted = SolidifyOptions(view_gains=read_view_gains(training.image_paths))
    for what, solidify in (("cut", None), ("object", fitted)):
        begin, begin_cpu = time.perf_counter(), time.process_time()
        found = segment(scene, training, solidify=solidify).object
        cost = cost_since(begin, begin_cpu, found)
        print(f"{line} {what} {compare_object(found, photos.select(testing))} {cost}", flush=True)


def cost_since(begin: float, begin_cpu: float, made: Gaussians) -> str:
    """Return the part of the line with time and memory."""
    seconds, cpu = time.perf_counter() - begin, time.process_time() - begin_cpu
    return f"seconds={seconds:.0f} cpu_seconds={cpu:.0f} gaussians={made.count}"


def compare(scene: Gaussians, photos: PosedImages) -> str:
    """Return the part of the line with the errors of renders against the photos."""
    rows: list[tuple[float, ...]] = []
    for i in range(len(photos)):
        truth = photos.image(i)
        picture = render(scene, photos.cameras[i]).color[0].clamp(0, 1)
        fitted = fit_color(picture, truth)
        found = (psnr(picture, truth), psnr(fitted, truth), ssim(picture, truth), flip(picture, truth))
        rows.append(tuple(float(value) for value in found))
    decibel, of_fitted, similarity, visible = (sum(column) / len(rows) for column in zip(*rows, strict=True))
    return (
        f"views={len(rows)} longest_px={int(photos.cameras.sizes.max())} psnr={decibel:.2f} psnr_fit={of_fitted:.2f} "
        f"ssim={similarity:.3f} flip={visible:.4f}"
    )


_BACKGROUNDS = {"grey": (0.5, 0.5, 0.5), "black": (0.0, 0.0, 0.0), "magenta": (1.0, 0.0, 1.0)}
"""Background colours, sRGB. They show the transparent parts of an object."""


def compare_object(found: Gaussians, photos: PosedImages) -> str:
    """Return the part of the line with the object's errors inside its masks, by background."""
    rows: list[tuple[float, ...]] = []
    for i in range(len(photos)):
        mask = photos.mask(i)
        if mask is None or not bool((mask > 0.5).any()):
            continue
        truth = photos.image(i)[mask > 0.5][None]
        drawn = [render(found, photos.cameras[i], options=RenderOptions(background=b)) for b in _BACKGROUNDS.values()]
        pictures = [one.color[0].clamp(0, 1)[mask > 0.5][None] for one in drawn]
        alpha = drawn[0].alpha[0]
        overlap = torch.minimum(alpha, mask).sum() / torch.maximum(alpha, mask).sum()
        fitted = [psnr(fit_color(picture, truth), truth) for picture in pictures]
        rows.append(tuple(float(value) for value in (psnr(pictures[0], truth), *fitted, overlap)))
    decibel, *of_fitted, overlap = (sum(column) / len(rows) for column in zip(*rows, strict=True))
    over = " ".join(f"psnr_over_{name}={x:.2f}" for name, x in list(zip(_BACKGROUNDS, of_fitted, strict=True))[1:])
    return f"views={len(rows)} psnr={decibel:.2f} psnr_fit={of_fitted[0]:.2f} {over} overlap={overlap:.3f}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--quality", nargs="+", default=["draft", "standard"])
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--longest-px", nargs="*", type=int, default=[], help="compare at these sizes")
    parser.add_argument("--object", action="store_true", help="compare the object, cut by its masks, as well")
    parser.add_argument("--masks", type=Path, help="masks of the object, where the capture has none")
    parser.add_argument("--work", type=Path, default=Path("captures"), help="where posed captures are kept")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        measure(args.one, args)
        return 0
    failed = 0
    for capture in find_captures(args.folder):
        try:
            folder = posed(capture, args.work)
        except subprocess.CalledProcessError:
            print(f"capture={name_of(capture)} failed: no poses", flush=True)
            failed += 1
            continue
        for quality in args.quality:
            words = ["--quality", quality, "--device", args.device, "--one", name_of(capture)]
            words += ["--longest-px", *map(str, args.longest_px), *(["--object"] if args.object else [])]
            words += ["--masks", str(args.masks)] if args.masks else []
            command = [sys.executable, __file__, str(folder), *words]
            failed += subprocess.run(command, check=False).returncode != 0
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
