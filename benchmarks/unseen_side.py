"""Measure an object from its unseen side, open and closed, after half of its photographs were left out.

    python benchmarks/unseen_side.py CAPTURE [CAPTURE ...] [--pictures FOLDER]

CAPTURE has poses and masks all around the object. The photographs of a half circle are left out. The others are
reconstructed and the object is cut. Printed is the PSNR over black inside the true mask, widened by two pixels, in the
photographs that were left out and in the others.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatgraft.core.capture_orientation import estimate_up, focus_point
from splatgraft.core.directions import tangents
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.image_metrics import psnr
from splatgraft.core.images import write_image
from splatgraft.core.posed_images import PosedImages
from splatgraft.formats import read_capture
from splatgraft.reconstruction import ReconstructOptions, reconstruct
from splatgraft.rendering import render
from splatgraft.segmentation import segment

OPTIONS = ReconstructOptions(iterations=1000, budget=20_000)
_MARGIN_PX = 2


def halves(capture: PosedImages) -> tuple[PosedImages, Int[Tensor, " a"], Int[Tensor, " b"]]:
    """Return the capture from one half circle around the subject, its photographs, and the other photographs.

    Points on the other side are removed too, because the remaining photographs do not show them.
    """
    tangent, bitangent = tangents(estimate_up(capture.cameras))
    focus = focus_point(capture.cameras)

    def is_kept(places: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        away = places - focus
        return torch.remainder(torch.atan2(away @ bitangent, away @ tangent) - first, 2 * torch.pi) < torch.pi

    away = capture.cameras.centers[0] - focus
    first = torch.atan2(away @ bitangent, away @ tangent)
    kept, seen = is_kept(capture.cameras.centers), is_kept(capture.points)
    part = replace(capture.select(kept), points=capture.points[seen], point_colors=capture.point_colors[seen])
    return part, kept.nonzero()[:, 0], (~kept).nonzero()[:, 0]


def on_black(capture: PosedImages, index: int) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
    """Return a photograph's object over black, and its mask."""
    mask = capture.mask(index)
    assert mask is not None
    return capture.image(index) * mask[..., None], mask


def mean_psnr(object_: Gaussians, capture: PosedImages, which: Int[Tensor, " n"]) -> float:
    """Return the PSNR over some photographs, inside the widened mask."""
    found = []
    for index in which.tolist():
        truth, mask = on_black(capture, index)
        size = 2 * _MARGIN_PX + 1
        region = torch.nn.functional.max_pool2d(mask[None, None], size, stride=1, padding=_MARGIN_PX)[0, 0] > 0.5
        found.append(psnr(render(object_, capture.cameras[index]).color[0].clamp(0, 1), truth, region))
    return float(torch.stack(found).mean())


def measure(path: Path, pictures: Path | None) -> tuple[float, ...]:
    """Return the guessed share, then PSNR open and closed in the photographs left out, and in the others."""
    capture = read_capture(path)
    part, kept, left_out = halves(capture)
    found = segment(reconstruct(part, OPTIONS), part)
    open_ = found.object.select(~found.is_guessed)
    if pictures is not None:
        shown = left_out[:: max(1, len(left_out) // 3)][:3].tolist()
        columns = [
            [render(one, capture.cameras[i]).color[0].clamp(0, 1) for i in shown] for one in (open_, found.object)
        ]
        columns.append([on_black(capture, i)[0] for i in shown])
        pictures.mkdir(parents=True, exist_ok=True)
        picture = torch.cat([torch.cat(column, 0) for column in columns], 1)
        write_image(pictures / f"{path.resolve().parent.name}_{path.name}.png", picture)
    rows = [mean_psnr(one, capture, which) for which in (left_out, kept) for one in (open_, found.object)]
    return float(found.is_guessed.float().mean()), *rows


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("captures", type=Path, nargs="+", help="captures with poses and masks")
    parser.add_argument("--pictures", type=Path, help="folder for open, closed and true pictures side by side")
    options = parser.parse_args()
    for path in options.captures:
        share, *rows = measure(path, options.pictures)
        name = f"{path.resolve().parent.name}/{path.name}"
        left_out, others = (f"{rows[i]:.2f} -> {rows[i + 1]:.2f} dB" for i in (0, 2))
        print(f"{name:28s} {share:.0%} added   left out {left_out}   others {others}", flush=True)


if __name__ == "__main__":
    main()
