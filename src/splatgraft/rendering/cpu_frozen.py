"""Views with frozen geometry: numba kernels that find the rows of a splat with weight, and apply W^T W in one pass.

Behind an opaque surface, most rows of a splat have weights of almost 0; the others are found once. W^T W is applied
tile by tile, because a tile's list draws all of its pixels. So no whole image is needed, and each weight is computed
once.
"""

from typing import no_type_check

import numpy as np
from numba import float32, prange

from splatgraft.rendering.cpu_blend import (
    BATCH,
    MAX_ALPHA,
    MIN_TRANSMITTANCE,
    ONE,
    PIXELS,
    ZERO,
    alpha_row,
    fetch_ahead,
    open_tile,
    saturated,
    splat_shape,
)
from splatgraft.rendering.cpu_simd import broadcast, lanes, load, smaller, store, total
from splatgraft.rendering.cpu_tiles import TILE
from splatgraft.runtime.kernels import kernel


@kernel(parallel=True)
@no_type_check
def find_rows(splats, start, entries, size, min_weight, rows):
    """Fill `rows (e, 2)`: first and one past the last row of each entry with more weight than a bound.

    `size`: height and width of the image; pixels outside count nothing. Both numbers are 0 for entries without such a
    row. A tile is done when every pixel's transmittance is below `MIN_TRANSMITTANCE`.
    """
    height, width = size
    for tile in prange(start.shape[0] - 1):
        x0, y0, work = open_tile(tile, width, 2)
        for y in range(min(TILE, height - y0)):
            work[PIXELS + y * TILE : PIXELS + y * TILE + min(TILE, width - x0)] = ONE
        for k in range(start[tile], start[tile + 1]):
            rows[k, 0], rows[k, 1] = 0, 0
        for k in range(start[tile], start[tile + 1]):
            fetch_ahead(splats, entries, k)
            mx, my, a, b, c, d, top, bottom = splat_shape(splats, entries[k], float32(x0), float32(y0))
            dx = lanes() - mx
            across = dx * dx * a + d
            for y in range(top, bottom):
                dy = float32(y) - my
                at = y * TILE
                before = load(work, at)
                weight = smaller(alpha_row(across, dx, b * dy, c * dy * dy), MAX_ALPHA) * before
                store(work, at, before - weight)
                if total(weight * load(work, at + PIXELS)) > min_weight:
                    if rows[k, 1] == 0:
                        rows[k, 0] = y
                    rows[k, 1] = y + 1
            if (k - start[tile]) % BATCH == BATCH - 1 and saturated(work, MIN_TRANSMITTANCE):
                break


@kernel
@no_type_check
def _count(rows):
    """Count the rows of all entries; at least 1."""
    count = 0
    for k in range(rows.shape[0]):
        count += int(rows[k, 1]) - int(rows[k, 0])
    return max(count, 1)


@kernel
@no_type_check
def _blend_and_keep(splats, entries, rows, values, x0, y0, work, weights):
    """Fill the planes transmittance, red, green, blue of `work`, and append every row of weights to `weights`."""
    kept = 0
    for k in range(entries.shape[0]):
        s = entries[k]
        fetch_ahead(splats, entries, k)
        fetch_ahead(values, entries, k)
        mx, my, a, b, c, d, _, _ = splat_shape(splats, s, x0, y0)
        red, green, blue = values[s, 0], values[s, 1], values[s, 2]
        dx = lanes() - mx
        across = dx * dx * a + d
        for y in range(int(rows[k, 0]), int(rows[k, 1])):
            dy = float32(y) - my
            at = y * TILE
            before = load(work, at)
            weight = smaller(alpha_row(across, dx, b * dy, c * dy * dy), MAX_ALPHA) * before
            store(work, at, before - weight)
            store(work, at + PIXELS, load(work, at + PIXELS) + weight * red)
            store(work, at + 2 * PIXELS, load(work, at + 2 * PIXELS) + weight * green)
            store(work, at + 3 * PIXELS, load(work, at + 3 * PIXELS) + weight * blue)
            store(weights, kept, weight)
            kept += TILE


@kernel(parallel=True)
@no_type_check
def blend_and_transpose(splats, start, entries, rows, slots, values, size, sums):
    """Fill `sums (e, 3)` with `blend_transpose` of the image of `values (m, 3)`; `size`: its height and width.

    The weights of a tile's splats are computed once for both, in the rows `rows (e, 2)` of each entry.
    """
    height, width = size
    for tile in prange(start.shape[0] - 1):
        x0, y0, work = open_tile(tile, width, 4)
        listed, places = entries[start[tile] : start[tile + 1]], slots[start[tile] : start[tile + 1]]
        spans = rows[start[tile] : start[tile + 1]]
        weights = np.empty(_count(spans) * TILE, np.float32)
        _blend_and_keep(splats, listed, spans, values, float32(x0), float32(y0), work, weights)
        for y in range(TILE):  # pixels outside the image count nothing
            inside = width - x0 if y0 + y < height else 0
            for x in range(inside, TILE):
                for plane in range(1, 4):
                    work[plane * PIXELS + y * TILE + x] = ZERO
        kept = 0
        for k in range(listed.shape[0]):
            red, green, blue = broadcast(ZERO), broadcast(ZERO), broadcast(ZERO)
            for y in range(int(spans[k, 0]), int(spans[k, 1])):
                weight, at = load(weights, kept), y * TILE
                kept += TILE
                red = red + weight * load(work, at + PIXELS)
                green = green + weight * load(work, at + 2 * PIXELS)
                blue = blue + weight * load(work, at + 3 * PIXELS)
            slot = places[k]
            sums[slot, 0], sums[slot, 1], sums[slot, 2] = total(red), total(green), total(blue)


@kernel
@no_type_check
def _blend_one_and_keep(splats, entries, rows, values, x0, y0, work, weights):
    """Blend one channel as `_blend_and_keep` does three: planes transmittance and value."""
    kept = 0
    for k in range(entries.shape[0]):
        s = entries[k]
        fetch_ahead(splats, entries, k)
        fetch_ahead(values, entries, k)
        mx, my, a, b, c, d, _, _ = splat_shape(splats, s, x0, y0)
        value = values[s]
        dx = lanes() - mx
        across = dx * dx * a + d
        for y in range(int(rows[k, 0]), int(rows[k, 1])):
            dy = float32(y) - my
            at = y * TILE
            before = load(work, at)
            weight = smaller(alpha_row(across, dx, b * dy, c * dy * dy), MAX_ALPHA) * before
            store(work, at, before - weight)
            store(work, at + PIXELS, load(work, at + PIXELS) + weight * value)
            store(weights, kept, weight)
            kept += TILE


@kernel(parallel=True)
@no_type_check
def transpose_residual(splats, start, entries, rows, slots, values, target, sums):
    """Fill `sums (e, 1)` with `blend_transpose` of `target (h, w)` less the image of `values (m,)`."""
    for tile in prange(start.shape[0] - 1):
        x0, y0, work = open_tile(tile, target.shape[1], 2)
        listed, places = entries[start[tile] : start[tile + 1]], slots[start[tile] : start[tile + 1]]
        spans = rows[start[tile] : start[tile + 1]]
        weights = np.empty(_count(spans) * TILE, np.float32)
        _blend_one_and_keep(splats, listed, spans, values, float32(x0), float32(y0), work, weights)
        image = work[PIXELS:].copy()
        work[PIXELS:] = ZERO
        differs = False
        for y in range(y0, min(y0 + TILE, target.shape[0])):
            for x in range(x0, min(x0 + TILE, target.shape[1])):
                at = (y - y0) * TILE + x - x0
                work[PIXELS + at] = target[y, x] - image[at]
                differs |= work[PIXELS + at] != ZERO
        if not differs:
            for k in range(listed.shape[0]):
                sums[places[k], 0] = ZERO
            continue
        kept = 0
        for k in range(listed.shape[0]):
            added = broadcast(ZERO)
            for y in range(int(spans[k, 0]), int(spans[k, 1])):
                added = added + load(weights, kept) * load(work, PIXELS + y * TILE)
                kept += TILE
            sums[places[k], 0] = total(added)
