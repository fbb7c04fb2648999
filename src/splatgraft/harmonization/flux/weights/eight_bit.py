"""Linear layers that multiply in 8 bits: weights and activations as float8_e4m3fn with a scale per row.

y = (x / s_x)_fp8 (W / s_W)_fp8^T s_x s_W, with s the greatest magnitude of a row over 448, the greatest value of the
format; the product is `torch._scaled_mm` (H100 and newer cards, and CPUs). Scales of the activations are those of each
token, found when the layer runs.
"""

from typing import Any, no_type_check

import torch
from jaxtyping import Float
from torch import Tensor, nn

_GREATEST = 448.0
"""Of float8_e4m3fn."""
_MULTIPLE = 16
"""Both sides of a weight must be multiples of this for torch._scaled_mm."""


class Float8Linear(nn.Module):
    """A linear layer with weights of 8 bits, without gradients."""

    weight: Tensor
    scale: Tensor

    def __init__(self, layer: nn.Linear) -> None:
        """Round the weights of `layer`."""
        super().__init__()
        rounded, scale = _rounded(layer.weight.detach())
        self.register_buffer("weight", rounded)
        self.register_buffer("scale", scale.T.contiguous())
        self.bias = None if layer.bias is None else layer.bias.requires_grad_(False)

    @no_type_check  # the tests' shape checks cannot be traced by torch.compile
    def forward(self, x: Float[Tensor, "*n i"]) -> Float[Tensor, "*n o"]:
        """Multiply in 8 bits; the result has the dtype of `x`."""
        rounded, scale = _rounded(x.reshape(-1, x.shape[-1]))
        y = torch._scaled_mm(rounded, self.weight.t(), scale_a=scale, scale_b=self.scale, out_dtype=x.dtype)
        y = y if self.bias is None else y + self.bias.to(y.dtype)
        return y.reshape(*x.shape[:-1], -1)


@no_type_check
def _rounded(rows: Float[Tensor, "n i"]) -> tuple[Tensor, Float[Tensor, "n 1"]]:
    scale = (rows.float().abs().amax(1, keepdim=True) / _GREATEST).clamp_min(1e-12)
    return (rows.float() / scale).to(torch.float8_e4m3fn), scale


def multiplies_in_eight_bits(device: torch.device) -> bool:
    """Whether `torch._scaled_mm` with a scale per row works on a device: tried on a small product."""
    try:
        ones = torch.ones(_MULTIPLE, _MULTIPLE, device=device).to(torch.float8_e4m3fn)
        scale = torch.ones(_MULTIPLE, 1, device=device)
        multiply = torch._scaled_mm  # pyright: ignore[reportPrivateImportUsage]
        multiply(ones, ones.t(), scale_a=scale, scale_b=scale.T.contiguous(), out_dtype=torch.bfloat16)
    except (RuntimeError, AttributeError, TypeError, ValueError):
        return False
    return True


def use_eight_bits(transformer: Any) -> int:
    """Replace the linear layers of all blocks of a FLUX transformer in place.

    Returns:
        The number of layers replaced; those with sides that are no multiples of 16 stay.
    """
    count = 0
    for blocks in (transformer.transformer_blocks, transformer.single_transformer_blocks):
        for name, layer in [(name, module) for name, module in blocks.named_modules() if type(module) is nn.Linear]:
            if layer.in_features % _MULTIPLE == 0 and layer.out_features % _MULTIPLE == 0:
                owner, _, last = name.rpartition(".")
                setattr(blocks.get_submodule(owner), last, Float8Linear(layer))
                count += 1
    return count
