"""Low-rank adaptation (LoRA) of FLUX: added for training, saved under diffusers' names, merged for inference.

W' = W + (alpha / rank) B A, with B = 0 at first (Hu et al. 2021).
"""

import math
from collections.abc import Iterable
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from splatgraft.harmonization.flux.weights.tensor_file import read_tensors, write_tensors

TARGETS = ("to_q", "to_k", "to_v", "to_out.0", "add_q_proj", "add_k_proj", "add_v_proj", "to_add_out", "proj_mlp")
"""Name endings of the attention layers of a FLUX transformer that are adapted."""
_FEED_FORWARD_TARGETS = ("ff.net.0.proj", "ff.net.2", "ff_context.net.0.proj", "ff_context.net.2")
_PREFIX = "transformer."


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
            named[f"{_PREFIX}{name}.weight"] = tensor
        elif name.startswith("x_embedder."):
            named[f"{_PREFIX}{name}"] = tensor
    write_tensors(path, named, about)


def merge_lora(network: nn.Module, path: Path, scale: float = 1.0) -> int:
    """Add the low-rank products of a file to the network's weights, in place.

    Layers that the file holds whole, such as the first one, replace those of `network`.

    Returns:
        The number of layers changed by low-rank products.

    Raises:
        ValueError: the file is broken or belongs to another network.
    """
    tensors = {name.removeprefix(_PREFIX): tensor for name, tensor in read_tensors(path).items()}
    layers = sorted({name.split(".lora_")[0] for name in tensors if ".lora_" in name})
    replaced = [name for name in tensors if ".lora_" not in name]
    if not layers:
        raise ValueError(f"{path}: expected a low-rank adaptation (.lora_A, .lora_B), found {_few(tensors)}")
    parameters = dict(network.named_parameters())
    with torch.no_grad():
        for name in replaced:
            _check_shape(path, name, parameters.get(name), tuple(tensors[name].shape))
            parameters[name].copy_(tensors[name])
        for name in layers:
            down, up = (tensors.get(f"{name}.lora_{part}.weight") for part in "AB")
            if down is None or up is None:
                raise ValueError(f"{path}: expected {name}.lora_A.weight and .lora_B.weight, found one of them")
            weight = parameters.get(f"{name}.weight")
            _check_shape(path, name, weight, (up.shape[0], down.shape[1]))
            weight.add_((scale * (up.float() @ down.float())).to(weight))  # pyright: ignore
    return len(layers)


def _check_shape(path: Path, name: str, found: Tensor | None, expected: tuple[int, ...]) -> None:
    shape = None if found is None else tuple(found.shape)
    if shape != expected:
        raise ValueError(f"{path}: expected a network whose {name} is {expected}, found {shape or 'no such layer'}")


def _few(names: Iterable[str]) -> str:
    return ", ".join(sorted(names)[:3]) or "nothing"
