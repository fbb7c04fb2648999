"""Random augmentation of training views: crop, mirror, exposure and colour of the light, errors of the geometry."""

import math
import random
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from splatgraft.harmonization.compact.features import CompactInput

Crop = tuple[int, int, int, int]
"""Top, left, height, width, pixels."""


@dataclass(frozen=True)
class Augmentation:
    """Distributions of the augmentation, set by hand. A log factor of x is a factor of e^x."""

    min_object_margin: float = 2.0
    """Smallest crop, as a multiple of the object's extent."""
    min_crop: float = 0.4
    """Smallest crop, as a share of the largest that fits the image."""
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
    """Largest standard deviation of the errors added to normals; a tenth of them is added to the log depth."""
    geometry_noise_px: int = 8
    """Pixels over which these errors are alike."""


SETTINGS = Augmentation()


def augment(
    view: CompactInput, target: Float[Tensor, "1 3 h w"], size: tuple[int, int], seed: str
) -> tuple[CompactInput, Float[Tensor, "1 3 i j"]]:
    """Augment a training view.

    Args:
        view: a batch of one.
        target: the ground truth, linear light.
        size: height and width of the result, pixels.
        seed: determines the augmentation.

    Returns:
        View and target at `size`; the crop contains the whole object.
    """
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
    """A crop with the aspect ratio of `size` that contains the whole object."""
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
    """Permute and scale the channels of all light, so that the network cannot recognise scenes by their colours."""
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
    """Scale the composite's object; the log ratio changes inversely, so that the prior stays the same."""
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
    """Add errors to normals and depth, as a reconstruction has."""
    generator = torch.Generator().manual_seed(rng.randrange(2**31))
    size = view.mask.shape[-2:]
    coarse = (max(2, size[0] // SETTINGS.geometry_noise_px), max(2, size[1] // SETTINGS.geometry_noise_px))
    noise = torch.randn(1, 4, *coarse, generator=generator) * rng.uniform(0, SETTINGS.max_geometry_noise)
    noise = F.interpolate(noise, size=size, mode="bilinear", align_corners=False)
    hit = (view.normal.abs().sum(1, keepdim=True) > 0).to(noise)
    normal = F.normalize(view.normal + noise[:, :3], dim=1) * hit
    return replace(view, normal=normal, depth=(view.depth + 0.1 * noise[:, 3:]).clamp(-2, 2))


def batch_inputs(views: list[CompactInput]) -> CompactInput:
    """Concatenate views of one size to a batch."""
    names = ("composite", "background", "mask", "log_ratio", "depth", "normal", "prior_confidence")
    return CompactInput(**{name: torch.cat([getattr(view, name) for view in views]) for name in names})
