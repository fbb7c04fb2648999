"""Held-out quality, time and memory of reconstructions: `python benchmarks/captures.py FOLDER [--quality draft ..]`.

`--device cuda` runs them on a card. Every capture in FOLDER (with poses: transforms.json or COLMAP; without: a folder
of photos, posed first by `splatgraft capture`) is reconstructed in a process of its own with every 8th view held out.
One line each:

    capture=NAME quality=standard device=cpu views=9 longest_px=960 psnr=.. psnr_fit=.. ssim=.. flip=.. seconds=.. ..

psnr, ssim and flip compare with the views as photographed; psnr_fit after the colours of each render were mapped to its
photo by a least-squares affine map, which leaves exposure and white balance out. CPU seconds count all threads of the
reconstruction; structure from motion is not part of either time.

Every quality fits photos of its own size, and is compared at that size unless `--longest-px` gives others, one line for
each: small pictures are easier to match, so that figures of two qualities can be compared at one size only.
"""

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # as cli.py does; read when torch and numba load

from splatgraft.core.flip import flip
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.image_metrics import fit_color, psnr, ssim
from splatgraft.core.images import list_images
from splatgraft.core.posed_images import PosedImages, held_out
from splatgraft.folders.capture_files import has_poses
from splatgraft.formats import read_capture
from splatgraft.reconstruction import ReconstructOptions, reconstruct
from splatgraft.rendering import render
from splatgraft.runtime.process import peak_memory_bytes, reset_peak_memory

EVERY = 8
FEWEST_PHOTOS = 3


def find_captures(folder: Path) -> list[Path]:
    """Folders with poses, and folders of photos, at or below `folder`; nothing below a capture is one."""
    if has_poses(folder) or len(list_images(folder)) >= FEWEST_PHOTOS:
        return [folder]
    below = sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
    return [capture for path in below for capture in find_captures(path)]


def name_of(capture: Path) -> str:
    """The folder's name; its parent's where it only says that images are in it."""
    return capture.resolve().parent.name if capture.name in {"images", "photos"} else capture.resolve().name


def posed(capture: Path, work: Path) -> Path:
    """`capture`, or what `splatgraft capture` makes of it in `work`, where an earlier result is used again."""
    if has_poses(capture):
        return capture
    out = work / name_of(capture)
    if not has_poses(out):
        work.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, "-m", "splatgraft", "capture", str(capture), "--out", str(out)]
        subprocess.run(command, check=True, stdout=sys.stderr)
    return out


def measure(name: str, folder: Path, quality: str, device: str, longest_px: list[int]) -> None:
    """Reconstruct and print a line for each size; without sizes, for the size at which the photos were fitted."""
    capture = read_capture(folder)
    options = ReconstructOptions(quality=quality, eval_every=EVERY, device=device)  # pyright: ignore[reportArgumentType]
    reset_peak_memory()
    begin, begin_cpu = time.perf_counter(), time.process_time()
    scene = reconstruct(capture, options).to("cpu")
    seconds, cpu = time.perf_counter() - begin, time.process_time() - begin_cpu
    peak = peak_memory_bytes() / 2**20
    cost = f"seconds={seconds:.0f} cpu_seconds={cpu:.0f} gaussians={scene.count} peak_mb={peak:.0f}"
    sizes = [capture.limited(size) for size in longest_px] or [options.served(capture)]
    for photos in (size.select(held_out(len(size), EVERY)) for size in sizes):
        print(f"capture={name} quality={quality} device={device} {compare(scene, photos)} {cost}", flush=True)


def compare(scene: Gaussians, photos: PosedImages) -> str:
    """The part of the line that says how close the renders come to the photos."""
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


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--quality", nargs="+", default=["draft", "standard"])
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--longest-px", nargs="*", type=int, default=[], help="compare at these sizes")
    parser.add_argument("--work", type=Path, default=Path("captures"), help="where posed captures are kept")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        measure(args.one, args.folder, args.quality[0], args.device, args.longest_px)
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
            sizes = ["--longest-px", *map(str, args.longest_px)]
            command = [sys.executable, __file__, str(folder), *words, *sizes]
            failed += subprocess.run(command, check=False).returncode != 0
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
