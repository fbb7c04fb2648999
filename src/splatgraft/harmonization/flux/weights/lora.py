"""Low-rank adaptations: added for training, saved under the names that diffusers reads, merged for use. No network.

W' = W + (alpha / rank) B A, with B = 0 at first (Hu et al. 2021).
"""

import math
from collections.abc import Iterable
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from splatgraft.harmonization.flux.weights.library import read_tensors, write_tensors

TARGETS = ("to_q", "to_k", "to_v", "to_out.0", "add_q_proj", "add_k_proj", "add_v_proj", "to_add_out", "proj_mlp")
"""Last parts of the names of the layers of a FLUX transformer that are adapted, with feed-forward and proj_out."""
_MORE_TARGETS = ("ff.net.0.proj", "ff.net.2", "ff_context.net.0.proj", "ff_context.net.2")
_PREFIX = "transformer."


class LowRankLinear(nn.Module):
    """A linear layer that stays as it was, plus a product of two thin ones that learns."""

    def __init__(self, layer: nn.Linear, rank: int, generator: torch.Generator) -> None:
        """`rank`: columns of the thin layers."""
        super().__init__()
        self.layer = layer.requires_grad_(False)
        bound = 1 / math.sqrt(layer.in_features)
        down = torch.empty(rank, layer.in_features).uniform_(-bound, bound, generator=generator)
        self.lora_A = nn.Parameter(down.to(layer.weight.device))
        self.lora_B = nn.Parameter(torch.zeros(layer.out_features, rank, device=layer.weight.device))

    def forward(self, x: Float[Tensor, "*n i"]) -> Float[Tensor, "*n o"]:
        """The layer's output with the adaptation."""
        return self.layer(x) + ((x.to(self.lora_A.dtype) @ self.lora_A.T) @ self.lora_B.T).to(x.dtype)


def is_target(name: str) -> bool:
    """Whether the linear layer of that name is adapted: attention and feed-forward of all blocks."""
    if "blocks." not in name:
        return False
    return name.endswith((*TARGETS, *_MORE_TARGETS)) or (name.startswith("single_") and name.endswith("proj_out"))


def add_lora(network: nn.Module, rank: int, *, seed: int = 0) -> int:
    """Freeze `network` but for thin layers of rank `rank`, put beside its linear layers; returns how many.

    The first layer, which is new where it was widened, goes on learning whole.
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
    """Write what of a network's state learns: the thin layers (the names of diffusers and PEFT) and the first layer."""
    named = {}
    for name, tensor in state.items():
        if name.endswith(("lora_A", "lora_B")):
            named[f"{_PREFIX}{name}.weight"] = tensor
        elif name.startswith("x_embedder."):
            named[f"{_PREFIX}{name}"] = tensor
    write_tensors(path, named, about)


def merge_lora(network: nn.Module, path: Path, scale: float = 1.0) -> int:
    """Add an adaptation's products to the weights; returns how many layers changed.

    The file must hold the first layer too where that is wider than `network`'s.

    Raises: ValueError where the file is broken or belongs to another network.
    """
    tensors = {name.removeprefix(_PREFIX): tensor for name, tensor in read_tensors(path).items()}
    layers = sorted({name.split(".lora_")[0] for name in tensors if ".lora_" in name})
    whole = [name for name in tensors if ".lora_" not in name]
    if not layers:
        raise ValueError(f"{path}: expected a low-rank adaptation (.lora_A, .lora_B), found {_few(tensors)}")
    parameters = dict(network.named_parameters())
    with torch.no_grad():
        for name in whole:
            _same_shape(path, name, parameters.get(name), tuple(tensors[name].shape))
            parameters[name].copy_(tensors[name])
        for name in layers:
            down, up = (tensors.get(f"{name}.lora_{part}.weight") for part in "AB")
            if down is None or up is None:
                raise ValueError(f"{path}: expected {name}.lora_A.weight and .lora_B.weight, found one of them")
            weight = parameters.get(f"{name}.weight")
            _same_shape(path, name, weight, (up.shape[0], down.shape[1]))
            weight.add_((scale * (up.float() @ down.float())).to(weight))  # pyright: ignore
    return len(layers)


def _same_shape(path: Path, name: str, found: Tensor | None, wanted: tuple[int, ...]) -> None:
    shape = None if found is None else tuple(found.shape)
    if shape != wanted:
        raise ValueError(f"{path}: expected a network whose {name} is {wanted}, found {shape or 'no such layer'}")


def _few(names: Iterable[str]) -> str:
    return ", ".join(sorted(names)[:3]) or "nothing"
