"""Measurement of one method's pictures of one scene of the data set, from files, without rendering."""

import json
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.flip import flip_map
from splatgraft.core.image_metrics import psnr, ssim
from splatgraft.core.images import read_rgb
from splatgraft.evaluation.measure import Perceptual
from splatgraft.fitting.perceptual_losses import HEADS_FILE, VGG_FILE, lpips_vgg
from splatgraft.project.layout import METRICS_FILE
from splatgraft.project.step import Context, Device, Inputs, choose_device
from splatgraft_paper.benchmark.image_features import (
    INCEPTION_FILE,
    frechet_distance,
    inception_features,
    kernel_distance,
)
from splatgraft_paper.tables.layout import held_out_stems, match_views, pictures

FEATURES_FILE = "features.npy"
"""Inception features (2, v, 2048) of the pictures and of the truth, for FID and KID over several scenes."""
LPIPS = {"lpips": -1.0, "lpips01": 0.0}
"""Value of black for the network, by metric: as published, and as in 3DGS's metrics.py."""
_Key = TypeVar("_Key", bound=Hashable)


def measure_picture(
    image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], perceptual: Mapping[str, Perceptual] = {}
) -> dict[str, float]:
    """Compute PSNR, SSIM, FLIP and the `perceptual` metrics of a whole picture, sRGB in [0, 1]."""
    out = {
        "psnr": float(psnr(image, truth)),
        "ssim": float(padded_ssim(image, truth)),
        "flip": float(flip_map(image, truth).mean()),
    }
    return out | {name: float(distance(image, truth)) for name, distance in perceptual.items()}


def padded_ssim(image: Float[Tensor, "h w c"], reference: Float[Tensor, "h w c"]) -> Float[Tensor, ""]:
    """Compute SSIM as 3DGS does: images continue as zeros beyond their borders, and border pixels count."""
    pads = (0, 0, 5, 5, 5, 5)  # half of SSIM's window
    return ssim(F.pad(image, pads), F.pad(reference, pads))


@dataclass(frozen=True)
class MetricOptions:
    """Metrics that need weights, and their weights."""

    weights: Path | None = None
    """Folder with the weights of LPIPS and Inception; torch hub's cache by default."""
    lpips: bool = False
    """Whether LPIPS is measured."""
    fid: bool = False
    """Whether the features for FID and KID are computed."""
    device: Device = "cpu"
    """Device of LPIPS."""

    def weights_known(self) -> list[list[str | int]]:
        """List name, size and time of the files of weights, so that other weights make metrics stale."""
        folder = self.weights or Path(torch.hub.get_dir()) / "checkpoints"
        names = (*((VGG_FILE, HEADS_FILE) if self.lpips else ()), *((INCEPTION_FILE,) if self.fid else ()))
        return [[name, (folder / name).stat().st_size, (folder / name).stat().st_mtime_ns] for name in names]

    def perceptual(self, context: Context) -> dict[str, Perceptual]:
        """Load LPIPS in both scalings, on the device."""
        if not self.lpips:
            return {}
        device = choose_device(self.device, context.console)
        loaded = {name: lpips_vgg(self.weights, black=black) for name, black in LPIPS.items()}

        def on_device(distance: Perceptual) -> Perceptual:
            return lambda image, truth: distance(image.to(device), truth.to(device))

        return {name: on_device(distance) for name, distance in loaded.items()}


@dataclass(frozen=True)
class MeasurePictures:
    """Comparison of a method's pictures of one scene with the truth."""

    pictures: Path
    """Folder with the method's pictures."""
    truth: Path
    """Folder with pictures of the object in the scene."""
    out: Path
    """Folder for metrics.json."""
    metrics: MetricOptions = field(default_factory=MetricOptions)
    all_views: bool = False
    """Whether to measure all views instead of the held-out ones."""

    def inputs(self) -> Inputs:
        """List the pictures of the measured views."""
        return {role: tuple(files.values()) for role, files in self.views().files.items()}

    def recorded_options(self) -> dict[str, Any]:
        """Return the options, with the weights of the metrics."""
        return {"all_views": self.all_views, "weights": self.metrics.weights_known()}

    def write(self, folder: Path, context: Context) -> None:
        """Measure each view."""
        chosen = self.views()
        perceptual = self.metrics.perceptual(context)
        features = inception_features(self.metrics.weights) if self.metrics.fid else None
        rows: dict[str, dict[str, float]] = {}
        found: list[np.ndarray] = []
        sizes: set[str] = set()
        for done, (stem, path) in enumerate(chosen.files["pictures"].items(), 1):
            image, truth = read_rgb(path), read_rgb(chosen.files["truth"][stem])
            size, wanted = (f"{one.shape[1]}x{one.shape[0]}" for one in (image, truth))
            if wanted != size:  # metrics of a resampled picture would differ
                expected = f"{size} pixels as the method's picture"
                raise ValueError(f"{chosen.files['truth'][stem]}: expected {expected}, found {wanted}")
            sizes.add(size)
            rows[stem] = measure_picture(image, truth, perceptual)
            found += [] if features is None else [features([image, truth])]
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
        if features is not None:
            np.save(folder / FEATURES_FILE, np.stack(found, 1))

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


def pooled_distances(steps: Mapping[_Key, list[MeasurePictures]]) -> dict[_Key, dict[str, float]]:
    """Compute FID and KID between a method's pictures of all its scenes and the true ones, from measured features."""
    out: dict[_Key, dict[str, float]] = {}
    for key, group in steps.items():
        if not all((step.out / FEATURES_FILE).is_file() for step in group):
            continue
        made, true = np.concatenate([np.load(step.out / FEATURES_FILE) for step in group], 1)
        if len(true) >= 2:
            out[key] = {"fid": frechet_distance(made, true), "kid": kernel_distance(made, true)}
    return out
