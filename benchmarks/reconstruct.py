"""Held-out quality and time of a reconstruction: `python benchmarks/reconstruct.py [CAPTURE] [--iterations N]`.

Every 8th view is held out. The last line reads psnr=.. seconds=.. gaussians=..
"""

import argparse
import os
import time
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # as cli.py does; read when torch and numba load

import torch

from splatgraft.core.image_metrics import psnr, ssim
from splatgraft.core.posed_images import held_out
from splatgraft.formats import read_capture
from splatgraft.reconstruction import ReconstructOptions, reconstruct
from splatgraft.rendering import render

ROOM = Path(__file__).parents[1] / "data" / "room"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capture", nargs="?", type=Path, default=ROOM)
    parser.add_argument("--quality", choices=["draft", "standard", "high", "full"], default="standard")
    parser.add_argument("--iterations", type=int)
    parser.add_argument("--budget", type=int)
    parser.add_argument("--resolution", type=float)
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    capture = read_capture(args.capture)
    options = ReconstructOptions(
        quality=args.quality, iterations=args.iterations, budget=args.budget, resolution=args.resolution, eval_every=8
    )
    begin, begin_cpu = time.perf_counter(), time.process_time()

    def say(done: int, total: int, message: str) -> None:
        if done % max(1, total // 10) == 0:
            print(f"{time.perf_counter() - begin:6.1f} s  {done}/{total}  {message}", flush=True)

    gaussians = reconstruct(capture, options, progress=say)
    seconds, cpu = time.perf_counter() - begin, time.process_time() - begin_cpu
    served = options.served(capture)
    tested = [i for i in range(len(served)) if held_out(len(served))[i]]
    pairs = []
    for i in tested:
        picture = render(gaussians, served.cameras[i]).color
        pairs.append((picture[0].clamp(0, 1), served.image(i)))
    similarity = sum(float(ssim(a, b)) for a, b in pairs) / len(pairs)
    decibel = sum(float(psnr(a, b)) for a, b in pairs) / len(pairs)
    print(f"{len(tested)} views held out, ssim {similarity:.4f}, {cpu:.0f} CPU-seconds")
    print(f"psnr={decibel:.2f} seconds={seconds:.1f} gaussians={gaussians.count}")


if __name__ == "__main__":
    main()
