"""Distance between the windowed Fourier magnitudes of two images, with its gradient, as numba kernels.

A window of 16x16 pixels is multiplied twice by the matrix of the discrete Fourier transform. Its rows of 16 numbers fit
into the first-level cache. Spectra of real windows are symmetric, so rows 0 to 8 are enough.
"""

import math
from typing import no_type_check

import numba
import numpy as np
import torch
from jaxtyping import Float
from numba import float32
from torch import Tensor

from splatgraft.rendering.cpu_simd import broadcast, load, store
from splatgraft.runtime.kernels import FAST_MATH, kernel, serialized

SIZE = 16
_HOP, _ROWS = SIZE // 2, SIZE // 2 + 1
_HALF = _ROWS * SIZE
_ANGLES = 2 * math.pi / SIZE * (np.arange(SIZE)[:, None] * np.arange(SIZE) % SIZE)
_COS, _SIN = np.cos(_ANGLES).astype(np.float32).ravel(), np.sin(_ANGLES).astype(np.float32).ravel()
_SHARES = np.repeat(np.array([1, *[2] * (_ROWS - 2), 1], np.float32) / SIZE, SIZE)
"""Multiplicity of each number of the half spectrum in the full one, over 16."""
_ZERO = np.float32(0)


def spectral_distance(
    image: Float[Tensor, "3 h w"], target: Float[Tensor, "3 h w"], window: Float[Tensor, "16 16"]
) -> Float[Tensor, ""]:
    """Compute the mean absolute difference of the Fourier magnitudes ("ortho") of windows that overlap by half.

    Args:
        image: Image padded to whole windows, float32 on the CPU; receives the gradient.
        target: Image of the same size; no gradient.
        window: Weights of the pixels of a window.
    """
    return _Distance.apply(image, target, window)


class _Distance(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image: Tensor, target: Tensor, window: Tensor) -> Tensor:
        pictures = [np.ascontiguousarray(x.detach().numpy()) for x in (image, target)]
        factors = np.ascontiguousarray(window.numpy() / SIZE).ravel()
        channels = image.shape[0]
        rows, columns = ((length - SIZE) // _HOP + 1 for length in image.shape[1:])
        gradient = np.zeros_like(pictures[0]) if ctx.needs_input_grad[0] else np.zeros((0, 0, 0), np.float32)
        sums = np.zeros((channels, rows), np.float32)
        _compare(*pictures, factors, (_COS, _SIN, _SHARES), gradient, sums)
        count = channels * rows * columns * SIZE
        ctx.gradient, ctx.count = gradient, count
        return torch.tensor(float(sums.sum(dtype=np.float64)) / count)

    @staticmethod
    def backward(ctx, grad):
        return torch.from_numpy(ctx.gradient) * (grad / ctx.count), None, None


@kernel
@no_type_check
def _transform(picture, place, factors, tables, work, spectrum):
    """Fill `spectrum` with the real, then the imaginary parts of rows 0 to 8 of a window's spectrum.

    `place` is the flat index of the window's first pixel in `picture`, and the width of `picture`.
    """
    (at, stride), (cos, sin, _) = place, tables
    for y in range(1, _HOP):
        upper = load(picture, at + y * stride) * load(factors, y * SIZE)
        lower = load(picture, at + (SIZE - y) * stride) * load(factors, (SIZE - y) * SIZE)
        store(work, y * SIZE, upper + lower)
        store(work, (SIZE - y) * SIZE, upper - lower)
    store(work, 0, load(picture, at) * load(factors, 0))
    store(work, _HOP * SIZE, load(picture, at + _HOP * stride) * load(factors, _HOP * SIZE))
    down = 2 * _HALF  # index in `spectrum` of a temporary row, transformed along y
    for row in range(_ROWS):
        real = load(work, 0) + load(work, _HOP * SIZE) * cos[row * SIZE + _HOP]
        imaginary = broadcast(float32(0))
        for y in range(1, _HOP):
            real = real + load(work, y * SIZE) * cos[row * SIZE + y]
            imaginary = imaginary - load(work, (SIZE - y) * SIZE) * sin[row * SIZE + y]
        store(spectrum, down, real)
        store(spectrum, down + SIZE, imaginary)
        real, imaginary = broadcast(float32(0)), broadcast(float32(0))
        for x in range(SIZE):
            a, b = spectrum[down + x], spectrum[down + SIZE + x]
            c, s = load(cos, x * SIZE), load(sin, x * SIZE)
            real = real + c * a + s * b
            imaginary = imaginary + c * b - s * a
        store(spectrum, row * SIZE, real)
        store(spectrum, _HALF + row * SIZE, imaginary)


@kernel(fastmath=FAST_MATH, error_model="numpy")
@no_type_check
def _differ(spectrum, wanted, shares):
    """Return the sum of absolute differences of magnitudes; `spectrum` becomes the gradient of that sum."""
    added = _ZERO
    for i in range(_HALF):
        real, imaginary = spectrum[i], spectrum[_HALF + i]
        magnitude = np.sqrt(real * real + imaginary * imaginary)
        difference = magnitude - np.sqrt(wanted[i] * wanted[i] + wanted[_HALF + i] * wanted[_HALF + i])
        added += shares[i] * abs(difference)
        sign = np.float32(difference > _ZERO) - np.float32(difference < _ZERO)
        slope = shares[i] * sign / max(magnitude, np.float32(1e-30))
        spectrum[i], spectrum[_HALF + i] = slope * real, slope * imaginary
    return added


@kernel
@no_type_check
def _add_back(spectrum, place, factors, tables, work, gradient):
    """Apply the transpose of `_transform` to `spectrum` and add the result to a window of `gradient`."""
    (at, stride), (cos, sin, _) = place, tables
    for row in range(_ROWS):
        real, imaginary = broadcast(float32(0)), broadcast(float32(0))
        for x in range(SIZE):
            a, b = spectrum[row * SIZE + x], spectrum[_HALF + row * SIZE + x]
            c, s = load(cos, x * SIZE), load(sin, x * SIZE)
            real = real + c * a - s * b
            imaginary = imaginary + c * b + s * a
        store(work, row * SIZE, real)
        store(work, _HALF + row * SIZE, imaginary)
    for y in range(_ROWS):
        even, odd = broadcast(float32(0)), broadcast(float32(0))
        for row in range(_ROWS):
            even = even + load(work, row * SIZE) * cos[row * SIZE + y]
            odd = odd + load(work, _HALF + row * SIZE) * sin[row * SIZE + y]
        pixels = at + y * stride
        store(gradient, pixels, load(gradient, pixels) + (even - odd) * load(factors, y * SIZE))
        if 0 < y < _HOP:
            mirrored = SIZE - y
            pixels = at + mirrored * stride
            store(gradient, pixels, load(gradient, pixels) + (even + odd) * load(factors, mirrored * SIZE))


@serialized
@kernel(parallel=True)
@no_type_check
def _compare(image, target, factors, tables, gradient, sums):
    """Fill `sums` (channels, rows of windows), and add to `gradient` unless it is empty."""
    channels, rows = sums.shape
    height, width = image.shape[1:]
    columns = (width - SIZE) // _HOP + 1
    for parity in range(2):  # windows of every second row do not overlap, so threads write to separate pixels
        count = (rows - parity + 1) // 2
        for task in numba.prange(channels * count):
            channel, row = task // count, parity + 2 * (task % count)
            work = np.empty(2 * _HALF, np.float32)
            spectrum, wanted = np.empty(2 * _HALF + 2 * SIZE, np.float32), np.empty(2 * _HALF + 2 * SIZE, np.float32)
            added = float32(0)
            for column in range(columns):
                place = (channel * height + row * _HOP) * width + column * _HOP, width
                _transform(image, place, factors, tables, work, spectrum)
                _transform(target, place, factors, tables, work, wanted)
                added += _differ(spectrum, wanted, tables[2])
                if gradient.shape[0]:
                    _add_back(spectrum, place, factors, tables, work, gradient)
            sums[channel, row] = added
