"""Precomputed adaLN modulations: with one prompt and fixed noise levels they are constants, kept in a table.

FLUX uses 3.27 of its 11.89 billion parameters in layers that map (prompt, noise level) to scales and shifts. A table
with one row per noise level replaces them (8.62 billion parameters remain) with bit-identical results.
"""

from typing import Any, no_type_check

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from splatgraft.harmonization.flux.empty_prompt import PromptEmbedding

GUIDANCE = 3.5
"""Of guidance-distilled networks (FLUX.1-dev): the default of diffusers' pipeline and of its training scripts."""


class BakedLevels(nn.Module):
    """Replaces the time and text embedding: maps a noise level to its row in the tables."""

    levels: Tensor

    def __init__(self, levels: tuple[float, ...], device: torch.device) -> None:
        """Store the noise `levels` in [0, 1] that the network will be called with."""
        super().__init__()
        self.register_buffer("levels", torch.tensor(levels, device=device) * 1000, persistent=False)

    @no_type_check  # the tests' shape checks cannot be traced by torch.compile
    def forward(self, timestep: Float[Tensor, " b"], pooled: Float[Tensor, "b p"]) -> Int[Tensor, " b"]:
        """Row of each sample: the nearest level, since bfloat16 rounds 750 to 752."""
        return (timestep.float()[:, None] - self.levels).abs().argmin(1)


class BakedModulation(nn.Module):
    """Replaces a modulated norm: keeps the norm and a table of its linear layer's outputs."""

    table: Tensor

    def __init__(self, norm: nn.Module, table: Float[Tensor, "s d"], parts: int) -> None:
        """Keep `norm` and `table`.

        Args:
            norm: the normalisation without modulation.
            table: output of the linear layer, one row per noise level.
            parts: outputs per row: 6 for AdaLayerNormZero, 3 for AdaLayerNormZeroSingle, 2 for AdaLayerNormContinuous.
        """
        super().__init__()
        self.norm, self.parts = norm, parts
        self.register_buffer("table", table, persistent=False)

    @no_type_check  # the tests' shape checks cannot be traced by torch.compile
    def forward(self, x: Float[Tensor, "b n d"], emb: Int[Tensor, " b"]) -> Any:
        """Return what the replaced norm returns; `emb` holds the rows of `BakedLevels`."""
        parts = self.table[emb].chunk(self.parts, dim=1)
        if self.parts == 2:
            scale, shift = parts
            return self.norm(x) * (1 + scale)[:, None, :] + shift[:, None, :]
        shift, scale, *rest = parts
        return self.norm(x) * (1 + scale[:, None]) + shift[:, None], *rest


@torch.no_grad()
def bake(transformer: Any, prompt: PromptEmbedding, levels: tuple[float, ...], *, guidance: float | None = None) -> int:
    """Replace the modulation layers of a `FluxTransformer2DModel` in place.

    Args:
        transformer: the network.
        prompt: the only prompt that will be used.
        levels: all noise levels that will be used, in [0, 1].
        guidance: what a guidance-distilled network is told; `GUIDANCE` where not given, nothing without distillation.

    Returns:
        The number of parameters removed.
    """
    before = sum(p.numel() for p in transformer.parameters())
    weight = transformer.x_embedder.weight
    pooled = prompt.pooled.to(weight.device, weight.dtype)[None]
    told = ()
    if transformer.config.guidance_embeds:
        told = (torch.tensor([GUIDANCE if guidance is None else guidance], device=weight.device),)
    # one row at a time, as in a call with one picture: a matrix product's rounding depends on its shape
    rows = [
        transformer.time_text_embed(
            *(x.to(weight.dtype) * 1000 for x in (torch.tensor([level], device=weight.device), *told)), pooled
        )
        for level in levels
    ]

    def baked(norm: Any, parts: int) -> BakedModulation:
        return BakedModulation(norm.norm, torch.cat([norm.linear(norm.silu(row)) for row in rows]), parts)

    for block in transformer.transformer_blocks:
        block.norm1, block.norm1_context = baked(block.norm1, 6), baked(block.norm1_context, 6)
    for block in transformer.single_transformer_blocks:
        block.norm = baked(block.norm, 3)
    transformer.norm_out = baked(transformer.norm_out, 2)
    transformer.time_text_embed = BakedLevels(levels, weight.device)
    transformer.register_to_config(guidance_embeds=False)  # it is in the tables
    return before - sum(p.numel() for p in transformer.parameters())


def fuse_projections(transformer: Any) -> None:
    """Fuse the query, key and value projections in place and delete the separate layers, which diffusers keeps."""
    transformer.fuse_qkv_projections()
    for module in transformer.modules():
        if getattr(module, "fused_projections", False):
            for name in ("to_q", "to_k", "to_v", "add_q_proj", "add_k_proj", "add_v_proj"):
                if hasattr(module, name):
                    delattr(module, name)
