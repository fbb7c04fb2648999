"""Metrics of a method on one scene: its pictures of the held-out views are compared with the ground truth."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import list_images, read_rgb, write_image
from splatgraft.core.posed_images import PosedImages, held_out
from splatgraft.evaluation import Truth
from splatgraft.evaluation.measure import Perceptual
from splatgraft.fitting.perceptual_losses import lpips_vgg
from splatgraft.formats import read_capture, read_gaussians
from splatgraft.project.layout import METRICS_FILE
from splatgraft.project.step import Context, Device, Inputs, choose_device
from splatgraft.rendering import render
from splatgraft_paper.benchmark.scene import HELD_OUT_EVERY
from splatgraft_paper.benchmark.view_metrics import disagreement, measure_view
from splatgraft_paper.tables.picture_folders import match_views, pictures


@dataclass(frozen=True)
class MeasureMethod:
    """Compare one method with the truth on the held-out views of one scene."""

    truth: Path
    """Capture with the object, with masks."""
    photographs: Path
    """Capture without the object, from the same cameras."""
    target: Path
    """The reconstruction without the object, a .ply: the reference of the method's shadow."""
    out: Path
    """Folder for metrics.json and pictures/."""
    result: Path | None = None
    """The method's scene, a .ply."""
    pictures: Path | None = None
    """Or its pictures, named as the views, or numbered as 3DGS's render.py does: all views, or the held-out ones."""
    weights: Path | None = None
    """Folder of LPIPS's weights."""
    lpips: bool = False
    """Whether LPIPS is measured."""
    device: Device = "auto"

    def inputs(self) -> Inputs:
        """The truth, the result and the pictures."""
        files = {}
        for role, folder in (("truth", self.truth), ("photographs", self.photographs)):
            files[role] = read_capture(folder).image_paths
        files["scenes"] = tuple(path for path in (self.target, self.result) if path is not None)
        found = list_images(self.pictures) if self.pictures is not None and self.pictures.is_dir() else []
        return {**files, "pictures": tuple(found)}

    def write(self, folder: Path, context: Context) -> None:
        """Measure every held-out view and write its picture."""
        truth, photographs = read_capture(self.truth), read_capture(self.photographs)
        if truth.cameras.names != photographs.cameras.names:
            raise ValueError(f"{self.truth}: expected views named as in {self.photographs}, found others")
        chosen = [int(i) for i in torch.nonzero(held_out(len(truth), HELD_OUT_EVERY)).flatten()]
        device = choose_device(self.device, context.console)
        scene = None if self.result is None else read_gaussians(self.result).to(device)
        background = read_gaussians(self.target).to(device)
        perceptual = lpips_vgg(self.weights) if self.lpips else None
        (folder / "pictures").mkdir()
        images = self._images(scene, truth, chosen)
        rows = {}
        for done, index in enumerate(chosen, 1):
            stem = Path(truth.cameras.names[index]).stem
            write_image(folder / "pictures" / f"{stem}.png", images[index])
            without = _picture(background, truth, index)
            rows[stem] = _row(images[index], true_view(truth, photographs, index), without, perceptual)
            context.progress(done, len(chosen), stem)
        values = {name: _mean([row[name] for row in rows.values()]) for name in next(iter(rows.values()))}
        consistency = _consistency(self.truth, truth, images)
        record = {"values": {**values, **consistency}, "views": rows}
        (folder / METRICS_FILE).write_text(json.dumps(record, indent=1, allow_nan=False))

    def _images(
        self, scene: Gaussians | None, truth: PosedImages, chosen: list[int]
    ) -> Mapping[int, Float[Tensor, "h w 3"]]:
        """Pictures by view: of a scene all, for consistency; of a folder those that exist, at least the held out."""
        if scene is not None:
            return {index: _picture(scene, truth, index) for index in range(len(truth))}
        assert self.pictures is not None
        found: dict[int, Tensor] = {}
        stems = [Path(name).stem for name in truth.cameras.names]
        matched, _ = match_views(stems, pictures(self.pictures), HELD_OUT_EVERY)
        for index, stem in enumerate(stems):
            path = matched.get(stem, self.pictures / f"{stem}.png")
            if stem in matched:
                found[index] = read_rgb(path)
                wanted = (truth.cameras.sizes[index][1], truth.cameras.sizes[index][0])
                if found[index].shape[:2] != torch.Size([int(wanted[0]), int(wanted[1])]):
                    sizes = f"{wanted[1]}x{wanted[0]} pixels, found {found[index].shape[1]}x{found[index].shape[0]}"
                    raise ValueError(f"{path}: expected {sizes}")
            elif index in chosen:
                raise ValueError(f"{path}: expected the method's picture of a held-out view, found none")
        return found


def true_view(truth: PosedImages, photographs: PosedImages, index: int) -> Truth:
    """The true picture of a view, its picture without the object, and the object's mask.

    Raises:
        ValueError: The view has no mask.
    """
    mask = truth.mask(index)
    if mask is None:
        raise ValueError(f"{truth.image_paths[index]}: expected a mask of the object in masks/, found none")
    return Truth(image=truth.image(index), background=photographs.image(index), mask=mask)


def _row(
    image: Float[Tensor, "h w 3"],
    truth: Truth,
    background: Float[Tensor, "h w 3"],
    perceptual: Perceptual | None,
) -> dict[str, float | None]:
    values = measure_view(image, truth, background=background, perceptual=perceptual)
    return {name: value if math.isfinite(value) else None for name, value in values.items()}


def _mean(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _picture(scene: Gaussians, truth: PosedImages, index: int) -> Float[Tensor, "h w 3"]:
    color = render(scene, truth.cameras[index].to(scene.device)).color
    return color[0].cpu().clamp(0, 1)


def _consistency(
    folder: Path, truth: PosedImages, images: Mapping[int, Float[Tensor, "h w 3"]]
) -> dict[str, float | None]:
    """Disagreement of neighbouring views of the method and of the ground truth; None where depth is unknown."""
    paths = [folder / "depth" / f"{Path(name).stem}.npy" for name in truth.cameras.names]
    if not all(path.is_file() for path in paths):
        return {"disagreement": None, "disagreement_truth": None}
    depths = [torch.from_numpy(np.load(path, allow_pickle=False).astype(np.float32)) for path in paths]
    masks = [mask for mask in (truth.mask(index) for index in range(len(truth))) if mask is not None]
    true_images = {index: truth.image(index) for index in images}
    return {
        "disagreement": disagreement(images, depths, masks, truth.cameras),
        "disagreement_truth": disagreement(true_images, depths, masks, truth.cameras),
    }
