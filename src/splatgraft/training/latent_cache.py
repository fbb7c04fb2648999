"""Latents of training pictures, encoded once and kept on disk. Knows nothing about what is trained on them."""

import hashlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.harmonization.flux.weights.tensor_file import read_tensors, write_tensors
from splatgraft.training.sources.pair_source import PairReference, Role, crop_pair_to_size

Encode = Callable[[Tensor], Tensor]
"""Pictures (b 3 h w) in [0, 1] to latents."""


@dataclass(frozen=True)
class LoadedPair:
    """What of one pair was read: latents where they were kept, else pictures."""

    latents: dict[str, Tensor]
    pictures: dict[str, Tensor]
    paths: dict[str, Path]


class LatentCache:
    """Latents by picture, of one autoencoder at one size, rounded to bfloat16 whether kept or fresh."""

    def __init__(self, folder: Path, encode: Encode, *, width: int, height: int, autoencoder: str) -> None:
        """`autoencoder` names the weights: another one has other latents."""
        self._folder, self._encode = folder, encode
        self._size, self._job = (width, height), f"{autoencoder}|{width}x{height}"

    def load(self, drawn: PairReference, roles: Sequence[Role]) -> LoadedPair:
        """What is kept of a pair's pictures, and the pictures of what is not.

        Raises: ValueError where a file is missing or broken.
        """
        paths = {role: self._path(drawn.source.key(drawn.index, role)) for role in roles}
        latents = {role: read_tensors(path)["latents"] for role, path in paths.items() if path.is_file()}
        missing = [role for role in roles if role not in latents]
        pictures: dict[str, Tensor] = {}
        if missing:
            pair = crop_pair_to_size(drawn.source.read(drawn.index), *self._size)
            pictures = {role: pair.picture(role).permute(2, 0, 1) for role in missing}
        return LoadedPair(latents, pictures, paths)

    def encode_missing(
        self, loaded: Sequence[LoadedPair], roles: Sequence[Role]
    ) -> dict[str, Float[Tensor, "b c h w"]]:
        """Latents of several pairs by role; what was missing is encoded and kept."""
        batch: dict[str, list[Tensor]] = {role: [] for role in roles}
        for item in loaded:
            for role in roles:
                latents = item.latents.get(role)
                if latents is None:
                    # one at a time: a batch would be rounded otherwise, and a run could not go on to the bit
                    latents = self._encode(item.pictures[role][None])[0].to("cpu", torch.bfloat16)
                    _keep(item.paths[role], latents)
                batch[role].append(latents.float())
        return {role: torch.stack(latents) for role, latents in batch.items()}

    def _path(self, key: str) -> Path:
        name = hashlib.sha256(f"{self._job}|{key}".encode()).hexdigest()
        return self._folder / name[:2] / f"{name}.safetensors"


def _keep(path: Path, latents: Float[Tensor, "c h w"]) -> None:
    """Write under a name of this process first: several may encode the same picture at once."""
    path.parent.mkdir(parents=True, exist_ok=True)
    own = path.with_name(f"{path.stem}-{os.getpid()}.safetensors")
    write_tensors(own, {"latents": latents})
    os.replace(own, path)
