"""Corrections that a user makes to a selection of Gaussians: added and removed ones."""

import torch
from jaxtyping import Bool, Int8
from torch import Tensor


def apply_corrections(lifted: Bool[Tensor, "n"], corrections: Int8[Tensor, "n"] | None) -> Bool[Tensor, "n"]:
    """The selection with the user's corrections.

    Args:
        lifted: The selection from the masks.
        corrections: 1 adds a Gaussian, -1 removes it, 0 leaves it; None changes nothing.

    Raises:
        ValueError: Where there is not one correction per Gaussian.
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


def add_correction(
    corrections: Int8[Tensor, "n"] | None, touched: Bool[Tensor, "n"], *, add: bool
) -> Int8[Tensor, "n"]:
    """The corrections after one more stroke over the `touched` Gaussians; the last stroke over a Gaussian counts."""
    before = torch.zeros(len(touched), dtype=torch.int8) if corrections is None else corrections
    return torch.where(touched, torch.tensor(1 if add else -1, dtype=torch.int8), before)
