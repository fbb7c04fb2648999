"""The rows of each tile in which a splat has weight, so that views with frozen geometry blend these alone: numba.

Behind an opaque surface a splat's weights are all but 0 in most rows that it reaches.
"""

from typing import no_type_check

from numba import float32, prange

from splatgraft.rendering.cpu_blend import (
    BATCH,
    MAX_ALPHA,
    MIN_TRANSMITTANCE,
    ONE,
    PIXELS,
    alpha_row,
    open_tile,
    saturated,
    splat_shape,
)
from splatgraft.rendering.cpu_simd import lanes, load, smaller, store, total
from splatgraft.rendering.cpu_tiles import TILE
from splatgraft.runtime.kernels import kernel


@kernel(parallel=True)
@no_type_check
def find_rows(splats, start, entries, size, min_weight, rows):
    """Fill `rows (e, 2)`: first and one past the last row of each entry with more weight than a bound.

    `size`: height and width of the image, outside of which nothing counts. Both are 0 for entries without such a row.
    A tile is done when every pixel's transmittance is below `MIN_TRANSMITTANCE`.
    """
    height, width = size
    for tile in prange(start.shape[0] - 1):
        x0, y0, work = open_tile(tile, width, 2)
        for y in range(min(TILE, height - y0)):
            work[PIXELS + y * TILE : PIXELS + y * TILE + min(TILE, width - x0)] = ONE
        for k in range(start[tile], start[tile + 1]):
            rows[k, 0], rows[k, 1] = 0, 0
        for k in range(start[tile], start[tile + 1]):
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
