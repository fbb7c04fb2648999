"""What every source of pairs gives, and how sources are mixed: by a rule, so that a run can go on anywhere.

Knows nothing about files or networks.
"""

import hashlib
import random
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, get_args, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.images import resize

Role = Literal["composite", "target", "background", "mask"]
ROLES: tuple[str, ...] = get_args(Role)


@dataclass(frozen=True)
class TrainingPair:
    """One pair, sRGB in [0, 1]."""

    composite: Float[Tensor, "h w 3"]
    """The object under other light, pasted on the scene without it (paper, Eq. 2)."""
    target: Float[Tensor, "h w 3"]
    """The object in the scene."""
    background: Float[Tensor, "h w 3"]
    """The scene without the object."""
    mask: Float[Tensor, "h w"]
    """How much of each pixel the object covers."""

    def picture(self, role: str) -> Float[Tensor, "h w 3"]:
        """One of its pictures; the mask as three equal channels, binary as the network is shown it."""
        if role == "mask":
            return (self.mask > 0.5).float()[..., None].expand(-1, -1, 3)
        return getattr(self, role)


@runtime_checkable
class PairSource(Protocol):
    """Pairs on disk."""

    name: str
    """For messages and the log."""

    def __len__(self) -> int: ...

    def group(self, index: int) -> str:
        """The scene of a pair: what is held out is held out by scenes."""
        ...

    def key(self, index: int, role: Role) -> str:
        """What tells one picture from all others, and changes when its files do."""
        ...

    def read(self, index: int) -> TrainingPair:
        """A pair.

        Raises: ValueError where a file is missing or broken.
        """
        ...


@dataclass(frozen=True)
class PairReference:
    """One pair of one source."""

    source: PairSource
    index: int


@dataclass(frozen=True)
class Mixture:
    """Several sources, drawn from by weight."""

    sources: tuple[PairSource, ...]
    weights: tuple[float, ...]
    """Relative; one a source."""
    indices: tuple[tuple[int, ...], ...]
    """Of each source's pairs, those that belong to this mixture."""
    seed: int

    def draw(self, position: int) -> PairReference:
        """The pair at a place in the endless order; independent of what was drawn before, and of who draws."""
        rng = random.Random(f"{self.seed}-{position}")
        which = rng.choices(range(len(self.sources)), self.weights)[0]
        return PairReference(self.sources[which], rng.choice(self.indices[which]))

    def all(self) -> list[PairReference]:
        """Every pair once, the sources taking turns."""
        longest = max(map(len, self.indices))
        pairs = zip(self.sources, self.indices, strict=True)
        listed = [(i, PairReference(source, index)) for source, own in pairs for i, index in enumerate(own)]
        return [drawn for _, drawn in sorted(listed, key=lambda pair: pair[0])][: longest * len(self.sources)]


def split_mixture(
    sources: Sequence[PairSource], *, weights: Sequence[float], held_out: float, seed: int
) -> tuple[Mixture, Mixture | None]:
    """What is trained on and what is held out: whole scenes, by the hash of their names, one at least of each source.

    None where no source has two scenes or `held_out` is 0. Sources weigh as `weights` says, or by their numbers.

    Raises: ValueError where there is no pair, or the weights do not fit.
    """
    if not sources or not all(map(len, sources)):
        empty = next((source.name for source in sources if not len(source)), "no source")
        raise ValueError(f"training data: expected pairs, found none in {empty}")
    if weights and (len(weights) != len(sources) or min(weights) < 0 or sum(weights) <= 0):
        raise ValueError(f"--weights: expected {len(sources)} numbers of at least 0, found {list(weights)}")
    trained, kept = [], []
    for source in sources:
        groups = sorted({source.group(i) for i in range(len(source))}, key=_hash)
        count = max(1, round(held_out * len(groups))) if held_out > 0 and len(groups) > 1 else 0
        out = set(groups[:count])
        trained.append(tuple(i for i in range(len(source)) if source.group(i) not in out))
        kept.append(tuple(i for i in range(len(source)) if source.group(i) in out))
    chosen = tuple(weights) or tuple(float(len(own)) for own in trained)
    train = Mixture(tuple(sources), chosen, tuple(trained), seed)
    there = [i for i, own in enumerate(kept) if own]
    if not there:
        return train, None
    validation = Mixture(
        tuple(sources[i] for i in there), tuple(chosen[i] for i in there), tuple(kept[i] for i in there), seed
    )
    return train, validation


def crop_to_size(image: Float[Tensor, "h w *c"], width: int, height: int) -> Float[Tensor, "{height} {width} *c"]:
    """The picture at another size, its middle where the shapes differ."""
    h, w = image.shape[:2]
    scale = max(width / w, height / h)
    larger = resize(image, max(width, round(w * scale)), max(height, round(h * scale)))
    top, left = (larger.shape[0] - height) // 2, (larger.shape[1] - width) // 2
    return larger[top : top + height, left : left + width]


def crop_pair_to_size(pair: TrainingPair, width: int, height: int) -> TrainingPair:
    """All pictures of a pair at one size."""
    images = (crop_to_size(image, width, height) for image in (pair.composite, pair.target, pair.background, pair.mask))
    return TrainingPair(*(torch.clamp(image, 0, 1) for image in images))


def sample_seed(seed: int, position: int) -> int:
    """Of the noise of the pair at a place in the order; the same on any number of machines."""
    return int.from_bytes(hashlib.sha256(f"{seed}|{position}".encode()).digest()[:7], "big")


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
