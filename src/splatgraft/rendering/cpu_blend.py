"""Alpha blending of tile lists, forward, backward and transposed: numba kernels. Knows nothing about 3D.

A tile is worked on row by row, 16 pixels at once, in planes of float32 inside one array (so that the compiler can
see that planes do not overlap); the inner loops have no branch, no call and no reduction, and exp is multiplications.
"""

import math
from typing import no_type_check

import numpy as np
from numba import float32, njit, prange

from splatgraft.rendering.cpu_project import CA, CB, CC, MIN_ALPHA, MX, MY, OPACITY, REACH_Y
from splatgraft.rendering.cpu_tiles import TILE

PIXELS = TILE * TILE
BATCH = 32
MAX_ALPHA = float32(0.99)
MIN_TRANSMITTANCE = float32(1e-4)
MOMENTS = 6

# exp(x) on [-0.35, 0] to 1e-7: Chebyshev interpolation
E0, E1, E2, E3, E4 = (float32(x) for x in (0.99999994, 0.9999898, 0.49976337, 0.16472879, 0.035080757))
_FAST = {"contract", "reassoc", "nsz", "arcp"}
ONE, ZERO = float32(1), float32(0)


@njit(cache=True, inline="always")
@no_type_check
def _rows(splat, y0):
    """First and one past the last row of the tile at `y0` that the splat can reach."""
    center, reach = splat[MY] - y0 - float32(0.5), splat[REACH_Y] + float32(1e-3)
    top, bottom = math.ceil(max(center - reach, ZERO)), math.floor(min(center + reach, float32(TILE - 1)))
    return int(top), int(bottom) + 1


@njit(cache=True, fastmath=_FAST, inline="always")
@no_type_check
def _alpha_row(work, at, splat, dy, mx):
    """Write the 16 alphas of one row, before the cap and 0 below 1/255, to `work[at:]`."""
    scale = float32(-0.5 / 16)
    qa, qb = scale * splat[CA], float32(2) * scale * splat[CB] * dy
    qc, opacity = scale * splat[CC] * dy * dy, splat[OPACITY]
    for x in range(TILE):
        dx = float32(x) - mx
        t = (qa * dx + qb) * dx + qc
        e = (((E4 * t + E3) * t + E2) * t + E1) * t + E0
        e *= e
        e *= e
        e *= e
        e *= e
        alpha = opacity * e
        work[at + x] = alpha if alpha >= float32(MIN_ALPHA) and t > float32(-0.36) else ZERO


@njit(cache=True, parallel=True, fastmath=_FAST)
@no_type_check
def blend(splats, start, entries, values, width, height, image, alpha):
    """Fill `image (c, h, w)` with blended `values (m, c)` over black, and `alpha (h, w)`."""
    tiles_x = (width + TILE - 1) // TILE
    channels = values.shape[1]
    for tile in prange(start.shape[0] - 1):
        x0, y0 = float32((tile % tiles_x) * TILE), float32((tile // tiles_x) * TILE)
        work = np.zeros((channels + 2) * PIXELS, np.float32)
        work[:PIXELS] = ONE
        row_at = PIXELS
        for k in range(start[tile], start[tile + 1]):
            s = entries[k]
            splat = splats[s]
            mx = splat[MX] - x0 - float32(0.5)
            top, bottom = _rows(splat, y0)
            for y in range(top, bottom):
                _alpha_row(work, row_at, splat, float32(y) - (splat[MY] - y0 - float32(0.5)), mx)
                at = y * TILE
                for x in range(TILE):
                    weight = min(work[row_at + x], MAX_ALPHA) * work[at + x]
                    work[at + x] -= weight
                    work[row_at + x] = weight
                for c in range(channels):
                    value, plane = values[s, c], at + (c + 2) * PIXELS
                    for x in range(TILE):
                        work[plane + x] += work[row_at + x] * value
            if (k - start[tile]) % BATCH == BATCH - 1 and work[:PIXELS].max() < MIN_TRANSMITTANCE:
                break
        _store(work, image, alpha, int(x0), int(y0))


@njit(cache=True)
@no_type_check
def _store(work, image, alpha, x0, y0):
    for y in range(y0, min(y0 + TILE, alpha.shape[0])):
        for x in range(x0, min(x0 + TILE, alpha.shape[1])):
            at = (y - y0) * TILE + x - x0
            alpha[y, x] = ONE - work[at]
            for c in range(image.shape[0]):
                image[c, y, x] = work[(c + 2) * PIXELS + at]


@njit(cache=True)
@no_type_check
def _load(work, image, x0, y0, plane):
    """Put the tile of `image (c, h, w)` into the planes from `plane`, 0 outside the image."""
    for c in range(image.shape[0]):
        for y in range(y0, min(y0 + TILE, image.shape[1])):
            for x in range(x0, min(x0 + TILE, image.shape[2])):
                work[(plane + c) * PIXELS + (y - y0) * TILE + x - x0] = image[c, y, x]


@njit(cache=True, parallel=True, fastmath=_FAST)
@no_type_check
def blend_transpose(splats, start, entries, slots, image, width, height, sums):
    """Fill `sums (e, c)`: for every entry, the sum over its pixels of weight times `image (c, h, w)`."""
    tiles_x = (width + TILE - 1) // TILE
    channels = image.shape[0]
    for tile in prange(start.shape[0] - 1):
        x0, y0 = float32((tile % tiles_x) * TILE), float32((tile // tiles_x) * TILE)
        work = np.zeros((channels + 2) * PIXELS, np.float32)
        work[:PIXELS] = ONE
        _load(work, image, int(x0), int(y0), 2)
        column_sums = np.zeros((channels, TILE), np.float32)
        row_at = PIXELS
        done = False
        for k in range(start[tile], start[tile + 1]):
            s, slot = entries[k], slots[k]
            if done:
                sums[slot] = ZERO
                continue
            splat = splats[s]
            mx = splat[MX] - x0 - float32(0.5)
            top, bottom = _rows(splat, y0)
            column_sums[:] = ZERO
            for y in range(top, bottom):
                _alpha_row(work, row_at, splat, float32(y) - (splat[MY] - y0 - float32(0.5)), mx)
                at = y * TILE
                for x in range(TILE):
                    weight = min(work[row_at + x], MAX_ALPHA) * work[at + x]
                    work[at + x] -= weight
                    work[row_at + x] = weight
                for c in range(channels):
                    plane = at + (c + 2) * PIXELS
                    for x in range(TILE):
                        column_sums[c, x] += work[row_at + x] * work[plane + x]
            for c in range(channels):
                sums[slot, c] = column_sums[c].sum()
            done = (k - start[tile]) % BATCH == BATCH - 1 and work[:PIXELS].max() < MIN_TRANSMITTANCE


@njit(cache=True, parallel=True, fastmath=_FAST)
@no_type_check
def blend_backward(splats, start, entries, slots, values, rest, grad_image, grad_alpha, width, height, sums):
    """Fill `sums (e, 6 + c)`: for every entry its moments, as `unproject` takes them, and its values' gradients.

    `rest (h, w)` is the sum over channels of gradient times blended value, that of alpha included.
    """
    tiles_x = (width + TILE - 1) // TILE
    channels = values.shape[1]
    for tile in prange(start.shape[0] - 1):
        x0, y0 = float32((tile % tiles_x) * TILE), float32((tile // tiles_x) * TILE)
        # planes: transmittance; rows of alpha, weight and value; rest; gradient of alpha; gradients of the image
        work = np.zeros((channels + 4) * PIXELS, np.float32)
        work[:PIXELS] = ONE
        alpha_at, weight_at, value_at = PIXELS, PIXELS + TILE, PIXELS + 2 * TILE
        rest_at, grad_alpha_at = 2 * PIXELS, 3 * PIXELS
        _load(work, rest.reshape((1, height, width)), int(x0), int(y0), 2)
        _load(work, grad_alpha.reshape((1, height, width)), int(x0), int(y0), 3)
        _load(work, grad_image, int(x0), int(y0), 4)
        columns = np.zeros((channels + 3, TILE), np.float32)
        done = False
        for k in range(start[tile], start[tile + 1]):
            s, slot = entries[k], slots[k]
            if done:
                sums[slot] = ZERO
                continue
            splat = splats[s]
            mx = splat[MX] - x0 - float32(0.5)
            top, bottom = _rows(splat, y0)
            columns[:] = ZERO
            for y in range(top, bottom):
                dy = float32(y) - (splat[MY] - y0 - float32(0.5))
                _alpha_row(work, alpha_at, splat, dy, mx)
                at = y * TILE
                for x in range(TILE):
                    work[weight_at + x] = min(work[alpha_at + x], MAX_ALPHA) * work[at + x]
                    work[value_at + x] = work[grad_alpha_at + at + x]
                for c in range(channels):
                    value, plane = values[s, c], at + (c + 4) * PIXELS
                    for x in range(TILE):
                        grad = work[plane + x]
                        work[value_at + x] += value * grad
                        columns[c + 3, x] += work[weight_at + x] * grad
                for x in range(TILE):
                    alpha, weight, value = work[alpha_at + x], work[weight_at + x], work[value_at + x]
                    before = work[at + x]
                    left = work[rest_at + at + x] - weight * value
                    work[rest_at + at + x] = left
                    slope = before * value - left / (ONE - min(alpha, MAX_ALPHA))
                    pull = alpha * slope if alpha < MAX_ALPHA else ZERO
                    work[at + x] = before - weight
                    columns[0, x] += pull
                    columns[1, x] += pull * dy
                    columns[2, x] += pull * dy * dy
            s0, sx, sy, sxx, sxy, syy = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
            for x in range(TILE):
                dx = float32(x) - mx
                s0 += columns[0, x]
                sx += columns[0, x] * dx
                sxx += columns[0, x] * dx * dx
                sy += columns[1, x]
                sxy += columns[1, x] * dx
                syy += columns[2, x]
            sums[slot, 0], sums[slot, 1], sums[slot, 2] = s0, sx, sy
            sums[slot, 3], sums[slot, 4], sums[slot, 5] = sxx, sxy, syy
            for c in range(channels):
                sums[slot, 6 + c] = columns[c + 3].sum()
            done = (k - start[tile]) % BATCH == BATCH - 1 and work[:PIXELS].max() < MIN_TRANSMITTANCE


@njit(cache=True, parallel=True)
@no_type_check
def sum_slots(sums, first, out):
    """Fill `out (m, c)` with the sums over each splat's slots, in a fixed order."""
    for s in prange(first.shape[0] - 1):
        for c in range(sums.shape[1]):
            total = ZERO
            for slot in range(first[s], first[s + 1]):
                total += sums[slot, c]
            out[s, c] = total
