"""The harmoniser `flux`: FLUX conditioned on composite and mask, sampled in four steps (paper, Sec. 5)."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.harmonization.flux.network import FluxNetwork, pad_by_reflection, velocity
from splatgraft.harmonization.flux.sampling import noise, noisy, sample, schnell_levels
from splatgraft.harmonization.interface import Harmonized, HarmonizerInputs
from splatgraft.harmonization.methods import FluxOptions


class FluxHarmonizer:
    """The paper's image model as a `BatchHarmonizer` and a `NoisyStartHarmonizer`."""

    def __init__(self, network: FluxNetwork, options: FluxOptions) -> None:
        """Use a loaded network with the seed, the steps and the batch of these options."""
        self.network, self._options = network, options
        self.views_at_once = options.batch

    def harmonize(self, view: HarmonizerInputs) -> Harmonized:
        """Harmonise one view.

        Raises:
            ValueError: Memory does not suffice, or the network's output is not finite.
        """
        return self.harmonize_all([view])[0]

    def harmonize_all(self, views: Sequence[HarmonizerInputs]) -> list[Harmonized]:
        """Harmonise several views of one size in one pass.

        Raises:
            ValueError: Memory does not suffice, or the network's output is not finite.
        """
        return self.harmonize_from(views, 1.0)

    def harmonize_from(self, views: Sequence[HarmonizerInputs], strength: float) -> list[Harmonized]:
        """Harmonise several views of one size in one pass, starting from their priors at a noise level.

        z_t = (1 - t) z_prior + t eps with t = `strength`, then the steps from t to 0 (SDEdit, Meng et al. 2022, in
        rectified flow). The condition is the composite at every level (paper, Iterative Dataset Update).

        Raises:
            ValueError: The network was not loaded for this level, memory does not suffice, or the network's output is
                not finite.
        """
        if not any(math.isclose(strength, prepared, abs_tol=1e-6) for prepared in self.network.strengths):
            prepared = ", ".join(f"{level:g}" for level in self.network.strengths)
            raise ValueError(f"harmonizer flux: expected to start at a noise level of {prepared}, found {strength:g}")
        try:
            return [Harmonized(image) for image in self._generate(views, strength)]
        except torch.OutOfMemoryError as error:
            raise ValueError(
                f"harmonizer flux: expected memory for {len(views)} views at once, found too little; finished views "
                "are kept: try --batch 1 or --precision fp8"
            ) from error

    @torch.no_grad()
    def _generate(self, views: Sequence[HarmonizerInputs], strength: float) -> Float[Tensor, "b h w 3"]:
        net, (height, width) = self.network, views[0].composite.shape[:2]
        images = torch.cat([_stack([view.composite for view in views]), self._condition(views)])
        encoded = net.autoencoder.encode(pad_by_reflection(images).to(net.device))
        conditions = torch.cat(encoded.chunk(2), 1)
        b, _, h, w = conditions.shape
        start = noise((net.autoencoder.channels, h, w), self._options.seed).to(net.device).expand(b, -1, -1, -1)
        if strength < 1:
            priors = pad_by_reflection(_stack([view.prior for view in views])).to(net.device)
            start = noisy(net.autoencoder.encode(priors), start, torch.full((b,), strength, device=net.device))

        def step(latents: Tensor, level: float) -> Tensor:
            joined = torch.cat([latents, conditions], 1).to(net.dtype)
            return velocity(net.transformer, joined, torch.full((b,), level, device=net.device), net.prompt)

        latents = sample(step, start, schnell_levels(self._options.sampling_steps, start=strength))
        if not bool(latents.isfinite().all()):
            raise ValueError(
                "harmonizer flux: expected finite latents, found NaN; check the weights, or try a higher --precision"
            )
        return net.autoencoder.decode(latents)[..., :height, :width].permute(0, 2, 3, 1).cpu()

    def _condition(self, views: Sequence[HarmonizerInputs]) -> Float[Tensor, "b 3 h w"]:
        if self.network.variant == "image-background":
            return _stack([view.background for view in views])
        # the network was trained on binary masks
        return _stack([(view.mask > 0.5).float()[..., None].expand(-1, -1, 3) for view in views])


def _stack(images: Sequence[Float[Tensor, "h w 3"]]) -> Float[Tensor, "b 3 h w"]:
    return torch.stack([image.permute(2, 0, 1) for image in images])
