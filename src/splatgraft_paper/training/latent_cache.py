"""A disk cache of the latents of training images."""

import hashlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.harmonization.flux.weights.tensor_file import read_tensors, write_tensors
from splatgraft_paper.training.sources.pair_source import PairReference, Role, crop_pair_to_size

Encode = Callable[[Tensor], Tensor]
"""Images (b 3 h w), sRGB in [0, 1], to latents."""


@dataclass(frozen=True)
class LoadedPair:
    """What was read of one pair, by role."""

    latents: dict[str, Tensor]
    """Latents that were in the cache."""
    pictures: dict[str, Tensor]
    """Images (3 h w) whose latents were not in the cache."""
    paths: dict[str, Path]
    """Cache file of each role."""


class LatentCache:
    """Latents by image, of one autoencoder at one size; rounded to bfloat16, also when they are newly encoded."""

    def __init__(self, folder: Path, encode: Encode, *, width: int, height: int, autoencoder: str) -> None:
        """Use the cache in `folder`.

        Args:
            folder: the cache.
            encode: the autoencoder.
            width: of the images, pixels.
            height: of the images, pixels.
            autoencoder: identifies its weights; part of the cache key.
        """
        self._folder, self._encode = folder, encode
        self._size, self._key_prefix = (width, height), f"{autoencoder}|{width}x{height}"

    def load(self, reference: PairReference, roles: Sequence[Role]) -> LoadedPair:
        """Read a pair's cached latents, and the images whose latents are missing.

        Raises:
            ValueError: a file is missing or broken.
        """
        paths = {role: self._path(reference.source.key(reference.index, role)) for role in roles}
        latents = {role: read_tensors(path)["latents"] for role, path in paths.items() if path.is_file()}
        missing = [role for role in roles if role not in latents]
        pictures: dict[str, Tensor] = {}
        if missing:
            pair = crop_pair_to_size(reference.source.read(reference.index), *self._size)
            pictures = {role: pair.picture(role).permute(2, 0, 1) for role in missing}
        return LoadedPair(latents, pictures, paths)

    def encode_missing(
        self, loaded: Sequence[LoadedPair], roles: Sequence[Role]
    ) -> dict[str, Float[Tensor, "b c h w"]]:
        """Batch the latents of several pairs by role; missing ones are encoded and written to the cache."""
        batch: dict[str, list[Tensor]] = {role: [] for role in roles}
        for item in loaded:
            for role in roles:
                latents = item.latents.get(role)
                if latents is None:
                    # one at a time: batches are rounded differently, and a resumed run would not be bit-identical
                    latents = self._encode(item.pictures[role][None])[0].to("cpu", torch.bfloat16)
                    _write_latents(item.paths[role], latents)
                batch[role].append(latents.float())
        return {role: torch.stack(latents) for role, latents in batch.items()}

    def _path(self, key: str) -> Path:
        name = hashlib.sha256(f"{self._key_prefix}|{key}".encode()).hexdigest()
        return self._folder / name[:2] / f"{name}.safetensors"


def _write_latents(path: Path, latents: Float[Tensor, "c h w"]) -> None:
    """Write to a temporary name of this process first: several processes may encode the same image at once."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.stem}-{os.getpid()}.safetensors")
    write_tensors(temporary, {"latents": latents})
    os.replace(temporary, path)
