"""Takes an object out of a picture with the network that `train removal` makes. Knows no training loop."""

from collections.abc import Callable
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.harmonization.flux.latents import pad_by_reflection
from splatgraft.training.removal_objective import RemovalObjective

_MULTIPLE = 64
"""Pixels: eight of the autoencoder times eight of the UNet."""


class ObjectRemover:
    """A loaded network."""

    def __init__(self, weights: Path, device: torch.device, say: Callable[[str], None], *, seed: int = 0) -> None:
        """Load the folder that `train removal` wrote.

        Raises: ValueError where it holds none.
        """
        self._objective = RemovalObjective(str(weights), say, checkpointing=False)
        self._objective.network.to(device).eval().requires_grad_(False)
        self._objective.to(device)
        self._device, self._seed = device, seed

    @torch.no_grad()
    def remove(self, image: Float[Tensor, "h w 3"], mask: Float[Tensor, "h w"]) -> Float[Tensor, "h w 3"]:
        """The picture without the object and its shadow.

        Inside the mask the network's pixels; elsewhere the picture's own plus the network's change, so that the
        autoencoder's blur does not tell background from target.
        """
        height, width = mask.shape
        binary = (mask > 0.5).float()[..., None].expand(-1, -1, 3)
        given = torch.stack([image, binary]).permute(0, 3, 1, 2)
        latents = self._objective.encode(pad_by_reflection(given, _MULTIPLE).to(self._device))
        made = self._objective.predict(
            self._objective.network, {"target": latents[:1], "mask": latents[1:]}, self._seed
        )
        same = self._objective.autoencoder.decode(latents[:1])
        made, same = (x[0, :, :height, :width].permute(1, 2, 0).cpu() for x in (made, same))
        return torch.where(binary > 0, made, image + made - same).clamp(0, 1)
