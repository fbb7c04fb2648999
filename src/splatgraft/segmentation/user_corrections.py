"""A person's corrections of a selection. Knows nothing about how either was made."""

import torch
from jaxtyping import Bool, Int8
from torch import Tensor


def corrected(lifted: Bool[Tensor, "n"], corrections: Int8[Tensor, "n"] | None) -> Bool[Tensor, "n"]:
    """The selection after corrections: 1 adds, -1 removes, 0 leaves what the masks gave.

    Raises: ValueError where there is not one correction per Gaussian.
    """
    if corrections is None:
        return lifted
    if len(corrections) != len(lifted):
        raise ValueError(
            f"corrections: expected one for each of {len(lifted)} Gaussians, found {len(corrections)}; "
            "the scene is another one now"
        )
    corrections = corrections.to(lifted.device)
    return (lifted | (corrections > 0)) & ~(corrections < 0)


def with_correction(
    corrections: Int8[Tensor, "n"] | None, touched: Bool[Tensor, "n"], *, add: bool
) -> Int8[Tensor, "n"]:
    """Corrections after one more stroke; the last stroke over a Gaussian counts."""
    before = torch.zeros(len(touched), dtype=torch.int8) if corrections is None else corrections
    return torch.where(touched, torch.tensor(1 if add else -1, dtype=torch.int8), before)
