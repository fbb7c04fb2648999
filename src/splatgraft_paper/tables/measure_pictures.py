"""Measurement of one method's pictures of one scene of the data set, from files, without rendering."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.flip import flip_map
from splatgraft.core.image_metrics import psnr, ssim
from splatgraft.core.images import read_rgb
from splatgraft.evaluation.measure import Perceptual
from splatgraft.fitting.perceptual_losses import lpips_vgg
from splatgraft.project.layout import METRICS_FILE
from splatgraft.project.step import Context, Inputs
from splatgraft_paper.tables.layout import held_out_stems, match_views, pictures


def measure_picture(
    image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], perceptual: Perceptual | None = None
) -> dict[str, float]:
    """Compute PSNR, SSIM, FLIP and, with `perceptual`, LPIPS of a whole picture, sRGB in [0, 1]."""
    out = {
        "psnr": float(psnr(image, truth)),
        "ssim": float(padded_ssim(image, truth)),
        "flip": float(flip_map(image, truth).mean()),
    }
    return out if perceptual is None else {**out, "lpips": float(perceptual(image, truth))}


def padded_ssim(image: Float[Tensor, "h w c"], reference: Float[Tensor, "h w c"]) -> Float[Tensor, ""]:
    """Compute SSIM as 3DGS does: images continue as zeros beyond their borders, and border pixels count."""
    pads = (0, 0, 5, 5, 5, 5)  # half of SSIM's window
    return ssim(F.pad(image, pads), F.pad(reference, pads))


@dataclass(frozen=True)
class MeasurePictures:
    """Comparison of a method's pictures of one scene with the truth."""

    pictures: Path
    """Folder with the method's pictures."""
    truth: Path
    """Folder with pictures of the object in the scene."""
    out: Path
    """Folder for metrics.json."""
    weights: Path | None = None
    """Folder with LPIPS's weights."""
    lpips: bool = False
    """Whether LPIPS is measured."""
    all_views: bool = False
    """Whether to measure all views instead of the held-out ones."""

    def inputs(self) -> Inputs:
        """List the pictures of the measured views."""
        return {role: tuple(files.values()) for role, files in self.views().files.items()}

    def write(self, folder: Path, context: Context) -> None:
        """Measure each view."""
        chosen = self.views()
        perceptual = lpips_vgg(self.weights) if self.lpips else None
        rows: dict[str, dict[str, float]] = {}
        sizes: set[str] = set()
        for done, (stem, path) in enumerate(chosen.files["pictures"].items(), 1):
            image, truth = read_rgb(path), read_rgb(chosen.files["truth"][stem])
            size, found = (f"{one.shape[1]}x{one.shape[0]}" for one in (image, truth))
            if found != size:  # metrics of a resampled picture would differ
                wanted = f"{size} pixels as the method's picture"
                raise ValueError(f"{chosen.files['truth'][stem]}: expected {wanted}, found {found}")
            sizes.add(size)
            rows[stem] = measure_picture(image, truth, perceptual)
            context.progress(done, len(chosen.files["pictures"]), stem)
        values = {name: sum(row[name] for row in rows.values()) / len(rows) for name in next(iter(rows.values()))}
        protocol = {
            "views": "all" if self.all_views else "held out: every 8th from the first",
            "view_count": len(rows),
            "matched": chosen.how,
            "resolution": sorted(sizes),
        }
        record = {"values": values, "views": rows, "protocol": protocol}
        (folder / METRICS_FILE).write_text(json.dumps(record, indent=1, allow_nan=False), encoding="utf-8")

    def views(self) -> "ChosenViews":
        """Choose the views to measure."""
        truth = pictures(self.truth)
        matched, how = match_views(list(truth), pictures(self.pictures))
        stems = [stem for stem in (truth if self.all_views else held_out_stems(list(truth))) if stem in matched]
        if not stems:
            raise ValueError(f"{self.pictures}: expected pictures of the views in {self.truth}, found {how}")
        files = {
            role: {stem: found[stem] for stem in stems} for role, found in (("pictures", matched), ("truth", truth))
        }
        return ChosenViews(files, how)


@dataclass(frozen=True)
class ChosenViews:
    """Views of a scene that are measured."""

    files: Mapping[str, Mapping[str, Path]]
    """Files by view, of the roles `pictures` and `truth`."""
    how: str
    """Description of how pictures were matched to views."""
