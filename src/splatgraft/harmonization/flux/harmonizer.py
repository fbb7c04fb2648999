"""The harmoniser `flux`: FLUX conditioned on composite and mask, sampled in four steps (paper, Sec. 5)."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.harmonization.flux.network import FluxNetwork, pad_by_reflection, velocity
from splatgraft.harmonization.flux.sampling import noise, noisy, sample, schnell_levels
from splatgraft.harmonization.interface import HarmonizerInputs


class FluxHarmonizer:
    """The paper's image model as a harmoniser that can also start from a partly noisy image."""

    def __init__(self, network: FluxNetwork, *, seed: int = 0, steps: int = 4) -> None:
        """Use a loaded network; all views share the noise of `seed`."""
        self.network, self._seed, self._steps = network, seed, steps

    def harmonize(self, view: HarmonizerInputs) -> Float[Tensor, "h w 3"]:
        """Harmonise one view."""
        return self.harmonize_from(view, 1.0)

    @torch.no_grad()
    def harmonize_from(self, view: HarmonizerInputs, strength: float) -> Float[Tensor, "h w 3"]:
        """Harmonise one view, starting from its prior at the noise level `strength` in (0, 1].

        It takes z_t = (1 - t) z_prior + t eps with t = `strength`, then the steps from t to 0 (SDEdit, Meng et al.
        2022, in rectified flow). The condition is the composite at every level (paper, Iterative Dataset Update).
        """
        if not any(math.isclose(strength, prepared, abs_tol=1e-6) for prepared in self.network.strengths):
            prepared = ", ".join(f"{level:g}" for level in self.network.strengths)
            raise ValueError(f"harmonizer flux: expected to start at a noise level of {prepared}, found {strength:g}")
        try:
            return self._generate(view, strength)
        except torch.OutOfMemoryError as error:
            raise ValueError(
                "harmonizer flux: expected memory for a view, found too little; finished views are kept: try "
                "--precision fp8 or offload"
            ) from error

    def _generate(self, view: HarmonizerInputs, strength: float) -> Float[Tensor, "h w 3"]:
        net, (height, width) = self.network, view.composite.shape[:2]
        if net.variant == "image-background":
            condition = view.background
        else:  # the network was trained on binary masks
            condition = (view.mask > 0.5).float()[..., None].expand(-1, -1, 3)
        images = torch.stack([image.permute(2, 0, 1) for image in (view.composite, condition)])
        conditions = net.autoencoder.encode(pad_by_reflection(images).to(net.device)).flatten(0, 1)[None]
        h, w = conditions.shape[2:]
        start = noise((net.autoencoder.channels, h, w), self._seed).to(net.device)[None]
        if strength < 1:
            prior = pad_by_reflection(torch.stack([view.prior.permute(2, 0, 1)])).to(net.device)
            start = noisy(net.autoencoder.encode(prior), start, torch.tensor([strength], device=net.device))

        def step(latents: Tensor, level: float) -> Tensor:
            joined = torch.cat([latents, conditions], 1).to(net.dtype)
            return velocity(net.transformer, joined, torch.tensor([level], device=net.device), net.prompt)

        latents = sample(step, start, schnell_levels(self._steps, start=strength))
        if not bool(latents.isfinite().all()):
            raise ValueError(
                "harmonizer flux: expected finite latents, found NaN; check the weights, or try a higher --precision"
            )
        return net.autoencoder.decode(latents)[0, :, :height, :width].permute(1, 2, 0).cpu()
