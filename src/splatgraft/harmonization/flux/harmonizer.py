"""The harmoniser `flux`: a composite and its mask become a picture whose light agrees, in four steps (paper, Sec. 4).

Knows nothing about other views, scenes or where weights come from.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.harmonization.flux.detail import with_detail, with_material_held
from splatgraft.harmonization.flux.latents import pad_by_reflection
from splatgraft.harmonization.flux.network import FluxNetwork, velocity
from splatgraft.harmonization.flux.sampling import noise, sample, schnell_levels
from splatgraft.harmonization.interface import Harmonized, HarmonizerInputs


@dataclass(frozen=True)
class FluxSettings:
    """What the sampling and the composition are told."""

    seed: int = 0
    """Of the noise: the same for all views, so that they differ only in what they show."""
    steps: int = 4
    """Of the sampling."""
    strength: float = 1.0
    """How far the object's material may change; 0 only lets its light change."""
    detail: float = 0.0
    """How much of the picture is the composite under the model's light rather than the model's own pixels."""
    at_once: int = 1
    """Views per pass."""


class FluxHarmonizer:
    """The paper's image model behind the harmonisers' protocol."""

    def __init__(self, network: FluxNetwork, settings: FluxSettings) -> None:
        """A loaded network and what to do with it."""
        self.network, self.settings = network, settings
        self.views_at_once = settings.at_once

    def harmonize(self, view: HarmonizerInputs) -> Harmonized:
        """The harmonised picture of one view."""
        return self.harmonize_all([view])[0]

    def harmonize_all(self, views: Sequence[HarmonizerInputs]) -> list[Harmonized]:
        """Those of several views of one size, in one pass.

        Raises: ValueError where memory does not do or the network gives what is no number.
        """
        try:
            pictures = self._pictures(views)
        except torch.OutOfMemoryError as error:
            raise ValueError(
                f"harmonizer flux: expected memory for {len(views)} views at once, found too little; views that are "
                "done are kept: try --batch 1 or --precision fp8"
            ) from error
        return [Harmonized(self._finished(picture, view)) for picture, view in zip(pictures, views, strict=True)]

    @torch.no_grad()
    def _pictures(self, views: Sequence[HarmonizerInputs]) -> Float[Tensor, "b h w 3"]:
        net, (height, width) = self.network, views[0].composite.shape[:2]
        pictures = torch.cat([_stack([view.composite for view in views]), self._condition(views)])
        encoded = net.autoencoder.encode(pad_by_reflection(pictures).to(net.device))
        conditions = torch.cat(encoded.chunk(2), 1)
        b, _, h, w = conditions.shape
        start = noise((net.autoencoder.channels, h, w), self.settings.seed).to(net.device).expand(b, -1, -1, -1)

        def step(latents: Tensor, level: float) -> Tensor:
            joined = torch.cat([latents, conditions], 1).to(net.dtype)
            return velocity(net.transformer, joined, torch.full((b,), level, device=net.device), net.prompt)

        latents = sample(step, start, schnell_levels(self.settings.steps))
        if not bool(latents.isfinite().all()):
            raise ValueError(
                "harmonizer flux: expected finite latents, found NaN; are the weights whole, the precision enough?"
            )
        return net.autoencoder.decode(latents)[..., :height, :width].permute(0, 2, 3, 1).cpu()

    def _condition(self, views: Sequence[HarmonizerInputs]) -> Float[Tensor, "b 3 h w"]:
        if self.network.variant == "image-background":
            return _stack([view.background for view in views])
        # the network was shown binary masks
        return _stack([(view.mask > 0.5).float()[..., None].expand(-1, -1, 3) for view in views])

    def _finished(self, picture: Float[Tensor, "h w 3"], view: HarmonizerInputs) -> Float[Tensor, "h w 3"]:
        held = with_material_held(picture, view.composite, view.mask, strength=self.settings.strength)
        return with_detail(held, view.composite, amount=self.settings.detail)


def _stack(images: Sequence[Float[Tensor, "h w 3"]]) -> Float[Tensor, "b 3 h w"]:
    return torch.stack([image.permute(2, 0, 1) for image in images])
