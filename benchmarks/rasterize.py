"""Time of the CPU rasteriser against a plain numba rasteriser, on random 2D splats, with one thread.

Forward is blending, backward the gradients of every splat's centre, shape, opacity and colour, both in CPU time with
tile lists given; sorting and listing are measured separately. The plain one has the same tiles, alpha bounds and early
stop, written pixel by pixel.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import float32, int32, njit, prange, set_num_threads

from splatgraft.rendering import cpu_blend, cpu_project, cpu_tiles

TILE = 16
COUNT, WIDTH, HEIGHT, SCALE_PX = 20_000, 320, 240, 2.5
REPEATS = 15


@dataclass(frozen=True)
class Splats:
    """Random 2D Gaussians."""

    means: np.ndarray
    conics: np.ndarray
    opacities: np.ndarray
    colors: np.ndarray
    depths: np.ndarray


def random_splats(seed: int = 0) -> Splats:
    """Uniform centres, opacities and depths; log-normal axes, any direction."""
    rng = np.random.default_rng(seed)
    means = rng.random((COUNT, 2)) * [WIDTH, HEIGHT]
    axes = np.exp(rng.normal(0, 0.6, (COUNT, 2))) * SCALE_PX
    angle = rng.random(COUNT) * np.pi
    turn = np.stack([np.stack([np.cos(angle), -np.sin(angle)], 1), np.stack([np.sin(angle), np.cos(angle)], 1)], 1)
    inverse = np.einsum("nij,nj,nkj->nik", turn, axes**-2, turn)
    conics = np.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], 1)
    parts = (means, conics, rng.random(COUNT), rng.random((COUNT, 3)), rng.random(COUNT))
    return Splats(*(part.astype(np.float32) for part in parts))


@njit
def plain_bin(means, reaches, order, tiles_x, tiles_y):
    """Tile lists of bounding boxes."""
    count = np.zeros(tiles_x * tiles_y + 1, np.int32)
    for step in range(2):
        if step == 1:
            start = np.cumsum(count).astype(np.int32)
            free, ids = start[:-1].copy(), np.empty(start[-1], np.int32)
        for g in order:
            left = max(0, math.floor((means[g, 0] - reaches[g]) / TILE))
            right = min(tiles_x, math.floor((means[g, 0] + reaches[g]) / TILE) + 1)
            top = max(0, math.floor((means[g, 1] - reaches[g]) / TILE))
            bottom = min(tiles_y, math.floor((means[g, 1] + reaches[g]) / TILE) + 1)
            for row in range(top, bottom):
                for column in range(left, right):
                    tile = row * tiles_x + column
                    if step == 0:
                        count[tile + 1] += 1
                    else:
                        ids[free[tile]] = g
                        free[tile] += 1
    return start, ids


@njit(fastmath=True, inline="always")
def plain_exp(x):
    """Taylor series of exp(x / 8), three times squared; x in [-5.6, 0]."""
    z = x * float32(0.125)
    p = float32(1 / 120) + z * float32(1 / 720)
    p = float32(1) + z * (float32(1) + z * (float32(0.5) + z * (float32(1 / 6) + z * (float32(1 / 24) + z * p))))
    p *= p
    p *= p
    return p * p


@njit(parallel=True, fastmath=True)
def plain_forward(means, conics, opacities, limits, colors, start, ids, image):  # noqa: PLR0913, PLR0917
    """Blend pixel by pixel over the exact span of every row."""
    height, width = image.shape[:2]
    tiles_x = (width + TILE - 1) // TILE
    for tile in prange(len(start) - 1):
        x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        through = np.ones((TILE, TILE), np.float32)
        tile_colors = np.zeros((TILE, TILE, 3), np.float32)
        for k in range(start[tile], start[tile + 1]):
            g = ids[k]
            if limits[g] <= 0:
                continue
            mx, my = means[g, 0] - x0 - float32(0.5), means[g, 1] - y0 - float32(0.5)
            a, b, c = conics[g, 0], conics[g, 1], conics[g, 2]
            reach = math.sqrt(2 * limits[g] * a / (a * c - b * b))
            for y in range(max(0, math.ceil(my - reach)), min(TILE, math.floor(my + reach) + 1)):
                dy = float32(y) - my
                cross, rest = b * dy, c * dy * dy
                inside = cross * cross - a * (rest - 2 * limits[g])
                if inside <= 0:
                    continue
                half = math.sqrt(inside)
                left = max(int32(0), int32(math.ceil(mx + (-cross - half) / a)))
                right = min(int32(TILE), int32(math.floor(mx + (-cross + half) / a)) + int32(1))
                for x in range(left, right):
                    dx = float32(x) - mx
                    power = float32(-0.5) * (a * dx * dx + rest) - cross * dx
                    weight = min(float32(0.99), opacities[g] * plain_exp(power)) * through[y, x]
                    through[y, x] -= weight
                    for channel in range(3):
                        tile_colors[y, x, channel] += weight * colors[g, channel]
            if (k - start[tile]) % 32 == 31 and through.max() < 1e-4:
                break
        for y in range(y0, min(y0 + TILE, height)):
            for x in range(x0, min(x0 + TILE, width)):
                image[y, x] = tile_colors[y - y0, x - x0]


def median_ms(function: Callable[[], object]) -> float:
    function()
    times = []
    for _ in range(REPEATS):
        begin = time.process_time()
        function()
        times.append(time.process_time() - begin)
    return 1e3 * float(np.median(times))


def kernel_splats(splats: Splats) -> np.ndarray:
    """The rows that `cpu_project.project` would give."""
    a, b, c = splats.conics.T
    limit = np.maximum(2 * np.log(np.maximum(splats.opacities, 1e-12) / cpu_project.MIN_ALPHA), 0)
    determinant = a * c - b * b
    log_opacity = np.where(limit > 0, np.log(np.maximum(splats.opacities, 1e-12)), -np.inf)
    reach_x, reach_y = np.sqrt(limit * c / determinant), np.sqrt(limit * a / determinant)
    columns = [*splats.means.T, a, b, c, log_opacity, reach_x, reach_y]
    return np.ascontiguousarray(np.stack(columns, 1), np.float32)


def main() -> None:
    set_num_threads(1)
    splats = random_splats()
    rows = kernel_splats(splats)
    order = cpu_tiles.depth_order(rows, splats.depths)
    packed, start, entries, slots, first = cpu_tiles.bin_splats(rows, order, WIDTH, HEIGHT)
    colors = splats.colors[order]
    image, alpha = np.empty((3, HEIGHT, WIDTH), np.float32), np.empty((HEIGHT, WIDTH), np.float32)
    gradients = np.random.default_rng(1).normal(size=(4, HEIGHT, WIDTH)).astype(np.float32)
    sums = np.empty((len(entries), cpu_blend.MOMENTS + 3), np.float32)
    color_sums = np.empty((len(entries), 3), np.float32)
    totals = np.zeros((COUNT, sums.shape[1]), np.float32)

    least, whole = cpu_blend.MIN_TRANSMITTANCE, np.empty((0, 2), np.uint8)

    def sort_and_list() -> None:
        cpu_tiles.bin_splats(rows, cpu_tiles.depth_order(rows, splats.depths), WIDTH, HEIGHT)

    def forward() -> None:
        cpu_blend.blend(packed, start, entries, whole, colors, image, alpha, least)

    def backward() -> None:
        cpu_blend.blend_backward(
            packed, start, entries, slots, colors, image, alpha, gradients[:3], gradients[3], sums, least
        )
        cpu_blend.sum_slots(sums, first, order, totals)

    def transpose() -> None:
        cpu_blend.blend_transpose(packed, start, entries, whole, slots, gradients[:3], color_sums, least)

    plain_image = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    limits = np.log(255 * splats.opacities)
    axes = np.linalg.eigvalsh(splats.conics[:, [0, 1, 1, 2]].reshape(-1, 2, 2))
    reaches = (3 / np.sqrt(axes[:, 0])).astype(np.float32)
    tiles = (WIDTH + TILE - 1) // TILE, (HEIGHT + TILE - 1) // TILE
    plain_start, plain_ids = plain_bin(splats.means, reaches, np.argsort(splats.depths), *tiles)

    def plain() -> None:
        plain_forward(
            splats.means, splats.conics, splats.opacities, limits, splats.colors, plain_start, plain_ids, plain_image
        )

    plain_listing = median_ms(lambda: plain_bin(splats.means, reaches, np.argsort(splats.depths), *tiles))
    forward_ms, backward_ms, plain_ms = median_ms(forward), median_ms(backward), median_ms(plain)
    difference = np.abs(image.transpose(1, 2, 0) - plain_image)
    print(f"{COUNT} splats, {WIDTH}x{HEIGHT}, one thread, CPU-ms, median of {REPEATS}")
    print(f"sort and list: {median_ms(sort_and_list):.1f} ({len(entries)} entries), plain {plain_listing:.1f}")
    print(f"transposed blend: {median_ms(transpose):.1f}")
    print(f"pictures differ by {difference.mean():.1e} on average, {difference.max():.1e} at most")
    print(f"forward_ms={forward_ms:.1f} backward_ms={backward_ms:.1f} prototype_forward_ms={plain_ms:.1f}")


if __name__ == "__main__":
    main()
