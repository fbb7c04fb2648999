"""Training pairs, the protocol of their sources, and deterministic mixtures of sources.

The pair at a position of a mixture depends only on the seed and the position, so that a run can be resumed anywhere.
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
    """One training pair, sRGB in [0, 1]."""

    composite: Float[Tensor, "h w 3"]
    """The object under another light, pasted onto the scene without it (paper, Eq. 2)."""
    target: Float[Tensor, "h w 3"]
    """The object in the scene."""
    background: Float[Tensor, "h w 3"]
    """The scene without the object."""
    mask: Float[Tensor, "h w"]
    """Coverage of each pixel by the object, in [0, 1]."""

    def picture(self, role: str) -> Float[Tensor, "h w 3"]:
        """The image of a role; the mask is binary, with three equal channels, as networks take it."""
        if role == "mask":
            return (self.mask > 0.5).float()[..., None].expand(-1, -1, 3)
        return getattr(self, role)


@runtime_checkable
class PairSource(Protocol):
    """A collection of pairs on disk."""

    name: str
    """For messages and the log; part of the training's fingerprint."""

    def __len__(self) -> int: ...

    def group(self, index: int) -> str:
        """The pair's group, such as its scene; groups are held out as a whole."""
        ...

    def key(self, index: int, role: Role) -> str:
        """A unique key of an image, which changes when its file does."""
        ...

    def location(self, index: int) -> str:
        """The file that tells a pair from others, for messages."""
        ...

    def read(self, index: int) -> TrainingPair:
        """Read a pair.

        Raises:
            ValueError: a file is missing or broken.
        """
        ...


@dataclass(frozen=True)
class PairReference:
    """A pair of a source, by its index."""

    source: PairSource
    index: int


@dataclass(frozen=True)
class Mixture:
    """Several sources from which pairs are drawn by weight."""

    sources: tuple[PairSource, ...]
    weights: tuple[float, ...]
    """Relative, one per source."""
    indices: tuple[tuple[int, ...], ...]
    """The pairs of each source that belong to this mixture."""
    seed: int

    def draw(self, position: int) -> PairReference:
        """Draw the pair at a position of the infinite sequence; it depends only on seed and position."""
        rng = random.Random(f"{self.seed}-{position}")
        which = rng.choices(range(len(self.sources)), self.weights)[0]
        return PairReference(self.sources[which], rng.choice(self.indices[which]))

    def all(self) -> list[PairReference]:
        """List every pair once, alternating between sources."""
        longest = max(map(len, self.indices))
        pairs = zip(self.sources, self.indices, strict=True)
        listed = [(i, PairReference(source, index)) for source, own in pairs for i, index in enumerate(own)]
        return [drawn for _, drawn in sorted(listed, key=lambda pair: pair[0])][: longest * len(self.sources)]


def split_mixture(
    sources: Sequence[PairSource], *, weights: Sequence[float], held_out: float, seed: int
) -> tuple[Mixture, Mixture | None]:
    """Split sources into training and held-out pairs, by whole groups in the order of their names' hashes.

    Args:
        sources: of pairs.
        weights: relative, one per source; by the number of training pairs where empty.
        held_out: share of the groups of each source, at least one group; 0 holds out none.
        seed: of the drawing.

    Returns:
        The training mixture, and the held-out one or None where nothing is held out.

    Raises:
        ValueError: a source has no pair, or the weights do not fit.
    """
    if not sources or not all(map(len, sources)):
        empty = next((source.name for source in sources if not len(source)), "no source")
        raise ValueError(f"training data: expected pairs, found none in {empty}")
    if weights and (len(weights) != len(sources) or min(weights) < 0 or sum(weights) <= 0):
        raise ValueError(f"--weights: expected {len(sources)} numbers of at least 0, found {list(weights)}")
    training, validation = [], []
    for source in sources:
        groups = sorted({source.group(i) for i in range(len(source))}, key=_hash)
        count = max(1, round(held_out * len(groups))) if held_out > 0 and len(groups) > 1 else 0
        excluded = set(groups[:count])
        training.append(tuple(i for i in range(len(source)) if source.group(i) not in excluded))
        validation.append(tuple(i for i in range(len(source)) if source.group(i) in excluded))
    shares = tuple(weights) or tuple(float(len(indices)) for indices in training)
    train = Mixture(tuple(sources), shares, tuple(training), seed)
    used = [i for i, indices in enumerate(validation) if indices]
    if not used:
        return train, None
    held_out_mixture = Mixture(
        tuple(sources[i] for i in used), tuple(shares[i] for i in used), tuple(validation[i] for i in used), seed
    )
    return train, held_out_mixture


def crop_to_size(image: Float[Tensor, "h w *c"], width: int, height: int) -> Float[Tensor, "{height} {width} *c"]:
    """Resize to cover `width` x `height` pixels, then crop the centre."""
    h, w = image.shape[:2]
    scale = max(width / w, height / h)
    larger = resize(image, max(width, round(w * scale)), max(height, round(h * scale)))
    top, left = (larger.shape[0] - height) // 2, (larger.shape[1] - width) // 2
    return larger[top : top + height, left : left + width]


def crop_pair_to_size(pair: TrainingPair, width: int, height: int) -> TrainingPair:
    """Resize and crop all images of a pair, see `crop_to_size`."""
    images = (crop_to_size(image, width, height) for image in (pair.composite, pair.target, pair.background, pair.mask))
    return TrainingPair(*(torch.clamp(image, 0, 1) for image in images))


def sample_seed(seed: int, position: int) -> int:
    """Seed of the noise of the pair at a position; independent of the number of processes."""
    return int.from_bytes(hashlib.sha256(f"{seed}|{position}".encode()).digest()[:7], "big")


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
