"""Photometric loss of 3DGS, L1 with D-SSIM (Kerbl et al. 2023, Eq. 7), with a fused gradient on the CPU.

The kernel applies four 11-tap separable filters forward and three backward to rows of interleaved channels. Its loops
use few arrays, or planes of one array at constant distances, because only then can the compiler rule out aliasing.
"""

from typing import no_type_check

import numba
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.image_metrics import ssim
from splatgraft.runtime.kernels import FAST_MATH, kernel, serialized

_TAPS = np.exp(-((np.arange(6, dtype=np.float64) - 5) ** 2) / (2 * 1.5**2))
_T0, _T1, _T2, _T3, _T4, _T5 = (np.float32(tap) for tap in _TAPS / (2 * _TAPS.sum() - _TAPS[5]))
_C1, _C2 = np.float32(0.01**2), np.float32(0.03**2)
_ONE, _TWO = np.float32(1), np.float32(2)
_BLOCK, _BAND, _EDGE = 512, 64, 30  # values per block, rows per task, values of ten pixels with three channels


def l1_dssim(
    image: Float[Tensor, "h w 3"], reference: Float[Tensor, "h w 3"], *, dssim_weight: float = 0.2
) -> Float[Tensor, ""]:
    """Compute (1 - w) |image - reference| + w (1 - SSIM), means over pixels (3DGS, Eq. 7).

    Args:
        image: Rendered image, sRGB; receives the gradient.
        reference: Target image, sRGB.
        dssim_weight: Weight w of D-SSIM.
    """
    if min(image.shape[:2]) < 11:
        raise ValueError(f"l1_dssim: expected images of at least 11x11 pixels, found {image.shape[1]}x{image.shape[0]}")
    if image.device.type == "cpu" and image.dtype == torch.float32:
        return _FusedL1Dssim.apply(image, reference, dssim_weight)
    return (1 - dssim_weight) * (image - reference).abs().mean() + dssim_weight * (1 - ssim(image, reference))


class _FusedL1Dssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image: Tensor, reference: Tensor, weight: float) -> Tensor:
        x, y = image.detach().contiguous().numpy(), reference.detach().contiguous().numpy()
        h, w, c = x.shape
        loss, gradient = _loss_and_gradient(x.reshape(h, w * c), y.reshape(h, w * c), np.float32(weight))
        ctx.save_for_backward(torch.from_numpy(gradient).reshape(h, w, c))
        return image.new_tensor(loss)

    @staticmethod
    def backward(ctx, upstream: Tensor) -> tuple[Tensor, None, None]:
        return upstream * ctx.saved_tensors[0], None, None


@kernel(fastmath=FAST_MATH)
@no_type_check
def _across(out, row):
    """Set out[j] to the weighted sum of one channel of eleven neighbours: row[j], row[j + 3], ..."""
    for j in range(len(out)):
        out[j] = (
            _T0 * (row[j] + row[j + 30])
            + _T1 * (row[j + 3] + row[j + 27])
            + _T2 * (row[j + 6] + row[j + 24])
            + _T3 * (row[j + 9] + row[j + 21])
            + _T4 * (row[j + 12] + row[j + 18])
            + _T5 * row[j + 15]
        )


@kernel(fastmath=FAST_MATH)
@no_type_check
def _add_rows(out, first, second, tap):
    for j in range(len(out)):
        out[j] += tap * (first[j] + second[j])


@kernel(fastmath=FAST_MATH)
@no_type_check
def _down(out, ring, k, top):
    """Set `out` to the weighted sum of plane k of the eleven rows from `top` on; row r is at r modulo 11 of `ring`."""
    out[:] = 0
    _add_rows(out, ring[top % 11, k], ring[(top + 10) % 11, k], _T0)
    _add_rows(out, ring[(top + 1) % 11, k], ring[(top + 9) % 11, k], _T1)
    _add_rows(out, ring[(top + 2) % 11, k], ring[(top + 8) % 11, k], _T2)
    _add_rows(out, ring[(top + 3) % 11, k], ring[(top + 7) % 11, k], _T3)
    _add_rows(out, ring[(top + 4) % 11, k], ring[(top + 6) % 11, k], _T4)
    _add_rows(out, ring[(top + 5) % 11, k], ring[(top + 5) % 11, k], _T5 / _TWO)


# divisions follow numpy, because a check for zero would be a branch in the loop; denominators are at least C1 and C2
@kernel(fastmath=FAST_MATH, error_model="numpy")
@no_type_check
def _similarity(work):
    """Return the sum of SSIM and replace filtered moments by SSIM's derivatives, in planes of `_BLOCK` values.

    Planes hold mean x, mean y, mean x^2 + y^2 and mean xy on entry, and the derivatives by x, x^2 and xy on return.
    """
    total = np.float32(0)
    for j in range(_BLOCK):
        mx, my = work[j], work[j + _BLOCK]
        both = mx * mx + my * my
        d1 = _ONE / (both + _C1)
        d2 = _ONE / (work[j + 2 * _BLOCK] - both + _C2)
        luminance = (_TWO * mx * my + _C1) * d1
        structure = (_TWO * (work[j + 3 * _BLOCK] - mx * my) + _C2) * d2
        total += luminance * structure
        work[j] = _TWO * (structure * (my - luminance * mx) * d1 + luminance * (structure * mx - my) * d2)
        work[j + _BLOCK] = -luminance * structure * d2
        work[j + 2 * _BLOCK] = _TWO * luminance * d2
    return total


@kernel(fastmath=FAST_MATH)
@no_type_check
def _moments_of_row(out, x, y):
    """Write horizontally filtered x, y, x^2 + y^2 and xy to out[0..3]."""
    scratch = np.empty(len(x), np.float32)
    _across(out[0], x)
    _across(out[1], y)
    for j in range(len(x)):
        scratch[j] = x[j] * x[j] + y[j] * y[j]
    _across(out[2], scratch)
    for j in range(len(x)):
        scratch[j] = x[j] * y[j]
    _across(out[3], scratch)


@kernel(fastmath=FAST_MATH)
@no_type_check
def _derivatives_of_row(out, filtered, top):
    """Return the sum of SSIM over one row, and write its horizontally spread derivatives to out[0..2]."""
    n = filtered.shape[2]
    planes = np.empty((4, n), np.float32)
    for plane in range(4):
        _down(planes[plane], filtered, plane, top)
    padded = np.zeros((3, n + 2 * _EDGE), np.float32)
    work = np.zeros(4 * _BLOCK, np.float32)
    total = 0.0
    for start in range(0, n, _BLOCK):
        size = min(_BLOCK, n - start)
        work[:] = 0  # beyond the row all is 0, where SSIM is 1
        for plane in range(4):
            work[plane * _BLOCK : plane * _BLOCK + size] = planes[plane, start : start + size]
        total += _similarity(work) - (_BLOCK - size)
        for plane in range(3):
            padded[plane, _EDGE + start : _EDGE + start + size] = work[plane * _BLOCK : plane * _BLOCK + size]
    for plane in range(3):
        _across(out[plane], padded[plane])
    return total


@kernel(fastmath=FAST_MATH)
@no_type_check
def _gradient_of_row(out, spread, row, pair, scales):
    """Spread the derivatives vertically, add those of L1, and return the sum of |x - y|."""
    x, y = pair
    scale_ssim, scale_l1 = scales
    part = np.empty(len(out), np.float32)
    _down(out, spread, 0, row - 10)
    _down(part, spread, 1, row - 10)
    for j in range(len(out)):
        out[j] += _TWO * x[j] * part[j]
    _down(part, spread, 2, row - 10)
    for j in range(len(out)):
        out[j] = scale_ssim * (out[j] + y[j] * part[j])
    total = np.float32(0)
    for j in range(len(out)):
        difference = x[j] - y[j]
        total += abs(difference)
        out[j] += scale_l1 * (np.float32(difference > 0) - np.float32(difference < 0))
    return total


@serialized
@kernel(parallel=True, fastmath=FAST_MATH)
@no_type_check
def _loss_and_gradient(x, y, weight):
    """Compute the loss and its gradient for images as rows of three interleaved channels.

    Bands of rows are independent. In a band, ring buffers of eleven filtered rows stay in the cache.
    """
    h, width = x.shape
    rows, columns = h - 10, width - _EDGE
    scales = (-weight / np.float32(rows * columns), (_ONE - weight) / np.float32(h * width))
    gradient = np.empty((h, width), np.float32)
    bands = (h + _BAND - 1) // _BAND
    absolute, similarity = np.zeros(bands, np.float64), np.zeros(bands, np.float64)
    for band in numba.prange(bands):
        first, last = band * _BAND, min(h, (band + 1) * _BAND)
        filtered = np.empty((11, 4, columns), np.float32)
        spread = np.zeros((11, 3, width), np.float32)
        ready = max(first - 10, 0)
        for row in range(first - 10, last):
            slot = spread[row % 11]
            if 0 <= row < rows:
                while ready <= row + 10:
                    _moments_of_row(filtered[ready % 11], x[ready], y[ready])
                    ready += 1
                total = _derivatives_of_row(slot, filtered, row)
                if row >= first:
                    similarity[band] += total
            else:
                slot[:] = 0
            if row >= first:
                absolute[band] += _gradient_of_row(gradient[row], spread, row, (x[row], y[row]), scales)
    l1 = absolute.sum() / (h * width)
    return (_ONE - weight) * l1 + weight * (1 - similarity.sum() / (rows * columns)), gradient
