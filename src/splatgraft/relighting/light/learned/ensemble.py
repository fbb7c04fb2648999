"""Several networks that agree on a correction of the light, and what they were trained on.

Each was trained without a part of the scenes. Their spread adds to the uncertainty, and a place unlike all that they
saw is corrected less: by the Mahalanobis distance of a short summary of its description.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.relighting.light.learned.network import (
    LightCorrection,
    LightNetwork,
    LightNetworkSize,
    network_inputs,
)
from splatgraft.relighting.light.place_description import PlaceDescription, cell_solid_angles
from splatgraft.relighting.light.radiance_correction import RatioShares, belief
from splatgraft.runtime.atomic_file import atomic_write

FORMAT = "splatgraft light network 3"
WEIGHTS_FILE = "light.safetensors"
_RIDGE = 0.02
"""Added to the variances of the summary: what hardly varied in training says little."""


@dataclass(frozen=True)
class SeenPlaces:
    """The distribution of s numbers that sum up a description, over the places of the training."""

    mean: Float[Tensor, "s"]
    precision: Float[Tensor, "s s"]
    """Inverse covariance."""
    farthest: float
    """Mahalanobis distance within which 99% of the places lie."""

    @staticmethod
    def of(inputs: Float[Tensor, "n f 12 24"]) -> "SeenPlaces":
        """Of the inputs of n places."""
        summaries = _summary(inputs)
        away = summaries - summaries.mean(0)
        covariance = away.T @ away / len(away) + _RIDGE * torch.eye(away.shape[1])
        precision = torch.linalg.inv(covariance)
        distances = ((away @ precision) * away).sum(1).sqrt()
        return SeenPlaces(summaries.mean(0), precision, float(distances.quantile(0.99)))

    def distance(self, inputs: Float[Tensor, "f 12 24"]) -> float:
        """Mahalanobis distance of a place from the mean, over `farthest`: above 1 it is unlike what was seen."""
        away = _summary(inputs[None])[0] - self.mean
        return float((away @ self.precision @ away).clamp_min(0).sqrt()) / max(self.farthest, 1e-6)


def _summary(inputs: Float[Tensor, "n f 12 24"]) -> Float[Tensor, "n f"]:
    areas = cell_solid_angles()
    return (inputs * areas).sum((2, 3)) / areas.sum()


@dataclass(frozen=True)
class LightEnsemble:
    """The networks in evaluation mode."""

    networks: tuple[LightNetwork, ...]
    seen: SeenPlaces
    shares: RatioShares
    """What a ratio of corrected lights was worth on scenes that were left out of training."""
    applied: float = 1.0
    """Share of a correction that came closest to the truth on those scenes, in [0, 1]."""
    sd_factors: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Their errors over what the networks said of them: factors on the three standard deviations of a correction."""

    @torch.no_grad()
    def correct(self, place: PlaceDescription) -> tuple[LightCorrection, float]:
        """The mean correction of a place (b = 1), weaker where the place is unlike what was seen.

        Returns:
            The correction, and the distance of the place: above 1 it is unlike the training's.
        """
        inputs = network_inputs(place)
        found = [network(inputs[None]).weakened(self.applied) for network in self.networks]
        distance = self.seen.distance(inputs)
        believed = belief(distance)
        gains, lamps = torch.stack([one.gain for one in found]), torch.stack([one.lamp.exp2() for one in found])
        areas = cell_solid_angles()
        levels = (gains.mean(-1) * areas).sum((2, 3)) / areas.sum()
        variance = torch.stack([one.log_sd.exp2() ** 2 for one in found]).mean(0)
        variance[:, 0] += levels.var(0, correction=0)
        whole = LightCorrection(
            gain=gains.mean(0),
            lamp=lamps.mean(0).log2(),
            log_sd=0.5 * variance.log2() + (torch.tensor(self.sd_factors) / believed).log2(),
        )
        return whole.weakened(believed), distance


def write_ensemble(path: Path, ensemble: LightEnsemble, notes: dict[str, str]) -> None:
    """Write networks as one safetensors file of half precision.

    Args:
        path: The .safetensors file.
        ensemble: The networks.
        notes: How they were trained, for the header.
    """
    from safetensors.torch import save

    tensors = {
        f"{i}.{name}": tensor.detach().to(torch.float16).contiguous()
        for i, network in enumerate(ensemble.networks)
        for name, tensor in network.state_dict().items()
    }
    seen = ensemble.seen
    tensors |= {
        "shares": torch.tensor([ensemble.shares.level, ensemble.shares.tint]),
        "applied": torch.tensor(ensemble.applied),
        "sd_factors": torch.tensor(ensemble.sd_factors),
        "seen.mean": seen.mean,
        "seen.precision": seen.precision.contiguous(),
        "seen.farthest": torch.tensor(seen.farthest),
    }
    size = ensemble.networks[0].size
    header = {"format": FORMAT, "channels": str(size.channels), "blocks": str(size.blocks)}
    header |= {"networks": str(len(ensemble.networks)), **notes}
    with atomic_write(path) as stream:
        stream.write(save(tensors, header))


@cache
def read_ensemble(path: Path) -> LightEnsemble:
    """Read what `write_ensemble` wrote; gradients off.

    Raises:
        ValueError: The file is missing, broken or holds something else.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), "pt") as file:
            header = file.metadata() or {}
            tensors = {name: file.get_tensor(name).float() for name in file.keys()}  # noqa: SIM118 not a dict
    except (OSError, SafetensorError) as error:
        raise ValueError(f"{path}: expected weights of the light network, found {error}") from error
    if header.get("format") != FORMAT:
        raise ValueError(f"{path}: expected '{FORMAT}' in its header, found {header.get('format')!r}")
    try:
        networks = []
        for i in range(int(header["networks"])):
            network = LightNetwork(LightNetworkSize(int(header["channels"]), int(header["blocks"])))
            prefix = f"{i}."
            network.load_state_dict(
                {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
            )
            networks.append(network.eval().requires_grad_(False))
        seen = SeenPlaces(tensors["seen.mean"], tensors["seen.precision"], float(tensors["seen.farthest"]))
        shares = RatioShares(*tensors["shares"].tolist())
        applied, (level, change, tint) = float(tensors["applied"]), tensors["sd_factors"].tolist()
    except (KeyError, ValueError, TypeError, RuntimeError) as error:
        found = str(error).splitlines()[0]
        raise ValueError(f"{path}: expected the tensors of the light network, found {found}") from error
    return LightEnsemble(tuple(networks), seen, shares, applied, (level, change, tint))
