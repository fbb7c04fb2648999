"""Low-rank adaptation (LoRA) of FLUX: added for training, saved under diffusers' names, merged for inference.

W' = W + (alpha / rank) B A, with B = 0 at first (Hu et al. 2021). Adaptations trained here have alpha = rank.
"""

import math
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from splatgraft.harmonization.flux.weights.lora_file import PREFIX, LowRankFile
from splatgraft.harmonization.flux.weights.tensor_file import write_tensors

TARGETS = ("to_q", "to_k", "to_v", "to_out.0", "add_q_proj", "add_k_proj", "add_v_proj", "to_add_out", "proj_mlp")
"""Name endings of the attention layers of a FLUX transformer that are adapted."""
_FEED_FORWARD_TARGETS = ("ff.net.0.proj", "ff.net.2", "ff_context.net.0.proj", "ff_context.net.2")


class LowRankLinear(nn.Module):
    """A frozen linear layer plus the product of two trainable low-rank matrices."""

    def __init__(self, layer: nn.Linear, rank: int, generator: torch.Generator) -> None:
        """Freeze `layer` and add matrices of rank `rank`; A is drawn from `generator`, B is zero."""
        super().__init__()
        self.layer = layer.requires_grad_(False)
        bound = 1 / math.sqrt(layer.in_features)
        down = torch.empty(rank, layer.in_features).uniform_(-bound, bound, generator=generator)
        self.lora_A = nn.Parameter(down.to(layer.weight.device))
        self.lora_B = nn.Parameter(torch.zeros(layer.out_features, rank, device=layer.weight.device))

    def forward(self, x: Float[Tensor, "*n i"]) -> Float[Tensor, "*n o"]:
        """Return the layer's output plus the low-rank product."""
        return self.layer(x) + ((x.to(self.lora_A.dtype) @ self.lora_A.T) @ self.lora_B.T).to(x.dtype)


def is_target(name: str) -> bool:
    """Whether the linear layer called `name` is adapted: attention and feed-forward layers of all blocks."""
    if "blocks." not in name:
        return False
    return name.endswith((*TARGETS, *_FEED_FORWARD_TARGETS)) or (
        name.startswith("single_") and name.endswith("proj_out")
    )


def add_lora(network: nn.Module, rank: int, *, seed: int = 0) -> int:
    """Freeze `network` and add trainable low-rank matrices to its linear layers, in place.

    All weights of the first layer stay trainable, since it is new where it was widened.

    Returns:
        The number of adapted layers.
    """
    network.requires_grad_(False)
    generator = torch.Generator().manual_seed(seed)
    names = [name for name, module in network.named_modules() if isinstance(module, nn.Linear) and is_target(name)]
    for name in names:
        parent, _, last = name.rpartition(".")
        owner = network.get_submodule(parent)
        setattr(owner, last, LowRankLinear(owner.get_submodule(last), rank, generator))  # pyright: ignore
    network.get_submodule("x_embedder").requires_grad_(True)
    return len(names)


def write_lora(path: Path, state: dict[str, Tensor], about: dict[str, str]) -> None:
    """Write the trained part of a network's state: the low-rank matrices and the first layer, in diffusers' names."""
    named = {}
    for name, tensor in state.items():
        if name.endswith(("lora_A", "lora_B")):
            named[f"{PREFIX}{name}.weight"] = tensor
        elif name.startswith("x_embedder."):
            named[f"{PREFIX}{name}"] = tensor
    write_tensors(path, named, about)


def merge_lora(network: nn.Module, lora: LowRankFile) -> int:
    """Add an adaptation to the network's weights, in place.

    Parameters that the file holds whole, such as those of a widened first layer, replace the network's. Nothing is
    changed where anything does not fit.

    Returns:
        The number of layers changed by low-rank products.

    Raises:
        ValueError: the adaptation belongs to another network.
    """
    parameters = dict(network.named_parameters())
    for name, tensor in lora.whole.items():
        _check_shape(lora.path, name, parameters.get(name), tuple(tensor.shape))
    for name, update in lora.updates.items():
        _check_shape(lora.path, name, parameters.get(f"{name}.weight"), update.shape)
        if update.bias is not None:
            _check_shape(lora.path, f"{name}.bias", parameters.get(f"{name}.bias"), tuple(update.bias.shape))
    with torch.no_grad():
        for name, tensor in lora.whole.items():
            parameters[name].copy_(tensor)
        for name, update in lora.updates.items():
            weight = parameters[f"{name}.weight"]
            weight.add_(update.weight.to(weight))
            if update.bias is not None:
                bias = parameters[f"{name}.bias"]
                bias.add_((update.scale * update.bias.float()).to(bias))
    return len(lora.updates)


def _check_shape(path: Path, name: str, found: Tensor | None, expected: tuple[int, ...]) -> None:
    shape = None if found is None else tuple(found.shape)
    if shape != expected:
        raise ValueError(f"{path}: expected a network whose {name} is {expected}, found {shape or 'no such layer'}")
