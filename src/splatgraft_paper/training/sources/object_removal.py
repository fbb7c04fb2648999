"""Removes an object from an image by the network of `train removal` (paper, Sec. 5.2)."""

from collections.abc import Callable
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.harmonization.flux.latents import pad_by_reflection
from splatgraft_paper.training.removal_objective import RemovalObjective

_MULTIPLE = 64
"""Pixels: 8 of the autoencoder times 8 of the UNet."""


class ObjectRemover:
    """A loaded removal network."""

    def __init__(self, weights: Path, device: torch.device, say: Callable[[str], None], *, seed: int = 0) -> None:
        """Load the folder that `train removal` wrote; `seed` is that of the initial noise.

        Raises:
            ValueError: the folder holds no removal network.
        """
        self._objective = RemovalObjective(str(weights), say, checkpointing=False)
        self._objective.network.to(device).eval().requires_grad_(False)
        self._objective.to(device)
        self._device, self._seed = device, seed

    @torch.no_grad()
    def remove(self, image: Float[Tensor, "h w 3"], mask: Float[Tensor, "h w"]) -> Float[Tensor, "h w 3"]:
        """Remove the object and its shadow.

        Pixels inside the mask are the network's. Elsewhere the network's change is added to the image, so that
        background and target do not differ by the autoencoder's blur.
        """
        height, width = mask.shape
        binary = (mask > 0.5).float()[..., None].expand(-1, -1, 3)
        images = torch.stack([image, binary]).permute(0, 3, 1, 2)
        latents = self._objective.encode(pad_by_reflection(images, _MULTIPLE).to(self._device))
        removed = self._objective.predict(
            self._objective.network, {"target": latents[:1], "mask": latents[1:]}, self._seed
        )
        decoded = self._objective.autoencoder.decode(latents[:1])
        removed, decoded = (x[0, :, :height, :width].permute(1, 2, 0).cpu() for x in (removed, decoded))
        return torch.where(binary > 0, removed, image + removed - decoded).clamp(0, 1)
