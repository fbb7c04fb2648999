"""Rendered pairs and their light-transfer priors in memory, with augmentation, to train the compact harmoniser."""

import json
import math
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.images import linear_from_srgb
from splatgraft.harmonization.compact.features import CompactInput, relative_depth
from splatgraft.runtime.progress import Progress, silent
from splatgraft_paper.synthesis.benchmark import rendered_cameras
from splatgraft_paper.synthesis.pairs import PairSample, read_manifest

_LINEAR = linear_from_srgb(torch.arange(256) / 255)


@dataclass(frozen=True)
class HeldOutOptions:
    """Pairs that are held out of the training."""

    materials: tuple[str, ...] = ("brick",)
    """Material patterns; objects with one of them are held out."""
    lights: tuple[str, ...] = ("interior.exr",)
    """Environment maps; objects captured under one of them are held out."""
    every: int = 12
    """Stride of held-out scenes; 0 for none."""


@dataclass(frozen=True)
class CompactPair:
    """One decoded pair; pairs with a common picture share its array."""

    folder: str
    light: str
    held_out: bool
    arrays: Mapping[str, np.ndarray]
    """Pictures: target, background, relit (RGBA), mask: 8-bit sRGB; depth: float16; normal: int8, camera's frame."""
    log_ratio: Float[np.ndarray, "h w 3"]
    """Log ratio of the prior, float16."""
    confidence: float
    """Confidence of the prior."""


class CompactPairs:
    """All pairs of a folder with priors, decoded."""

    def __init__(self, pairs: Path, priors: Path, held_out: HeldOutOptions, progress: Progress = silent) -> None:
        """Read all rendered pairs, about 0.6 MB each at 240x160, and the priors that `write_priors` wrote."""
        self.entries: list[CompactPair] = []
        samples = read_manifest(pairs)
        folders = sorted({sample.folder for sample in samples})
        for number, folder in enumerate(folders):
            scene_held_out = held_out.every > 0 and number % held_out.every == held_out.every - 1
            path = priors / f"{folder.name}.npz"
            if path.is_file():
                own = [sample for sample in samples if sample.folder == folder]
                self.entries += _read_folder(folder, own, path, None if scene_held_out else held_out)
            progress(number + 1, len(folders), folder.name)
        if not self.entries:
            raise ValueError(f"{priors}: expected priors of the pairs in {pairs}, found none")
        self.training = [i for i, entry in enumerate(self.entries) if not entry.held_out]
        self.validation = [i for i, entry in enumerate(self.entries) if entry.held_out]

    def fingerprint(self) -> dict[str, int]:
        """Return the counts that must be equal in a resumed training."""
        return {"training": len(self.training), "validation": len(self.validation)}

    def read(self, index: int) -> tuple[CompactInput, Float[Tensor, "1 3 h w"]]:
        """Read a pair at full size with its prior, and the truth in linear light.

        The composite's object keeps the exposure of its own light; it is not normalised as in the paper.
        """
        entry = self.entries[index]
        arrays = {name: torch.from_numpy(array) for name, array in entry.arrays.items()}
        background, relit = arrays["background"], arrays["relit"].float() / 255
        mask = arrays["mask"].float() / 255
        covered = torch.minimum(mask, relit[..., 3])[..., None]
        composite = linear_from_srgb(covered * relit[..., :3] + (1 - covered) * background.float() / 255)
        view = CompactInput(
            composite=_channels_first(composite),
            background=_channels_first(_LINEAR[background.int()]),
            mask=covered[..., 0][None, None],
            log_ratio=_channels_first(torch.from_numpy(entry.log_ratio).float()),
            depth=relative_depth(arrays["depth"].float(), mask)[None, None],
            normal=_channels_first(arrays["normal"].float() / 127),
            prior_confidence=torch.tensor([entry.confidence]),
        )
        return view, _channels_first(_LINEAR[arrays["target"].int()])


def _read_folder(
    folder: Path, samples: Sequence[PairSample], priors: Path, held_out: HeldOutOptions | None
) -> list[CompactPair]:
    """Read the pairs of a scene; `held_out` is None if the whole scene is held out."""
    job = json.loads((folder / "job.json").read_text())
    cameras = rendered_cameras(folder, tuple(f"{i:04d}" for i in range(len(job["cameras"]))))
    worlds = {take["name"]: take["world"].get("path", "") for take in job["takes"] if take.get("world")}
    picture = cache(_read_image)
    with np.load(priors, allow_pickle=False) as arrays:
        found = {name: arrays[name] for name in arrays.files}
    pairs = []

    @cache
    def geometry(path_of_depth: Path, path_of_normal: Path, camera: int) -> tuple[np.ndarray, np.ndarray]:
        depth = np.load(path_of_depth, allow_pickle=False)
        normal = picture(path_of_normal).astype(np.float32) / 127.5 - 1
        length = np.linalg.norm(normal, axis=-1, keepdims=True)
        unit = np.where((depth > 0)[..., None], normal / np.maximum(length, 1e-3), 0)
        in_camera = unit @ cameras.camera_from_world[camera, :3, :3].numpy().T
        return depth, np.round(127 * in_camera).astype(np.int8)

    for sample in samples:
        take = f"{sample.object}_{sample.light}"
        if take not in found:
            raise ValueError(f"{priors}: expected a prior of {take}, found none; remove the file to remake it")
        patterns = {part["material"]["pattern"] for part in job["objects"][sample.object]}
        is_held_out = held_out is None or bool(patterns & set(held_out.materials)) or worlds[take] in held_out.lights
        mask = picture(sample.path(sample.object, "mask"))
        depth, normal = geometry(
            sample.path(sample.object, "depth"), sample.path(sample.object, "normal"), sample.camera
        )
        arrays = {
            "target": picture(sample.path(sample.object)),
            "background": picture(sample.path("background")),
            "relit": picture(sample.path(take)),
            "mask": mask if mask.ndim == 2 else mask[..., 0],
            "depth": depth,
            "normal": normal,
        }
        ratio, confidence = found[take][sample.camera], float(found[f"{take}_trust"])
        pairs.append(CompactPair(folder.name, sample.light, is_held_out, arrays, ratio, confidence))
    return pairs


def _channels_first(image: Float[Tensor, "h w 3"]) -> Float[Tensor, "1 3 h w"]:
    return image.permute(2, 0, 1)[None]


def _read_image(path: Path) -> np.ndarray:
    found = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if found is None:
        raise ValueError(f"{path}: expected a picture, found none that can be read")
    if found.ndim == 3:
        code = cv2.COLOR_BGRA2RGBA if found.shape[2] == 4 else cv2.COLOR_BGR2RGB
        found = cv2.cvtColor(found, code)
    return found


Crop = tuple[int, int, int, int]
"""Rectangle: top, left, height, width, pixels."""


@dataclass(frozen=True)
class Augmentation:
    """Distributions of the augmentation, set by hand. A log factor of x is a factor of e^x."""

    min_object_margin: float = 2.0
    """Minimum size of a crop relative to the object."""
    min_crop: float = 0.4
    """Minimum size of a crop relative to the largest crop of the image."""
    mirror: float = 0.5
    """Probability of a mirrored view."""
    level_deviation: float = 0.25
    """Standard deviation of the log factor on all light."""
    tint_deviation: float = 0.12
    """Standard deviation of the log factor on each channel of all light."""
    object_exposure_deviation: float = 0.35
    """Standard deviation of the log factor on the composite's object."""
    object_tint_deviation: float = 0.06
    """Standard deviation of the log factor on each channel of the composite's object."""
    no_prior: float = 0.08
    """Probability of a view without a prior."""
    max_geometry_noise: float = 0.25
    """Maximum standard deviation of the errors added to normals; a tenth of them is added to the log depth."""
    geometry_noise_px: int = 8
    """Distance over which these errors are correlated, pixels."""


SETTINGS = Augmentation()


def augment(
    view: CompactInput, target: Float[Tensor, "1 3 h w"], size: tuple[int, int], seed: str
) -> tuple[CompactInput, Float[Tensor, "1 3 i j"]]:
    """Augment a view (a batch of one) and its truth to `size` (height, width); the crop contains the whole object."""
    rng = random.Random(seed)
    top, left, height, width = _random_crop(view.mask[0, 0], size, rng)

    def cropped(x: Tensor) -> Tensor:
        piece = x[..., top : top + height, left : left + width]
        return F.interpolate(piece, size=size, mode="bilinear", antialias=True, align_corners=False)

    names = ("composite", "background", "mask", "log_ratio", "depth", "normal")
    pictures = {name: cropped(getattr(view, name)) for name in names}
    target = cropped(target)
    if rng.random() < SETTINGS.mirror:
        pictures = {name: x.flip(-1) for name, x in pictures.items()}
        target = target.flip(-1)
        pictures["normal"] = pictures["normal"] * torch.tensor([-1.0, 1, 1])[:, None, None]
    out, target = _change_light(CompactInput(**pictures, prior_confidence=view.prior_confidence), target, rng)
    return _change_object_exposure(_add_geometry_noise(out, rng), rng), target


def _random_crop(mask: Float[Tensor, "h w"], size: tuple[int, int], rng: random.Random) -> Crop:
    """Draw a crop with the aspect ratio of `size` that contains the whole object."""
    h, w = mask.shape
    rows, columns = (mask > 0.05).any(1).nonzero()[:, 0], (mask > 0.05).any(0).nonzero()[:, 0]
    tall, wide = int(rows[-1] - rows[0]) + 1, int(columns[-1] - columns[0]) + 1
    aspect = size[1] / size[0]
    largest = min(h, w / aspect)
    object_crop = SETTINGS.min_object_margin * max(tall, wide / aspect)
    smallest = min(largest, max(object_crop, SETTINGS.min_crop * largest))
    height = round(rng.uniform(smallest, largest))
    width = min(w, round(height * aspect))

    def offset(first: int, length: int, crop: int, full: int) -> int:
        low, high = max(0, first + length - crop), min(first, full - crop)
        return rng.randint(low, high) if low <= high else max(0, min(full - crop, (low + high) // 2))

    return offset(int(rows[0]), tall, height, h), offset(int(columns[0]), wide, width, w), height, width


def _change_light(view: CompactInput, target: Tensor, rng: random.Random) -> tuple[CompactInput, Tensor]:
    """Permute and scale the channels of all light, so that the network does not learn the scenes' colours."""
    order = rng.sample(range(3), 3)
    gain = math.exp(rng.gauss(0.0, SETTINGS.level_deviation)) * torch.tensor(
        [math.exp(rng.gauss(0.0, SETTINGS.tint_deviation)) for _ in range(3)]
    )

    def changed(x: Tensor) -> Tensor:
        return x[:, order] * gain[:, None, None]

    swapped = view.log_ratio[:, order]
    composite, background = changed(view.composite), changed(view.background)
    return replace(view, composite=composite, background=background, log_ratio=swapped), changed(target)


def _change_object_exposure(view: CompactInput, rng: random.Random) -> CompactInput:
    """Scale the composite's object, and its log ratio inversely, so that the prior does not change."""
    shift = rng.gauss(0.0, SETTINGS.object_exposure_deviation) + torch.tensor(
        [rng.gauss(0.0, SETTINGS.object_tint_deviation) for _ in range(3)]
    )
    shift = view.mask * shift[None, :, None, None]
    without = rng.random() < SETTINGS.no_prior
    return replace(
        view,
        composite=view.composite * shift.exp(),
        log_ratio=torch.zeros_like(view.log_ratio) if without else view.log_ratio - shift,
        prior_confidence=torch.zeros(1) if without else view.prior_confidence,
    )


def _add_geometry_noise(view: CompactInput, rng: random.Random) -> CompactInput:
    """Add errors to normals and depth like those of a reconstruction."""
    generator = torch.Generator().manual_seed(rng.randrange(2**31))
    size = view.mask.shape[-2:]
    coarse = (max(2, size[0] // SETTINGS.geometry_noise_px), max(2, size[1] // SETTINGS.geometry_noise_px))
    noise = torch.randn(1, 4, *coarse, generator=generator) * rng.uniform(0, SETTINGS.max_geometry_noise)
    noise = F.interpolate(noise, size=size, mode="bilinear", align_corners=False)
    hit = (view.normal.abs().sum(1, keepdim=True) > 0).to(noise)
    normal = F.normalize(view.normal + noise[:, :3], dim=1) * hit
    return replace(view, normal=normal, depth=(view.depth + 0.1 * noise[:, 3:]).clamp(-2, 2))


def batch_inputs(views: list[CompactInput]) -> CompactInput:
    """Concatenate views of one size into a batch."""
    names = ("composite", "background", "mask", "log_ratio", "depth", "normal", "prior_confidence")
    return CompactInput(**{name: torch.cat([getattr(view, name) for view in views]) for name in names})
