"""Alpha blending of tile lists, forward, backward and transposed: numba kernels.

A tile is processed row by row, 16 pixels at once (`cpu_simd`), in planes of float32 inside one array. Inner loops have
no branch, call or reduction; exp is a polynomial and multiplications. Sums are held in registers for colours (3
channels), and in memory for any other number of channels.
"""

import math
from typing import no_type_check

import numpy as np
from numba import float32, prange

from splatgraft.rendering.cpu_project import CA, CB, CC, LOG_OPACITY, MIN_ALPHA, MX, MY, REACH_Y
from splatgraft.rendering.cpu_simd import (
    broadcast,
    lanes,
    larger,
    largest,
    load,
    prefetch,
    smaller,
    store,
    total,
    where_at_least,
    where_below,
)
from splatgraft.rendering.cpu_tiles import TILE
from splatgraft.runtime.kernels import kernel

PIXELS = TILE * TILE
BATCH = 32
AHEAD = 8  # entries
RGB = 3
MAX_ALPHA = float32(0.99)
MIN_TRANSMITTANCE = np.float32(1e-4)
ALL = np.float32(0)
"""Bound on the transmittance with which every list is rendered to its end."""
MOMENTS = 6  # sums of an entry for `project_backward`

ONE, ZERO, HALF = float32(1), float32(0), float32(0.5)
# alpha = exp(x)^16 with x in [log(1/255) / 16, 0]; there the polynomial is exp to 1e-7 (Chebyshev interpolation)
SIXTEENTH = float32(1 / 16)
LOWEST = float32(math.log(MIN_ALPHA) / 16)
E0, E1, E2, E3, E4 = (float32(x) for x in (0.99999994, 0.9999898, 0.49976337, 0.16472879, 0.035080757))


@kernel
@no_type_check
def splat_shape(splats, s, x0, y0):
    """Compute a splat's centre in the tile, quadratic a, b, c and constant over 16, first and one past the last row."""
    mx, my = splats[s, MX] - x0 - HALF, splats[s, MY] - y0 - HALF
    # a thousandth of a pixel covers rounding, and each pixel is tested exactly; truncation is floor above 0
    reach = splats[s, REACH_Y] + float32(1e-3)
    top = int(max(my - reach + ONE, ZERO))
    bottom = int(max(min(my + reach + ONE, float32(TILE)), ZERO))
    a, b, c = -HALF * SIXTEENTH * splats[s, CA], -SIXTEENTH * splats[s, CB], -HALF * SIXTEENTH * splats[s, CC]
    return mx, my, a, b, c, SIXTEENTH * splats[s, LOG_OPACITY], top, bottom


@kernel
@no_type_check
def fetch_ahead(array, entries, k):
    """Begin to read the row of `array` that a later entry needs, because entries are spread over all splats."""
    if k + AHEAD < entries.shape[0]:
        prefetch(array, entries[k + AHEAD])


@kernel
@no_type_check
def kept_rows(rows, k, top, bottom):
    """Return the first and one past the last row of entry k from `rows (e, 2)`, or `top`, `bottom` if that is empty."""
    if rows.shape[0] > 0:
        return int(rows[k, 0]), int(rows[k, 1])
    return top, bottom


@kernel
@no_type_check
def alpha_row(across, dx, along, down):
    """Compute a row of alpha, not capped, 0 below 1/255; its exponent over 16 is `across` + `along` dx + `down`."""
    x = across + dx * along + down
    e = (((x * E4 + E3) * x + E2) * x + E1) * x + E0
    e = e * e
    e = e * e
    e = e * e
    e = e * e
    return where_at_least(x, LOWEST, e)


@kernel
@no_type_check
def saturated(work, least):
    """Test whether the transmittance of all pixels of the tile is below `least`."""
    most = load(work, 0)
    for y in range(1, TILE):
        most = larger(most, load(work, y * TILE))
    return largest(most) < least


@kernel
@no_type_check
def _blend_rgb(splats, entries, rows, values, x0, y0, work, least):
    """Planes of `work`: transmittance, red, green, blue."""
    for k in range(entries.shape[0]):
        s = entries[k]
        fetch_ahead(splats, entries, k)
        fetch_ahead(values, entries, k)
        mx, my, a, b, c, d, top, bottom = splat_shape(splats, s, x0, y0)
        top, bottom = kept_rows(rows, k, top, bottom)
        red, green, blue = values[s, 0], values[s, 1], values[s, 2]
        dx = lanes() - mx
        across = dx * dx * a + d
        for y in range(top, bottom):
            dy = float32(y) - my
            at = y * TILE
            before = load(work, at)
            weight = smaller(alpha_row(across, dx, b * dy, c * dy * dy), MAX_ALPHA) * before
            store(work, at, before - weight)
            store(work, at + PIXELS, load(work, at + PIXELS) + weight * red)
            store(work, at + 2 * PIXELS, load(work, at + 2 * PIXELS) + weight * green)
            store(work, at + 3 * PIXELS, load(work, at + 3 * PIXELS) + weight * blue)
        if k % BATCH == BATCH - 1 and saturated(work, least):
            break


@kernel
@no_type_check
def _blend_any(splats, entries, rows, values, x0, y0, work, least):
    """Planes of `work`: transmittance, then the channels."""
    for k in range(entries.shape[0]):
        s = entries[k]
        fetch_ahead(splats, entries, k)
        fetch_ahead(values, entries, k)
        mx, my, a, b, c, d, top, bottom = splat_shape(splats, s, x0, y0)
        top, bottom = kept_rows(rows, k, top, bottom)
        dx = lanes() - mx
        across = dx * dx * a + d
        for y in range(top, bottom):
            dy = float32(y) - my
            at = y * TILE
            before = load(work, at)
            weight = smaller(alpha_row(across, dx, b * dy, c * dy * dy), MAX_ALPHA) * before
            store(work, at, before - weight)
            for channel in range(values.shape[1]):
                at += PIXELS
                store(work, at, load(work, at) + weight * values[s, channel])
        if k % BATCH == BATCH - 1 and saturated(work, least):
            break


@kernel
@no_type_check
def open_tile(tile, width, planes):
    """Return the corner of the tile and its planes: transmittance 1, the others 0."""
    tiles_x = (width + TILE - 1) // TILE
    work = np.zeros(planes * PIXELS, np.float32)
    work[:PIXELS] = ONE
    return (tile % tiles_x) * TILE, (tile // tiles_x) * TILE, work


@kernel(parallel=True)
@no_type_check
def blend(splats, start, entries, rows, values, image, alpha, least):
    """Fill `image (c, h, w)` with blended `values (m, c)` over black, and `alpha (h, w)`.

    `rows (e, 2)`: first and one past the last row of each entry that counts; empty if all rows of the splat count. A
    tile is done when every pixel's transmittance is below `least`; this is tested once per batch of splats.
    """
    channels = values.shape[1]
    for tile in prange(start.shape[0] - 1):
        x0, y0, work = open_tile(tile, alpha.shape[1], 1 + channels)
        listed, spans = entries[start[tile] : start[tile + 1]], rows[start[tile] : start[tile + 1]]
        if channels == RGB:
            _blend_rgb(splats, listed, spans, values, float32(x0), float32(y0), work, least)
        else:
            _blend_any(splats, listed, spans, values, float32(x0), float32(y0), work, least)
        for y in range(y0, min(y0 + TILE, alpha.shape[0])):
            for x in range(x0, min(x0 + TILE, alpha.shape[1])):
                at = (y - y0) * TILE + x - x0
                alpha[y, x] = ONE - work[at]
                for c in range(channels):
                    image[c, y, x] = work[(c + 1) * PIXELS + at]


@kernel
@no_type_check
def read_tile(image, x0, y0, work, plane):
    """Copy the tile at x0, y0 of `image (h, w)` into a plane, which stays 0 outside the image."""
    for y in range(y0, min(y0 + TILE, image.shape[0])):
        for x in range(x0, min(x0 + TILE, image.shape[1])):
            work[plane * PIXELS + (y - y0) * TILE + x - x0] = image[y, x]


@kernel
@no_type_check
def _transpose_rgb(splats, entries, rows, slots, x0, y0, work, sums, least):
    """Planes of `work`: transmittance, red, green, blue."""
    for k in range(entries.shape[0]):
        fetch_ahead(splats, entries, k)
        mx, my, a, b, c, d, top, bottom = splat_shape(splats, entries[k], x0, y0)
        top, bottom = kept_rows(rows, k, top, bottom)
        dx = lanes() - mx
        across = dx * dx * a + d
        red, green, blue = broadcast(ZERO), broadcast(ZERO), broadcast(ZERO)
        for y in range(top, bottom):
            dy = float32(y) - my
            at = y * TILE
            before = load(work, at)
            weight = smaller(alpha_row(across, dx, b * dy, c * dy * dy), MAX_ALPHA) * before
            store(work, at, before - weight)
            red = red + weight * load(work, at + PIXELS)
            green = green + weight * load(work, at + 2 * PIXELS)
            blue = blue + weight * load(work, at + 3 * PIXELS)
        slot = slots[k]
        sums[slot, 0], sums[slot, 1], sums[slot, 2] = total(red), total(green), total(blue)
        if k % BATCH == BATCH - 1 and saturated(work, least):
            return k + 1
    return entries.shape[0]


@kernel
@no_type_check
def _transpose_any(splats, entries, rows, slots, x0, y0, work, sums, least):
    """Planes of `work`: transmittance, then the channels of the image."""
    channels = sums.shape[1]
    column = np.empty(channels * TILE, np.float32)
    for k in range(entries.shape[0]):
        fetch_ahead(splats, entries, k)
        mx, my, a, b, c, d, top, bottom = splat_shape(splats, entries[k], x0, y0)
        top, bottom = kept_rows(rows, k, top, bottom)
        dx = lanes() - mx
        across = dx * dx * a + d
        column[:] = ZERO
        for y in range(top, bottom):
            dy = float32(y) - my
            at = y * TILE
            before = load(work, at)
            weight = smaller(alpha_row(across, dx, b * dy, c * dy * dy), MAX_ALPHA) * before
            store(work, at, before - weight)
            for channel in range(channels):
                at += PIXELS
                store(column, channel * TILE, load(column, channel * TILE) + weight * load(work, at))
        for channel in range(channels):
            sums[slots[k], channel] = total(load(column, channel * TILE))
        if k % BATCH == BATCH - 1 and saturated(work, least):
            return k + 1
    return entries.shape[0]


@kernel(parallel=True)
@no_type_check
def blend_transpose(splats, start, entries, rows, slots, image, sums, least):
    """Fill `sums (e, c)`: for every entry, the sum over its pixels of weight times `image (c, h, w)`.

    `rows` has the meaning that it has in `blend`.
    """
    channels = image.shape[0]
    for tile in prange(start.shape[0] - 1):
        x0, y0, work = open_tile(tile, image.shape[2], 1 + channels)
        listed, places = entries[start[tile] : start[tile + 1]], slots[start[tile] : start[tile + 1]]
        spans = rows[start[tile] : start[tile + 1]]
        for c in range(channels):
            read_tile(image[c], x0, y0, work, 1 + c)
        if channels == RGB:
            used = _transpose_rgb(splats, listed, spans, places, float32(x0), float32(y0), work, sums, least)
        else:
            used = _transpose_any(splats, listed, spans, places, float32(x0), float32(y0), work, sums, least)
        for k in range(used, listed.shape[0]):
            sums[places[k]] = ZERO


@kernel
@no_type_check
def write_moments(sums, slot, dx, s0, sy, syy):
    """Write an entry's moments from column sums: of the exponent's gradient, of it times dy, and times dy squared."""
    sx = s0 * dx
    sums[slot, 0], sums[slot, 1], sums[slot, 2] = total(s0), total(sx), total(sy)
    sums[slot, 3], sums[slot, 4], sums[slot, 5] = total(sx * dx), total(sy * dx), total(syy)


@kernel
@no_type_check
def exponent_gradient(uncapped, alpha, before, value, left):
    """Compute the gradient of the loss by the exponent for a row; 0 where alpha is capped."""
    return where_below(uncapped, MAX_ALPHA, alpha * (before * value - left / (ONE - alpha)))


@kernel
@no_type_check
def _backward_rgb(splats, entries, slots, values, x0, y0, work, sums, least):
    """Planes of `work`: transmittance, rest, gradients of alpha, red, green, blue."""
    for k in range(entries.shape[0]):
        s, slot = entries[k], slots[k]
        fetch_ahead(splats, entries, k)
        fetch_ahead(values, entries, k)
        mx, my, a, b, c, d, top, bottom = splat_shape(splats, s, x0, y0)
        red, green, blue = values[s, 0], values[s, 1], values[s, 2]
        dx = lanes() - mx
        across = dx * dx * a + d
        s0, sy, syy = broadcast(ZERO), broadcast(ZERO), broadcast(ZERO)
        sum_red, sum_green, sum_blue = broadcast(ZERO), broadcast(ZERO), broadcast(ZERO)
        for y in range(top, bottom):
            dy = float32(y) - my
            at = y * TILE
            before = load(work, at)
            uncapped = alpha_row(across, dx, b * dy, c * dy * dy)
            alpha = smaller(uncapped, MAX_ALPHA)
            weight = alpha * before
            to_red, to_green = load(work, at + 3 * PIXELS), load(work, at + 4 * PIXELS)
            to_blue = load(work, at + 5 * PIXELS)
            value = load(work, at + 2 * PIXELS) + to_red * red + to_green * green + to_blue * blue
            left = load(work, at + PIXELS) - weight * value
            store(work, at, before - weight)
            store(work, at + PIXELS, left)
            pull = exponent_gradient(uncapped, alpha, before, value, left)
            s0, sy, syy = s0 + pull, sy + pull * dy, syy + pull * (dy * dy)
            sum_red, sum_green = sum_red + weight * to_red, sum_green + weight * to_green
            sum_blue = sum_blue + weight * to_blue
        write_moments(sums, slot, dx, s0, sy, syy)
        sums[slot, MOMENTS] = total(sum_red)
        sums[slot, MOMENTS + 1] = total(sum_green)
        sums[slot, MOMENTS + 2] = total(sum_blue)
        if k % BATCH == BATCH - 1 and saturated(work, least):
            return k + 1
    return entries.shape[0]


@kernel
@no_type_check
def _backward_any(splats, entries, slots, values, x0, y0, work, sums, least):
    """Planes of `work`: transmittance, rest, gradients of alpha and of the channels."""
    channels = values.shape[1]
    column = np.empty(channels * TILE, np.float32)
    for k in range(entries.shape[0]):
        s, slot = entries[k], slots[k]
        fetch_ahead(splats, entries, k)
        fetch_ahead(values, entries, k)
        mx, my, a, b, c, d, top, bottom = splat_shape(splats, s, x0, y0)
        dx = lanes() - mx
        across = dx * dx * a + d
        s0, sy, syy = broadcast(ZERO), broadcast(ZERO), broadcast(ZERO)
        column[:] = ZERO
        for y in range(top, bottom):
            dy = float32(y) - my
            at = y * TILE
            before = load(work, at)
            uncapped = alpha_row(across, dx, b * dy, c * dy * dy)
            alpha = smaller(uncapped, MAX_ALPHA)
            weight = alpha * before
            value = load(work, at + 2 * PIXELS)
            for channel in range(channels):
                to_channel = load(work, at + (3 + channel) * PIXELS)
                value = value + to_channel * values[s, channel]
                store(column, channel * TILE, load(column, channel * TILE) + weight * to_channel)
            left = load(work, at + PIXELS) - weight * value
            store(work, at, before - weight)
            store(work, at + PIXELS, left)
            pull = exponent_gradient(uncapped, alpha, before, value, left)
            s0, sy, syy = s0 + pull, sy + pull * dy, syy + pull * (dy * dy)
        write_moments(sums, slot, dx, s0, sy, syy)
        for channel in range(channels):
            sums[slot, MOMENTS + channel] = total(load(column, channel * TILE))
        if k % BATCH == BATCH - 1 and saturated(work, least):
            return k + 1
    return entries.shape[0]


@kernel
@no_type_check
def open_rest(image, alpha, grad_image, grad_alpha, x0, y0, work):
    """Fill plane 1 of the tile with gradient times pixel, summed over channels and alpha: the part of all splats."""
    for y in range(y0, min(y0 + TILE, alpha.shape[0])):
        for x in range(x0, min(x0 + TILE, alpha.shape[1])):
            rest = grad_alpha[y, x] * alpha[y, x]
            for c in range(image.shape[0]):
                rest += grad_image[c, y, x] * image[c, y, x]
            work[PIXELS + (y - y0) * TILE + x - x0] = rest


@kernel(parallel=True)
@no_type_check
def blend_backward(splats, start, entries, slots, values, image, alpha, grad_image, grad_alpha, sums, least):
    """Fill `sums (e, 6 + c)`: for every entry the moments for `project_backward`, and the gradients of its values."""
    channels = values.shape[1]
    for tile in prange(start.shape[0] - 1):
        x0, y0, work = open_tile(tile, alpha.shape[1], 3 + channels)
        listed, places = entries[start[tile] : start[tile + 1]], slots[start[tile] : start[tile + 1]]
        read_tile(grad_alpha, x0, y0, work, 2)
        for c in range(channels):
            read_tile(grad_image[c], x0, y0, work, 3 + c)
        open_rest(image, alpha, grad_image, grad_alpha, x0, y0, work)
        if channels == RGB:
            used = _backward_rgb(splats, listed, places, values, float32(x0), float32(y0), work, sums, least)
        else:
            used = _backward_any(splats, listed, places, values, float32(x0), float32(y0), work, sums, least)
        for k in range(used, listed.shape[0]):
            sums[places[k]] = ZERO


@kernel(parallel=True)
@no_type_check
def gather(values, order, out):
    """Fill `out (m, c)` with the rows `order (m,)` of `values (n, c)`."""
    for part in prange((order.shape[0] + PIXELS - 1) // PIXELS):
        for s in range(part * PIXELS, min(order.shape[0], (part + 1) * PIXELS)):
            for c in range(values.shape[1]):
                out[s, c] = values[order[s], c]


@kernel(parallel=True)
@no_type_check
def sum_slots(sums, first, order, out):
    """Set `out (n, c)` at `order (m,)` to the sums over each splat's slots, in a fixed order."""
    for s in prange(first.shape[0] - 1):
        for c in range(sums.shape[1]):
            added = ZERO
            for slot in range(first[s], first[s + 1]):
                added += sums[slot, c]
            out[order[s], c] = added
