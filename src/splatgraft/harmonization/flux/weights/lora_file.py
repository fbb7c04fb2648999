"""Reads low-rank adaptations of FLUX as PEFT and diffusers read them: matrices, their scales, layers stored whole.

A scale is alpha / rank, or alpha / sqrt(rank) with rank-stabilised adaptations (Kalajdzievski 2023). Alpha stands in
the header (`lora_adapter_metadata`, written by diffusers' training scripts), or in tensors LAYER.alpha, or is the rank.
"""

import json
import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from splatgraft.harmonization.flux.weights.diffusers_library import flux_lora_names
from splatgraft.harmonization.flux.weights.tensor_file import read_metadata, read_tensors

PREFIX = "transformer."
_METADATA_KEY = "lora_adapter_metadata"
_OTHER_NAMES = (".lora_down.weight", "processor", "query_norm.scale")
"""Parts of tensor names in the files of kohya's scripts, XLabs and Black Forest Labs; diffusers renames them."""
_OTHER_KINDS = ("lora_magnitude_vector", "dora_scale", ".lokr_", ".hada_")
"""Parts of tensor names of DoRA, LoKr and LoHa, which are no sums of a weight and a low-rank product."""
_PEFT_ALPHA = 8
"""PEFT's default where a header has none."""


@dataclass(frozen=True)
class LowRankUpdate:
    """What is added to one linear layer."""

    down: Float[Tensor, "r i"]
    """A."""
    up: Float[Tensor, "o r"]
    """B."""
    bias: Float[Tensor, " o"] | None
    """Added to the layer's bias, with the same scale."""
    scale: float

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of the weight that it belongs to."""
        return self.up.shape[0], self.down.shape[1]

    @property
    def weight(self) -> Float[Tensor, "o i"]:
        """The scaled product, float32."""
        return self.scale * (self.up.float() @ self.down.float())


@dataclass(frozen=True)
class LowRankFile:
    """The content of one file."""

    path: Path
    updates: Mapping[str, LowRankUpdate]
    """By name of the layer in the transformer."""
    whole: Mapping[str, Tensor]
    """Parameters of the transformer that the file holds whole."""
    unused: int
    """Tensors of text encoders, which the precomputed prompt makes useless."""


def read_lora(path: Path) -> LowRankFile:
    """Read a low-rank adaptation.

    Raises:
        ValueError: the file is broken, of another kind, or incomplete.
    """
    tensors = read_tensors(path)
    other = next((name for name in tensors if any(kind in name for kind in _OTHER_KINDS)), None)
    if other is not None:
        raise ValueError(f"{path}: expected a low-rank adaptation (.lora_A, .lora_B), found {other}, of another kind")
    if any(part in name for name in tensors for part in _OTHER_NAMES):
        tensors = flux_lora_names(path, tensors)
    unused = [name for name in tensors if name.startswith("text_encoder")]
    ours = {name.removeprefix(PREFIX): tensor for name, tensor in tensors.items() if name not in unused}
    layers = sorted({name.split(".lora_")[0] for name in ours if ".lora_" in name})
    if not layers:
        raise ValueError(f"{path}: expected a low-rank adaptation (.lora_A, .lora_B), found {_few(tensors)}")
    alphas = {name.removesuffix(".alpha"): float(ours[name]) for name in ours if name.endswith(".alpha")}
    scales = _scales(path, {name: ours.get(f"{name}.lora_A.weight") for name in layers}, alphas)
    updates = {}
    for name in layers:
        down, up = (ours.get(f"{name}.lora_{part}.weight") for part in "AB")
        if down is None or up is None:
            raise ValueError(f"{path}: expected {name}.lora_A.weight and .lora_B.weight, found one of them")
        if down.ndim != 2 or up.ndim != 2 or down.shape[0] != up.shape[1]:
            raise ValueError(
                f"{path}: expected {name}.lora_A.weight (rank, in) and .lora_B.weight (out, rank), found "
                f"{tuple(down.shape)} and {tuple(up.shape)}"
            )
        updates[name] = LowRankUpdate(down, up, ours.get(f"{name}.lora_B.bias"), scales[name])
    whole = {name: tensor for name, tensor in ours.items() if ".lora_" not in name and not name.endswith(".alpha")}
    return LowRankFile(path, updates, whole, len(unused))


def _scales(path: Path, downs: Mapping[str, Tensor | None], alphas: Mapping[str, float]) -> dict[str, float]:
    ranks = {name: 1 if down is None else down.shape[0] for name, down in downs.items()}
    config = _header(path)
    if config is None:
        # a layer without a tensor of its own takes the alpha that is most common, as in diffusers
        common = Counter(alphas.values()).most_common(1)[0][0] if alphas else None
        found = {name: alphas.get(name, common) for name in ranks}
        return {name: 1.0 if alpha is None else alpha / ranks[name] for name, alpha in found.items()}
    if alphas:
        raise ValueError(f"{path}: expected alphas in the header or as tensors, found both")
    patterns: Mapping[str, float] = config.get("alpha_pattern") or {}
    scales = {}
    for name, rank in ranks.items():
        pattern = next((key for key in patterns if re.match(rf"(.*\.)?({key})$", name)), None)
        alpha = config.get("lora_alpha", _PEFT_ALPHA) if pattern is None else patterns[pattern]
        scales[name] = alpha / (math.sqrt(rank) if config.get("use_rslora") else rank)
    return scales


def _header(path: Path) -> dict[str, Any] | None:
    """The transformer's part of PEFT's configuration in the header; None where there is none."""
    text = read_metadata(path).get(_METADATA_KEY)
    if text is None:
        return None
    try:
        config = {key.removeprefix(PREFIX): value for key, value in json.loads(text).items() if key.startswith(PREFIX)}
        if not isinstance(config.get("lora_alpha", _PEFT_ALPHA), int | float):
            raise TypeError(f"lora_alpha {config['lora_alpha']!r}")
    except (ValueError, AttributeError, TypeError) as error:
        raise ValueError(f"{path}: expected PEFT's configuration in its header, found {error}") from error
    return config or None


def _few(names: Iterable[str]) -> str:
    return ", ".join(sorted(names)[:3]) or "nothing"
