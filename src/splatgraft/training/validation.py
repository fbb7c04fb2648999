"""What a network makes of some pairs: figures, and a sheet of pictures to look at. Knows no loop and no files."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from splatgraft.core.image_metrics import psnr, ssim
from splatgraft.training.latent_cache import LatentCache
from splatgraft.training.objective import Objective
from splatgraft.training.sources.pair_source import PairReference, TrainingPair, crop_pair_to_size


@dataclass(frozen=True)
class ValidationRun:
    """What is asked."""

    objective: Objective
    pairs: Sequence[PairReference]
    cache: LatentCache
    device: torch.device
    seed: int


@dataclass(frozen=True)
class ValidationResult:
    """Means over the pairs."""

    numbers: dict[str, float]
    """psnr, ssim, psnr_object, and psnr_input: that of the network's input, which it must beat."""

    @property
    def sentence(self) -> str:
        """For the person who waits."""
        n = self.numbers
        whole = f"PSNR {n['psnr']:.2f} dB (input {n['psnr_input']:.2f})"
        return f"{whole}, object {n['psnr_object']:.2f}, SSIM {n['ssim']:.3f}"


@torch.no_grad()
def validate(asked: ValidationRun, network: nn.Module) -> tuple[ValidationResult, Float[Tensor, "h w 3"]]:
    """Figures and a sheet: per pair its input, what the network made, what it should be."""
    rows, totals = [], {"psnr": 0.0, "ssim": 0.0, "psnr_object": 0.0, "psnr_input": 0.0}
    objective = asked.objective
    for drawn in asked.pairs:
        loaded = asked.cache.load(drawn, objective.roles)
        latents = asked.cache.encode_missing([loaded], objective.roles)
        latents = {role: tensor.to(asked.device) for role, tensor in latents.items()}
        made = objective.predict(network, latents, asked.seed)[0].permute(1, 2, 0).float().cpu()
        pair = crop_pair_to_size(drawn.source.read(drawn.index), made.shape[1], made.shape[0])
        wanted, given = pair.picture(objective.shown), _input(pair, objective)
        inside = pair.mask > 0.5
        totals["psnr"] += float(psnr(made, wanted))
        totals["ssim"] += float(ssim(made, wanted))
        totals["psnr_object"] += float(psnr(made, wanted, inside)) if bool(inside.any()) else float(psnr(made, wanted))
        totals["psnr_input"] += float(psnr(given, wanted))
        rows.append(torch.cat([given, made, wanted], 1))
    numbers = {name: round(total / len(asked.pairs), 4) for name, total in totals.items()}
    return ValidationResult(numbers), torch.cat(rows, 0)


def _input(pair: TrainingPair, objective: Objective) -> Float[Tensor, "h w 3"]:
    return pair.composite if objective.shown == "target" else pair.target
