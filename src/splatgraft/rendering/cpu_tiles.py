"""Depth order (radix sort) and tile lists of 2D splats: numba kernels."""

import math
from typing import no_type_check

import numpy as np
from numba import prange

from splatgraft.rendering.cpu_project import CA, CB, CC, COLUMNS, LOG_OPACITY, MX, MY, REACH_X, REACH_Y
from splatgraft.rendering.cpu_simd import prefetch
from splatgraft.runtime.kernels import kernel

TILE = 16
_DIGIT_BITS = 11
_AHEAD = 16  # splats
_CHUNKS = 8  # parts of the splats that are listed side by side


@kernel
@no_type_check
def depth_order(splats, depths):
    """Sort the splats with a finite log opacity by depth, nearest first; equal depths stay in index order."""
    n = depths.shape[0]
    keys, order = np.empty(n, np.uint32), np.empty(n, np.int32)
    bits = depths.view(np.uint32)
    m = 0
    for g in range(n):
        if splats[g, LOG_OPACITY] > -np.inf:
            # positive floats order like their bits
            keys[m], order[m] = bits[g], g
            m += 1
    keys, order = keys[:m], order[:m]
    other_keys, other_order = np.empty(m, np.uint32), np.empty(m, np.int32)
    start = np.empty((1 << _DIGIT_BITS) + 1, np.int64)
    for digit in range(3):
        shift, mask = np.uint32(digit * _DIGIT_BITS), np.uint32((1 << _DIGIT_BITS) - 1)
        start[:] = 0
        for s in range(m):
            start[((keys[s] >> shift) & mask) + 1] += 1
        for i in range(1 << _DIGIT_BITS):
            start[i + 1] += start[i]
        for s in range(m):
            place = (keys[s] >> shift) & mask
            other_keys[start[place]], other_order[start[place]] = keys[s], order[s]
            start[place] += 1
        keys, other_keys, order, other_order = other_keys, keys, other_order, order
    return order


@kernel
@no_type_check
def _tile_span(splat, row, tiles_x):
    """Compute the first and one past the last tile of tile row `row` that the ellipse alpha >= 1/255 meets."""
    my = float(splat[MY])
    low, high = row * TILE - my, (row + 1) * TILE - my
    # the ellipse is a x^2 + 2 b x y + c y^2 <= limit; its rightmost point has y = -b / c * x
    a, b, c = float(splat[CA]), float(splat[CB]), float(splat[CC])
    reach_x, reach_y = float(splat[REACH_X]), float(splat[REACH_Y])
    limit = reach_x * reach_x * (a - b * b / c)
    low, high = max(low, -reach_y), min(high, reach_y)
    at_right = -b / c * reach_x
    y_right, y_left = min(max(at_right, low), high), min(max(-at_right, low), high)
    right = (-b * y_right + math.sqrt(max(b * b * y_right * y_right - a * (c * y_right * y_right - limit), 0.0))) / a
    left = (-b * y_left - math.sqrt(max(b * b * y_left * y_left - a * (c * y_left * y_left - limit), 0.0))) / a
    # a thousandth of a pixel covers the rounding here; the kernels test every pixel exactly
    first = (splat[MX] + left - 1e-3) / TILE
    last = (splat[MX] + right + 1e-3) / TILE
    return int(max(min(first, 1e6), 0.0)), int(max(min(last + 1.0, float(tiles_x)), 0.0))


@kernel
@no_type_check
def _tile_range(middle, reach, tiles):
    """Compute the first and one past the last tile, along one axis, that an ellipse of this half width can meet."""
    low = (middle - reach - 1e-3) / TILE
    high = (middle + reach + 1e-3) / TILE
    # truncation is floor, because no value is below 0
    return int(max(min(low, 1e6), 0.0)), int(max(min(high + 1.0, float(tiles)), 0.0))


@kernel(parallel=True)
@no_type_check
def _pack(splats, order, tiles_y, packed, row_counts):
    """Fill `packed (m, 8)` with the splats by `order`, and `row_counts (m,)` with how many tile rows each meets."""
    m = order.shape[0]
    for chunk in prange(_CHUNKS):
        for s in range(m * chunk // _CHUNKS, m * (chunk + 1) // _CHUNKS):
            g = order[s]
            if s + _AHEAD < m:
                prefetch(splats, order[s + _AHEAD])
            for column in range(COLUMNS):
                packed[s, column] = splats[g, column]
            top, bottom = _tile_range(packed[s, MY], packed[s, REACH_Y], tiles_y)
            row_counts[s] = max(bottom - top, 0)


@kernel(parallel=True)
@no_type_check
def _count(packed, first_row, tiles_x, tiles_y, spans, listed, counts):
    """Compute the tiles of every splat, and count the splats of every tile.

    Args:
        packed: (m, 8) splats.
        first_row: (m + 1,) begin of each splat's rows in `spans`.
        spans: (r, 2) filled with the first and one past the last tile of each tile row that a splat meets.
        listed: (m,) filled with each splat's number of tiles.
        counts: (chunks, tiles) zeros, to which the number of splats in each tile is added.
    """
    m = packed.shape[0]
    for chunk in prange(_CHUNKS):
        for s in range(m * chunk // _CHUNKS, m * (chunk + 1) // _CHUNKS):
            top, _ = _tile_range(packed[s, MY], packed[s, REACH_Y], tiles_y)
            low, high = _tile_range(packed[s, MX], packed[s, REACH_X], tiles_x)
            number = 0
            for place in range(first_row[s], first_row[s + 1]):
                row, left, right = top + place - first_row[s], low, high
                if high - low > 1:
                    left, right = _tile_span(packed[s], row, tiles_x)
                spans[place, 0], spans[place, 1] = left, max(left, right)
                for tile in range(row * tiles_x + left, row * tiles_x + right):
                    counts[chunk, tile] += 1
                number += max(right - left, 0)
            listed[s] = number


@kernel(parallel=True)
@no_type_check
def _list(packed, first_row, tiles_x, tiles_y, spans, first, free, entries, slots):
    """Fill the tiles' lists; `free (chunks, tiles)` is the place of each chunk's next entry in each tile."""
    m = packed.shape[0]
    for chunk in prange(_CHUNKS):
        for s in range(m * chunk // _CHUNKS, m * (chunk + 1) // _CHUNKS):
            slot = first[s]
            top, _ = _tile_range(packed[s, MY], packed[s, REACH_Y], tiles_y)
            for place in range(first_row[s], first_row[s + 1]):
                row_at = (top + place - first_row[s]) * tiles_x
                for tile in range(row_at + spans[place, 0], row_at + spans[place, 1]):
                    at = free[chunk, tile]
                    entries[at], slots[at] = s, slot
                    free[chunk, tile] = at + 1
                    slot += 1


@kernel
@no_type_check
def _sums_before(values):
    """Compute the sum of the values before each place, and of all at the end."""
    sums = np.zeros(values.shape[0] + 1, np.int32)
    for i in range(values.shape[0]):
        sums[i + 1] = sums[i] + values[i]
    return sums


@kernel
@no_type_check
def bin_splats(splats, order, width, height):
    """Sort the splats by `order` and list them tile by tile.

    Returns:
        sorted: (m, 8) splats.
        start: (tiles + 1,) begin of each tile's list in `entries` and `slots`.
        entries: (e,) index of the splat, nearest first.
        slots: (e,) row of the entry's sums; splat s has the rows `first[s]` to `first[s + 1]`.
        first: (m + 1,) begin of each splat's slots.
    """
    m = order.shape[0]
    tiles_x, tiles_y = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    packed, numbers = np.empty((m, COLUMNS), np.float32), np.empty(m, np.int32)
    _pack(splats, order, tiles_y, packed, numbers)
    first_row = _sums_before(numbers)
    spans = np.empty((first_row[m], 2), np.int32)
    counts = np.zeros((_CHUNKS, tiles_x * tiles_y), np.int32)
    _count(packed, first_row, tiles_x, tiles_y, spans, numbers, counts)
    first = _sums_before(numbers)
    start = np.zeros(tiles_x * tiles_y + 1, np.int32)
    for tile in range(tiles_x * tiles_y):
        # counts become places: the chunks' entries of a tile follow each other, nearest first
        at = start[tile]
        for chunk in range(_CHUNKS):
            number = counts[chunk, tile]
            counts[chunk, tile] = at
            at += number
        start[tile + 1] = at
    entries, slots = np.empty(first[m], np.int32), np.empty(first[m], np.int32)
    _list(packed, first_row, tiles_x, tiles_y, spans, first, counts, entries, slots)
    return packed, start, entries, slots, first
