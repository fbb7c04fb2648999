"""Layout of FLUX's latents: 2x2 packing into tokens, token positions, padding of images."""

import torch
from jaxtyping import Float
from torch import Tensor

MULTIPLE = 16
"""Image sides are multiples of this, pixels: 8 for the autoencoder times 2 for the packing (paper, Sec. 5.3)."""


def pack(latents: Float[Tensor, "b c h w"]) -> Float[Tensor, "b n d"]:
    """Pack blocks of 2x2 latent pixels into tokens, n = h w / 4, d = 4 c.

    The values of a channel stay together, so that packing commutes with concatenation along channels.
    """
    b, c, h, w = latents.shape
    blocks = latents.reshape(b, c, h // 2, 2, w // 2, 2).permute(0, 2, 4, 1, 3, 5)
    return blocks.reshape(b, h // 2 * (w // 2), c * 4)


def unpack(tokens: Float[Tensor, "b n d"], height: int, width: int) -> Float[Tensor, "b c {height} {width}"]:
    """Invert `pack` for latents of `height` x `width`."""
    b, _, d = tokens.shape
    blocks = tokens.reshape(b, height // 2, width // 2, d // 4, 2, 2).permute(0, 3, 1, 4, 2, 5)
    return blocks.reshape(b, d // 4, height, width)


def positions(height: int, width: int, device: torch.device) -> Float[Tensor, "n 3"]:
    """Position of each token of latents of `height` x `width`: 0 (the text coordinate), row, column."""
    rows, columns = torch.arange(height // 2, device=device), torch.arange(width // 2, device=device)
    row, column = torch.meshgrid(rows, columns, indexing="ij")
    return torch.stack([torch.zeros_like(row), row, column], -1).reshape(-1, 3).float()


def pad_by_reflection(images: Float[Tensor, "b c h w"], multiple: int = MULTIPLE) -> Float[Tensor, "b c i j"]:
    """Pad at the bottom and the right by reflection, repeated where needed, to multiples of `multiple` pixels."""
    h, w = images.shape[-2:]
    rows, columns = (_reflected_indices(size, -size % multiple + size).to(images.device) for size in (h, w))
    return images if len(rows) == h and len(columns) == w else images[..., rows, :][..., columns]


def _reflected_indices(size: int, length: int) -> Tensor:
    """Indices 0, 1, .., size-1, size-2, .., 0, 1, .. of that length."""
    period = max(2 * size - 2, 1)
    index = torch.arange(length) % period
    return torch.where(index < size, index, period - index)
