"""Validation of a training objective on pairs: metrics, and a contact sheet of input, prediction and target."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.image_metrics import psnr, ssim
from splatgraft_paper.training.latent_cache import LatentCache
from splatgraft_paper.training.objective import Network, Objective
from splatgraft_paper.training.sources.pair_source import PairReference, TrainingPair, crop_pair_to_size


@dataclass(frozen=True)
class ValidationRun:
    """The pairs to validate on, and all that a prediction needs."""

    objective: Objective
    pairs: Sequence[PairReference]
    cache: LatentCache
    device: torch.device
    seed: int


@dataclass(frozen=True)
class ValidationResult:
    """Means over the pairs."""

    metrics: dict[str, float]
    """psnr, ssim, psnr_object, and psnr_input and psnr_object_input (those of the network's input, for comparison); dB
    but for ssim."""

    @property
    def sentence(self) -> str:
        """The metrics in one line of text."""
        m = self.metrics
        whole = f"PSNR {m['psnr']:.2f} dB (input {m['psnr_input']:.2f})"
        return f"{whole}, object {m['psnr_object']:.2f} (input {m['psnr_object_input']:.2f}), SSIM {m['ssim']:.3f}"


@torch.no_grad()
def validate(run: ValidationRun, network: Network) -> tuple[ValidationResult, Float[Tensor, "h w 3"]]:
    """Compute the metrics, and a contact sheet with one row per pair: input, prediction, target."""
    rows, totals = [], dict.fromkeys(("psnr", "ssim", "psnr_object", "psnr_input", "psnr_object_input"), 0.0)
    objective = run.objective
    for reference in run.pairs:
        loaded = run.cache.load(reference, objective.roles)
        latents = run.cache.encode_missing([loaded], objective.roles)
        latents = {role: tensor.to(run.device) for role, tensor in latents.items()}
        predicted = objective.predict(network, latents, run.seed)[0].permute(1, 2, 0).float().cpu()
        pair = crop_pair_to_size(reference.source.read(reference.index), predicted.shape[1], predicted.shape[0])
        target, source = pair.picture(objective.output_role), _input(pair, objective)
        inside = pair.mask > 0.5
        inside = inside if bool(inside.any()) else torch.ones_like(inside)
        totals["psnr"] += float(psnr(predicted, target))
        totals["ssim"] += float(ssim(predicted, target))
        totals["psnr_object"] += float(psnr(predicted, target, inside))
        totals["psnr_input"] += float(psnr(source, target))
        totals["psnr_object_input"] += float(psnr(source, target, inside))
        rows.append(torch.cat([source, predicted, target], 1))
    metrics = {name: round(total / len(run.pairs), 4) for name, total in totals.items()}
    return ValidationResult(metrics), torch.cat(rows, 0)


def _input(pair: TrainingPair, objective: Objective) -> Float[Tensor, "h w 3"]:
    return pair.composite if objective.output_role == "target" else pair.target
