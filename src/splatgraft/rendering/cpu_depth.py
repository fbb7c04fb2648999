"""Depth on the CPU: the median depth of each pixel, and colours with blended inverse depth: numba kernels.

The inverse depth of a plane is linear in the pixel. So a flat Gaussian has the depth of its plane in every pixel that
it covers (`inverse_depths` of `cpu_project.project`), not the depth of its centre.
"""

from typing import no_type_check

from numba import float32, prange

from splatgraft.rendering.cpu_blend import (
    BATCH,
    HALF,
    MAX_ALPHA,
    MOMENTS,
    ONE,
    PIXELS,
    ZERO,
    alpha_row,
    exponent_gradient,
    fetch_ahead,
    open_rest,
    open_tile,
    read_tile,
    saturated,
    splat_shape,
    write_moments,
)
from splatgraft.rendering.cpu_project import AT_CENTER, SLOPE_X, SLOPE_Y
from splatgraft.rendering.cpu_simd import (
    broadcast,
    lanes,
    larger,
    load,
    smaller,
    store,
    total,
    where_at_least,
    where_below,
)
from splatgraft.rendering.cpu_tiles import TILE
from splatgraft.runtime.kernels import kernel

CHANNELS = 4  # red, green, blue, inverse depth
_LEAST, _MOST = float32(1 / 4), float32(4)
"""Bounds on inverse depth, over the one at the centre: a wide splat's faint rim reaches beyond its plane's horizon."""


@kernel(parallel=True)
@no_type_check
def median_depth(splats, start, entries, inverse_depths, depth):
    """Fill `depth (h, w)` with the depth at which the transmittance falls below one half; 0 if it never does."""
    for tile in prange(start.shape[0] - 1):
        x0, y0, work = open_tile(tile, depth.shape[1], 2)
        for k in range(start[tile], start[tile + 1]):
            s = entries[k]
            fetch_ahead(splats, entries, k)
            fetch_ahead(inverse_depths, entries, k)
            mx, my, a, b, c, d, top, bottom = splat_shape(splats, s, float32(x0), float32(y0))
            dx = lanes() - mx
            across = dx * dx * a + d
            center, slope_y = inverse_depths[s, AT_CENTER], inverse_depths[s, SLOPE_Y]
            plane_x, least = center + dx * inverse_depths[s, SLOPE_X], broadcast(_LEAST * center)
            for y in range(top, bottom):
                dy = float32(y) - my
                at = y * TILE
                before = load(work, at)
                after = before - smaller(alpha_row(across, dx, b * dy, c * dy * dy), MAX_ALPHA) * before
                store(work, at, after)
                inverse = larger(smaller(plane_x + slope_y * dy, _MOST * center), least)
                crossing = where_below(after, HALF, where_at_least(before, HALF, inverse))
                store(work, at + PIXELS, load(work, at + PIXELS) + crossing)
            if (k - start[tile]) % BATCH == BATCH - 1 and saturated(work, HALF):
                break
        for y in range(y0, min(y0 + TILE, depth.shape[0])):
            for x in range(x0, min(x0 + TILE, depth.shape[1])):
                inverse = work[PIXELS + (y - y0) * TILE + x - x0]
                depth[y, x] = ONE / inverse if inverse > ZERO else ZERO


@kernel
@no_type_check
def _blend_tile(splats, entries, values, inverse_depths, x0, y0, work, least):
    """Planes of `work`: transmittance, red, green, blue, inverse depth."""
    for k in range(entries.shape[0]):
        s = entries[k]
        fetch_ahead(splats, entries, k)
        fetch_ahead(values, entries, k)
        fetch_ahead(inverse_depths, entries, k)
        mx, my, a, b, c, d, top, bottom = splat_shape(splats, s, x0, y0)
        red, green, blue = values[s, 0], values[s, 1], values[s, 2]
        dx = lanes() - mx
        across = dx * dx * a + d
        plane_x = inverse_depths[s, AT_CENTER] + dx * inverse_depths[s, SLOPE_X]
        slope_y = inverse_depths[s, SLOPE_Y]
        for y in range(top, bottom):
            dy = float32(y) - my
            at = y * TILE
            before = load(work, at)
            weight = smaller(alpha_row(across, dx, b * dy, c * dy * dy), MAX_ALPHA) * before
            store(work, at, before - weight)
            store(work, at + PIXELS, load(work, at + PIXELS) + weight * red)
            store(work, at + 2 * PIXELS, load(work, at + 2 * PIXELS) + weight * green)
            store(work, at + 3 * PIXELS, load(work, at + 3 * PIXELS) + weight * blue)
            store(work, at + 4 * PIXELS, load(work, at + 4 * PIXELS) + weight * (plane_x + slope_y * dy))
        if k % BATCH == BATCH - 1 and saturated(work, least):
            break


@kernel(parallel=True)
@no_type_check
def blend(splats, start, entries, values, inverse_depths, image, alpha, least):
    """Fill `image (4, h, w)` with blended `values (m, 3)` and inverse depth over black, and `alpha (h, w)`.

    `inverse_depths (m, 3)`. A tile is done when every pixel's transmittance is below `least`.
    """
    for tile in prange(start.shape[0] - 1):
        x0, y0, work = open_tile(tile, alpha.shape[1], 1 + CHANNELS)
        listed = entries[start[tile] : start[tile + 1]]
        _blend_tile(splats, listed, values, inverse_depths, float32(x0), float32(y0), work, least)
        for y in range(y0, min(y0 + TILE, alpha.shape[0])):
            for x in range(x0, min(x0 + TILE, alpha.shape[1])):
                at = (y - y0) * TILE + x - x0
                alpha[y, x] = ONE - work[at]
                for c in range(CHANNELS):
                    image[c, y, x] = work[(c + 1) * PIXELS + at]


@kernel
@no_type_check
def _backward_tile(splats, entries, slots, values, inverse_depths, x0, y0, work, sums, least):
    """Planes of `work`: transmittance, rest, gradients of alpha, red, green, blue and inverse depth."""
    for k in range(entries.shape[0]):
        s, slot = entries[k], slots[k]
        fetch_ahead(splats, entries, k)
        fetch_ahead(values, entries, k)
        fetch_ahead(inverse_depths, entries, k)
        mx, my, a, b, c, d, top, bottom = splat_shape(splats, s, x0, y0)
        red, green, blue = values[s, 0], values[s, 1], values[s, 2]
        dx = lanes() - mx
        across = dx * dx * a + d
        plane_x = inverse_depths[s, AT_CENTER] + dx * inverse_depths[s, SLOPE_X]
        slope_y = inverse_depths[s, SLOPE_Y]
        s0, sy, syy = broadcast(ZERO), broadcast(ZERO), broadcast(ZERO)
        sum_red, sum_green, sum_blue = broadcast(ZERO), broadcast(ZERO), broadcast(ZERO)
        sum_inverse, sum_inverse_y = broadcast(ZERO), broadcast(ZERO)
        for y in range(top, bottom):
            dy = float32(y) - my
            at = y * TILE
            before = load(work, at)
            uncapped = alpha_row(across, dx, b * dy, c * dy * dy)
            alpha = smaller(uncapped, MAX_ALPHA)
            weight = alpha * before
            to_red, to_green = load(work, at + 3 * PIXELS), load(work, at + 4 * PIXELS)
            to_blue, to_inverse = load(work, at + 5 * PIXELS), load(work, at + 6 * PIXELS)
            value = load(work, at + 2 * PIXELS) + to_red * red + to_green * green + to_blue * blue
            value = value + to_inverse * (plane_x + slope_y * dy)
            left = load(work, at + PIXELS) - weight * value
            store(work, at, before - weight)
            store(work, at + PIXELS, left)
            pull = exponent_gradient(uncapped, alpha, before, value, left)
            s0, sy, syy = s0 + pull, sy + pull * dy, syy + pull * (dy * dy)
            sum_red, sum_green = sum_red + weight * to_red, sum_green + weight * to_green
            sum_blue = sum_blue + weight * to_blue
            by_inverse = weight * to_inverse
            sum_inverse, sum_inverse_y = sum_inverse + by_inverse, sum_inverse_y + by_inverse * dy
        write_moments(sums, slot, dx, s0, sy, syy)
        at = MOMENTS
        sums[slot, at], sums[slot, at + 1], sums[slot, at + 2] = total(sum_red), total(sum_green), total(sum_blue)
        sums[slot, at + 3 + AT_CENTER], sums[slot, at + 3 + SLOPE_X] = total(sum_inverse), total(sum_inverse * dx)
        sums[slot, at + 3 + SLOPE_Y] = total(sum_inverse_y)
        if k % BATCH == BATCH - 1 and saturated(work, least):
            return k + 1
    return entries.shape[0]


@kernel(parallel=True)
@no_type_check
def blend_backward(
    splats, start, entries, slots, values, inverse_depths, image, alpha, grad_image, grad_alpha, sums, least
):  # fmt: skip
    """Fill `sums (e, 6 + 3 + 3)`: for every entry the moments, and the gradients of values and inverse depth."""
    for tile in prange(start.shape[0] - 1):
        x0, y0, work = open_tile(tile, alpha.shape[1], 3 + CHANNELS)
        listed, places = entries[start[tile] : start[tile + 1]], slots[start[tile] : start[tile + 1]]
        read_tile(grad_alpha, x0, y0, work, 2)
        for c in range(CHANNELS):
            read_tile(grad_image[c], x0, y0, work, 3 + c)
        open_rest(image, alpha, grad_image, grad_alpha, x0, y0, work)
        used = _backward_tile(
            splats, listed, places, values, inverse_depths, float32(x0), float32(y0), work, sums, least
        )
        for k in range(used, listed.shape[0]):
            sums[places[k]] = ZERO
