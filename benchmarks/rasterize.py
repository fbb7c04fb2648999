"""Measure the time of the CPU rasteriser on random 2D splats, with one thread.

Forward is blending; backward gives the gradients of every splat's centre, shape, opacity and colour. Both are CPU times
with given tile lists. Sorting and listing are measured separately.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import set_num_threads

from splatgraft.rendering import cpu_blend, cpu_project, cpu_tiles

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
    """Return random splats: uniform centres, opacities and depths; log-normal axes, any direction."""
    rng = np.random.default_rng(seed)
    means = rng.random((COUNT, 2)) * [WIDTH, HEIGHT]
    axes = np.exp(rng.normal(0, 0.6, (COUNT, 2))) * SCALE_PX
    angle = rng.random(COUNT) * np.pi
    turn = np.stack([np.stack([np.cos(angle), -np.sin(angle)], 1), np.stack([np.sin(angle), np.cos(angle)], 1)], 1)
    inverse = np.einsum("nij,nj,nkj->nik", turn, axes**-2, turn)
    conics = np.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], 1)
    parts = (means, conics, rng.random(COUNT), rng.random((COUNT, 3)), rng.random(COUNT))
    return Splats(*(part.astype(np.float32) for part in parts))


def median_ms(function: Callable[[], object]) -> float:
    function()
    times = []
    for _ in range(REPEATS):
        begin = time.process_time()
        function()
        times.append(time.process_time() - begin)
    return 1e3 * float(np.median(times))


def kernel_splats(splats: Splats) -> np.ndarray:
    """Return the rows that `cpu_project.project` would give."""
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

    print(f"{COUNT} splats, {WIDTH}x{HEIGHT}, one thread, CPU-ms, median of {REPEATS}")
    print(f"sort and list: {median_ms(sort_and_list):.1f} ({len(entries)} entries)")
    print(f"transposed blend: {median_ms(transpose):.1f}")
    print(f"forward_ms={median_ms(forward):.1f} backward_ms={median_ms(backward):.1f}")


if __name__ == "__main__":
    main()
