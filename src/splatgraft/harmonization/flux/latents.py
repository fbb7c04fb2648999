"""Latents of FLUX: 2x2 packing into tokens, positions, padding of pictures. Knows nothing about networks."""

import torch
from jaxtyping import Float
from torch import Tensor

MULTIPLE = 16
"""Pixels: 8 of the autoencoder times 2 of the packing (paper, Sec. 4.3)."""


def pack(latents: Float[Tensor, "b c h w"]) -> Float[Tensor, "b n d"]:
    """Tokens of 2x2 latent pixels, n = h w / 4, d = 4 c; channels stay together, so that concatenations commute."""
    b, c, h, w = latents.shape
    blocks = latents.reshape(b, c, h // 2, 2, w // 2, 2).permute(0, 2, 4, 1, 3, 5)
    return blocks.reshape(b, h // 2 * (w // 2), c * 4)


def unpack(tokens: Float[Tensor, "b n d"], height: int, width: int) -> Float[Tensor, "b c {height} {width}"]:
    """The inverse of `pack` for latents of `height` x `width`."""
    b, _, d = tokens.shape
    blocks = tokens.reshape(b, height // 2, width // 2, d // 4, 2, 2).permute(0, 3, 1, 4, 2, 5)
    return blocks.reshape(b, d // 4, height, width)


def positions(height: int, width: int, device: torch.device) -> Float[Tensor, "n 3"]:
    """Row and column of each token of latents of `height` x `width`; the first coordinate is text's."""
    rows, columns = torch.arange(height // 2, device=device), torch.arange(width // 2, device=device)
    row, column = torch.meshgrid(rows, columns, indexing="ij")
    return torch.stack([torch.zeros_like(row), row, column], -1).reshape(-1, 3).float()


def pad_by_reflection(images: Float[Tensor, "b c h w"], multiple: int = MULTIPLE) -> Float[Tensor, "b c i j"]:
    """Grown at the bottom and the right to multiples of `multiple`, mirrored as often as that takes."""
    h, w = images.shape[-2:]
    rows, columns = (_mirrored(size, -size % multiple + size).to(images.device) for size in (h, w))
    return images if len(rows) == h and len(columns) == w else images[..., rows, :][..., columns]


def _mirrored(size: int, wanted: int) -> Tensor:
    """Indices 0, 1, .., size-1, size-2, .., 0, 1, .. of length `wanted`."""
    period = max(2 * size - 2, 1)
    index = torch.arange(wanted) % period
    return torch.where(index < size, index, period - index)
