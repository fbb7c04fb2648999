"""Views cut, mirrored and spoilt at random, as captures spoil them; all from one seed. Knows no network."""

import math
import random
from dataclasses import replace

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from splatgraft.harmonization.compact.features import CompactInput

Cut = tuple[int, int, int, int]
"""Top, left, height, width."""
_NO_PRIOR = 0.08


def augment(
    view: CompactInput, target: Float[Tensor, "1 3 h w"], size: tuple[int, int], seed: str
) -> tuple[CompactInput, Float[Tensor, "1 3 i j"]]:
    """A cut around the object at `size` (height, width), mirrored half of the time, with another exposure and doubt."""
    rng = random.Random(seed)
    top, left, height, width = _cut(view.mask[0, 0], size, rng)

    def cropped(x: Tensor) -> Tensor:
        piece = x[..., top : top + height, left : left + width]
        return F.interpolate(piece, size=size, mode="bilinear", antialias=True, align_corners=False)

    names = ("composite", "background", "mask", "log_ratio", "depth", "normal")
    pictures = {name: cropped(getattr(view, name)) for name in names}
    target = cropped(target)
    if rng.random() < 0.5:
        pictures = {name: x.flip(-1) for name, x in pictures.items()}
        target = target.flip(-1)
        pictures["normal"] = pictures["normal"] * torch.tensor([-1.0, 1, 1])[:, None, None]
    out, target = _another_world(CompactInput(**pictures, prior_confidence=view.prior_confidence), target, rng)
    return _another_exposure(_rough(out, rng), rng), target


def _cut(mask: Float[Tensor, "h w"], size: tuple[int, int], rng: random.Random) -> Cut:
    """A part of the picture with the whole object, of the shape of `size`."""
    h, w = mask.shape
    rows, columns = (mask > 0.05).any(1).nonzero()[:, 0], (mask > 0.05).any(0).nonzero()[:, 0]
    tall, wide = int(rows[-1] - rows[0]) + 1, int(columns[-1] - columns[0]) + 1
    aspect = size[1] / size[0]
    largest = min(h, w / aspect)
    smallest = min(largest, max(2.0 * max(tall, wide / aspect), 0.4 * largest))
    height = round(rng.uniform(smallest, largest))
    width = min(w, round(height * aspect))

    def place(first: int, length: int, cut: int, whole: int) -> int:
        low, high = max(0, first + length - cut), min(first, whole - cut)
        return rng.randint(low, high) if low <= high else max(0, min(whole - cut, (low + high) // 2))

    return place(int(rows[0]), tall, height, h), place(int(columns[0]), wide, width, w), height, width


def _another_world(view: CompactInput, target: Tensor, rng: random.Random) -> tuple[CompactInput, Tensor]:
    """All light of other colours and strength: a scene is not to be known again by its colours."""
    order = rng.sample(range(3), 3)
    gain = math.exp(rng.gauss(0.0, 0.25)) * torch.tensor([math.exp(rng.gauss(0.0, 0.12)) for _ in range(3)])

    def changed(x: Tensor) -> Tensor:
        return x[:, order] * gain[:, None, None]

    swapped = view.log_ratio[:, order]
    composite, background = changed(view.composite), changed(view.background)
    return replace(view, composite=composite, background=background, log_ratio=swapped), changed(target)


def _another_exposure(view: CompactInput, rng: random.Random) -> CompactInput:
    """The object brighter or tinted; the prior, which knows the old light, takes that back."""
    shift = rng.gauss(0.0, 0.35) + torch.tensor([rng.gauss(0.0, 0.06) for _ in range(3)])
    shift = view.mask * shift[None, :, None, None]
    without = rng.random() < _NO_PRIOR
    return replace(
        view,
        composite=view.composite * shift.exp(),
        log_ratio=torch.zeros_like(view.log_ratio) if without else view.log_ratio - shift,
        prior_confidence=torch.zeros(1) if without else view.prior_confidence,
    )


def _rough(view: CompactInput, rng: random.Random) -> CompactInput:
    """Normals and depth as a reconstruction has them."""
    generator = torch.Generator().manual_seed(rng.randrange(2**31))
    size = view.mask.shape[-2:]
    coarse = (max(2, size[0] // 8), max(2, size[1] // 8))
    noise = torch.randn(1, 4, *coarse, generator=generator) * rng.uniform(0, 0.25)
    noise = F.interpolate(noise, size=size, mode="bilinear", align_corners=False)
    there = (view.normal.abs().sum(1, keepdim=True) > 0).to(noise)
    normal = F.normalize(view.normal + noise[:, :3], dim=1) * there
    return replace(view, normal=normal, depth=(view.depth + 0.1 * noise[:, 3:]).clamp(-2, 2))


def batch_inputs(views: list[CompactInput]) -> CompactInput:
    """Views of one size as one batch."""
    names = ("composite", "background", "mask", "log_ratio", "depth", "normal", "prior_confidence")
    return CompactInput(**{name: torch.cat([getattr(view, name) for view in views]) for name in names})
