"""Measurement of one method's pictures of one scene of the data set, from files, without rendering."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.flip import flip_map
from splatgraft.core.image_metrics import psnr, ssim, ssim_map
from splatgraft.core.images import read_mask, read_rgb
from splatgraft.evaluation.measure import SMALLEST_REGION, Perceptual, Truth
from splatgraft.fitting.perceptual_losses import lpips_vgg
from splatgraft.project.layout import METRICS_FILE
from splatgraft.project.step import Context, Inputs
from splatgraft_paper.benchmark.measure import measure_view
from splatgraft_paper.tables.layout import held_out_stems, match_views, pictures

Size = tuple[int, int]


_SSIM_BORDER = 5  # pixels of SSIM's window beyond its centre


@dataclass(frozen=True)
class KnownView:
    """What is known of a view; all of one size, sRGB in [0, 1]."""

    truth: Float[Tensor, "h w 3"] | None = None
    """With the object really in the scene."""
    mask: Float[Tensor, "h w"] | None = None
    """Coverage by the object, in [0, 1]."""
    background: Float[Tensor, "h w 3"] | None = None
    """Without the object."""


def measure_picture(
    image: Float[Tensor, "h w 3"], known: KnownView, perceptual: Perceptual | None = None
) -> dict[str, float]:
    """Every metric that what is known allows; nan where a region is too small.

    With a truth those of the whole, with a mask also those of the object, with a background all of `measure_view`.
    """
    out: dict[str, float] = {}
    if known.truth is not None and known.mask is not None and known.background is not None:
        truth = Truth(image=known.truth, background=known.background, mask=known.mask)
        out |= measure_view(image, truth, background=known.background, perceptual=perceptual)
    elif known.truth is not None:
        out |= _whole_and_object(image, known.truth, known.mask, perceptual)
    if known.truth is not None:
        out["ssim_padded_whole"] = float(padded_ssim(image, known.truth))
    return out


def padded_ssim(image: Float[Tensor, "h w c"], reference: Float[Tensor, "h w c"]) -> Float[Tensor, ""]:
    """SSIM as 3DGS computes it: the images go on as zeros beyond their borders, and border pixels count."""
    pads = (0, 0, _SSIM_BORDER, _SSIM_BORDER, _SSIM_BORDER, _SSIM_BORDER)
    return ssim(F.pad(image, pads), F.pad(reference, pads))


def _whole_and_object(
    image: Float[Tensor, "h w 3"],
    truth: Float[Tensor, "h w 3"],
    mask: Float[Tensor, "h w"] | None,
    perceptual: Perceptual | None,
) -> dict[str, float]:
    similarity, visible = ssim_map(image, truth).mean(-1), flip_map(image, truth)
    out = {
        "psnr_whole": float(psnr(image, truth)),
        "ssim_whole": float(similarity.mean()),
        "flip_whole": float(visible.mean()),
    }
    if perceptual is not None:
        out["lpips_whole"] = float(perceptual(image, truth))
    if mask is None:
        return out
    inside = mask > 0.5
    inner = inside[_SSIM_BORDER:-_SSIM_BORDER, _SSIM_BORDER:-_SSIM_BORDER]
    large_enough = int(inner.sum()) >= SMALLEST_REGION
    out["psnr_object"] = float(psnr(image, truth, inside)) if large_enough else math.nan
    out["ssim_object"] = float(similarity[inner].mean()) if large_enough else math.nan
    out["flip_object"] = float(visible[inside].mean()) if large_enough else math.nan
    if perceptual is not None:
        mixed = torch.where(inside[..., None], image, truth)
        out["lpips_object"] = float(perceptual(mixed, truth)) if large_enough else math.nan
    return out


@dataclass(frozen=True)
class MeasurePictures:
    """Compare a method's pictures of one scene with what is known of their views."""

    pictures: Path
    """The method's pictures."""
    out: Path
    """Folder for metrics.json."""
    truth: Path | None = None
    """Pictures with the object really in the scene."""
    masks: Path | None = None
    """Masks of the object."""
    background: Path | None = None
    """Pictures without the object."""
    composite: Path | None = None
    """Pictures with the object pasted in."""
    weights: Path | None = None
    """Folder of LPIPS's weights."""
    lpips: bool = False
    """Whether LPIPS is measured."""
    all_views: bool = False
    """Measure all views, not only the held-out ones."""

    def inputs(self) -> Inputs:
        """The pictures of the measured views."""
        chosen = self.views()
        return {role: tuple(files[stem] for stem in chosen.matched) for role, files in chosen.files.items()}

    def write(self, folder: Path, context: Context) -> None:
        """Measure each view."""
        chosen = self.views()
        perceptual = lpips_vgg(self.weights) if self.lpips else None
        rows: dict[str, dict[str, float | None]] = {}
        sizes: set[Size] = set()
        for done, stem in enumerate(chosen.matched, 1):
            image = read_rgb(chosen.files["pictures"][stem])
            sizes.add((image.shape[1], image.shape[0]))
            known = _known(chosen.files, stem, (image.shape[1], image.shape[0]))
            values = measure_picture(image, known, perceptual)
            rows[stem] = {name: value if math.isfinite(value) else None for name, value in values.items()}
            context.progress(done, len(chosen.matched), stem)
        record = {"values": _means(rows), "views": rows, "protocol": self._protocol(chosen, sizes)}
        (folder / METRICS_FILE).write_text(json.dumps(record, indent=1, allow_nan=False))

    def views(self) -> "ChosenViews":
        """The views to measure and their files by role."""
        reference = self.truth or self.composite
        found = pictures(self.pictures)
        wanted = list(found if reference is None else pictures(reference))
        matched, how = match_views(wanted, found)
        held_out = held_out_stems(wanted)
        stems = [stem for stem in (wanted if self.all_views else held_out) if stem in matched]
        if not stems:
            raise ValueError(f"{self.pictures}: expected pictures of the views in {reference}, found {how}")
        files = {"pictures": matched}
        for role in ("truth", "masks", "background", "composite"):
            folder: Path | None = getattr(self, role)
            if folder is not None:
                files[role], _ = match_views(wanted, pictures(folder))
                if lost := [stem for stem in stems if stem not in files[role]]:
                    raise ValueError(f"{folder}: expected a picture of view {lost[0]} for the {role}, found none")
        return ChosenViews(files, stems, how, len(wanted), len(held_out))

    def _protocol(self, chosen: "ChosenViews", sizes: set[Size]) -> dict[str, object]:
        """What a reader needs to know to compare the numbers."""
        return {
            "views": "all" if self.all_views else "held out: every 8th from the first",
            "view_count": len(chosen.matched),
            "views_of_the_scene": chosen.of_scene,
            "held_out_views_of_the_scene": chosen.held_out,
            "matched": chosen.how,
            "resolution": sorted(f"{width}x{height}" for width, height in sizes),
            "truth": self.truth is not None,
            "masks": self.masks is not None,
            "background": self.background is not None,
        }


@dataclass(frozen=True)
class ChosenViews:
    """The views of a scene that are measured."""

    files: Mapping[str, Mapping[str, Path]]
    """Role to files by view."""
    matched: list[str]
    """Names of the views, in their order."""
    how: str
    """How pictures were matched to views."""
    of_scene: int
    held_out: int


def _known(files: Mapping[str, Mapping[str, Path]], stem: str, size: Size) -> KnownView:
    def read(role: str) -> Float[Tensor, "h w 3"] | None:
        return _of_size(read_rgb(files[role][stem]), files[role][stem], size) if role in files else None

    mask = _of_size(read_mask(files["masks"][stem]), files["masks"][stem], size) if "masks" in files else None
    return KnownView(read("truth"), mask, read("background"))


def _of_size(image: Tensor, path: Path, size: Size) -> Tensor:
    """Nothing is resampled: a number of a resampled picture is another number."""
    if (image.shape[1], image.shape[0]) != size:
        found = f"{image.shape[1]}x{image.shape[0]}"
        raise ValueError(f"{path}: expected {size[0]}x{size[1]} pixels as the method's picture, found {found}")
    return image


def _means(rows: Mapping[str, Mapping[str, float | None]]) -> dict[str, float | None]:
    out: dict[str, float | None] = {}
    for name in next(iter(rows.values())):
        values = [value for row in rows.values() if (value := row[name]) is not None]
        out[name] = sum(values) / len(values) if values else None
    return out
