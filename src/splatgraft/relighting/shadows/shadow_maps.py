"""Shadow maps: depth maps splatted from Gaussians along many directions, and visibility of points from them.

Splats follow EWA (Zwicker et al. 2001). Visibility is percentage-closer filtering (Reeves et al. 1987) with an offset
along the normal.
"""

import math
from dataclasses import dataclass, replace
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float
from numba import get_num_threads, prange
from torch import Tensor

from splatgraft.core.gaussians import Gaussians
from splatgraft.rendering.cpu_simd import LANES, lanes, largest, load, smaller, store, where_at_least, where_below
from splatgraft.runtime.kernels import kernel, serialized

FAR = np.float32(1e30)
"""Depth of a texel that blocks less than half of the light."""

# compiled into the kernels; all set by hand
_BINS = 4096  # depth bins of the counting sort
_FAINTEST = np.float32(0.01)  # alpha below which a splat is cut off
_CUTOFF = np.float32(3.04)  # standard deviations, where a splat of opacity 1 falls to `_FAINTEST`
_SPENT = np.float32(0.02)  # transmittance below which a tile of pixels is finished
_HALF = np.float32(0.5)  # transmittance at which a texel takes its first depth
_MAX_ALPHA = np.float32(0.99)  # largest alpha of one splat in one pixel, as in 3DGS
_DILATION = np.float32(0.15)  # pixels squared, added to the variance of a splat's footprint against aliasing
_LIFT = np.float32(1.5)  # pixels; a receiver is looked up this far above its surface, along the normal
_NEAREST_TO_LIGHT = np.float32(0.05)  # share of a near light's distance; closer occluders are left out
_FLATTEST = np.float32(0.2)  # cosine of incidence; flatter light adds no more slope-dependent bias


@dataclass(frozen=True)
class Window:
    """The sphere that depth maps cover, and their k frames."""

    center: Float[Tensor, "3"]
    """Middle of every map, at depth 0, world units."""
    radius: float
    """Half the width of every map, world units."""
    frames: Float[Tensor, "k 3 3"]
    """Rotations with rows right, down, away from the light: x_in_light = frame @ (x_in_world - center)."""
    nearness: Float[Tensor, "k"] | None = None
    """One over the light's distance from the centre: (u, v, depth) in the light's frame is projected to
    (u, v) / (1 + nearness * depth). Negative for a light behind; 0 or None for orthographic maps."""

    @property
    def directions(self) -> Float[Tensor, "k 3"]:
        """Unit vectors towards each light."""
        return -self.frames[:, 2]


@dataclass(frozen=True)
class Occluders:
    """Gaussians as input of depth maps, computed once for many maps."""

    means: Float[Tensor, "n 3"]
    """Centres, world units."""
    covariances: Float[Tensor, "n 3 3"]
    """Covariances, world units squared."""
    opacities: Float[Tensor, "n"]
    """Opacities in [0, 1]."""


def occluders_of(gaussians: Gaussians) -> Occluders:
    """Compute occluders from Gaussians."""
    return Occluders(
        means=gaussians.means,
        covariances=gaussians.covariances,
        opacities=gaussians.opacities,
    )


def thinned(gaussians: Gaussians, *, width: float) -> Gaussians:
    """Thin Gaussians to fewer, wider ones that cover the same area (stochastic simplification, Cook et al. 2007).

    A Gaussian narrower than `width`, world units, is kept with probability (its width / `width`)^2 and grown to
    `width`. The random numbers have a fixed seed.
    """
    share = (gaussians.log_scales.sort(1).values[:, 1:].sum(1) - 2 * math.log(width)).exp().clamp(1e-6, 1)
    random = torch.rand(gaussians.count, generator=torch.Generator().manual_seed(0))
    chosen = (random < share).nonzero()[:, 0]
    kept = gaussians.select(chosen)
    return replace(kept, log_scales=kept.log_scales - 0.5 * share[chosen, None].log())


@dataclass(frozen=True)
class DepthMaps:
    """Depth maps of occluders, s x s pixels each, from k directions."""

    window: Window
    """Sphere and frames of the maps."""
    first: Float[Tensor, "k s s"]
    """Depth at which half of the light is blocked; 1e30 if less than half is."""
    alpha: Float[Tensor, "k s s"]
    """Share of the light blocked, in [0, 1]."""
    mean: Float[Tensor, "c s s"]
    """Blended depth of the occluders, 0 in empty pixels; c = k, or 0 for maps without colour."""
    color: Float[Tensor, "c 3 s s"]
    """Blended linear colour of the occluders' side towards the light, over black."""

    @property
    def texel(self) -> float:
        """Width of a pixel, world units."""
        return 2 * self.window.radius / self.first.shape[1]


def splat_depth_maps(
    occluders: Occluders,
    window: Window,
    *,
    size: int,
    color: Float[Tensor, "n 3"] | None = None,
    nearest: Float[Tensor, "k"] | None = None,
) -> DepthMaps:
    """Splat depth maps of `occluders`, blended front to back as the renderer does.

    Args:
        occluders: All Gaussians that may block light.
        window: Sphere that the maps cover, and their frames.
        size: Width of a map, pixels, a multiple of 16.
        color: Linear rgb of the occluders, to keep it and the mean depth, too.
        nearest: Smallest depth per map, world units; occluders nearer to the light are left out.
    """
    k = len(window.frames)
    c = 0 if color is None else k
    assert size % LANES == 0
    first, transmittance = np.zeros((k, size, size), np.float32), np.ones((k, size, size), np.float32)
    mean, blended = np.zeros((c, size, size), np.float32), np.zeros((c, 3, size, size), np.float32)
    geometry = (_array(occluders.means), _array(occluders.covariances), _array(occluders.opacities))
    view = (_array(window.frames), _array(window.center), np.float32(window.radius))
    limits = _array(nearest) if nearest is not None else np.full(k, -FAR, np.float32)
    nearness = _array(window.nearness) if window.nearness is not None else np.zeros(k, np.float32)
    planes = (first, transmittance, mean, blended)
    rgb = np.zeros((0, 3), np.float32) if color is None else _array(color)
    _splat(geometry, rgb, view, (limits, nearness), planes, get_num_threads())
    first[transmittance >= _HALF] = FAR
    alpha = np.subtract(np.float32(1), transmittance, out=transmittance)
    mean /= np.maximum(alpha[:c], np.float32(1e-6))
    return DepthMaps(
        window=window,
        first=torch.from_numpy(first),
        alpha=torch.from_numpy(alpha),
        mean=torch.from_numpy(mean),
        color=torch.from_numpy(blended),
    )


def visibility(
    maps: DepthMaps,
    points: Float[Tensor, "m 3"],
    normals: Float[Tensor, "m 3"],
    *,
    bias: float,
    heights: Float[Tensor, "m"] | None = None,
) -> Float[Tensor, "m k"]:
    """Look up the visibility of each map's light from points on a surface.

    Args:
        maps: k depth maps.
        points: World units.
        normals: Unit normals of the surface at each point.
        bias: World units; an occluder nearer than this is the surface itself.
        heights: World units along the normal; an occluder that the light passes lower than this is the surface itself.

    Returns:
        Share of the light that arrives, in [0, 1]; 1 outside the window.
    """
    out = np.ones((len(points), len(maps.first)), np.float32)
    view = (_array(maps.window.frames), _array(maps.window.center), np.float32(maps.window.radius))
    own = np.zeros(len(points), np.float32) if heights is None else _array(heights)
    _filter_visibility(
        (_array(points), _array(normals), own), view, (_array(maps.first), _array(maps.alpha)), np.float32(bias), out
    )
    return torch.from_numpy(out)


def _array(tensor: Tensor) -> np.ndarray:
    return np.ascontiguousarray(tensor.detach().cpu().numpy(), dtype=np.float32)


@kernel(fastmath=True)
@no_type_check
def _project(frame, geometry, view, limits, splats):  # noqa: PLR0915  (one kernel: culling, sorting, projection)
    """Write the splats that touch a map into rows of `splats`, sorted by depth, and return their number."""
    means, covariances, opacities = geometry
    center, radius, size = view
    nearest, nearness = limits
    f = frame
    per_unit = np.float32(size / (2 * radius))
    square = per_unit * per_unit
    depths, kept = np.empty(len(means), np.float32), np.empty(len(means), np.int32)
    count = 0
    low, high = np.float32(1e30), np.float32(-1e30)
    for i in range(len(means)):
        x, y, z = means[i, 0] - center[0], means[i, 1] - center[1], means[i, 2] - center[2]
        depth = f[2, 0] * x + f[2, 1] * y + f[2, 2] * z
        closer = np.float32(1) + nearness * depth
        if opacities[i] < _FAINTEST or depth < nearest or closer < _NEAREST_TO_LIGHT:
            continue
        c = covariances[i]
        scale = np.float32(1) / closer
        reach = scale * _CUTOFF * np.sqrt(c[0, 0] + c[1, 1] + c[2, 2]) + np.float32(1) / per_unit
        u = scale * (f[0, 0] * x + f[0, 1] * y + f[0, 2] * z)
        v = scale * (f[1, 0] * x + f[1, 1] * y + f[1, 2] * z)
        if abs(u) > radius + reach or abs(v) > radius + reach:
            continue
        depths[count], kept[count] = depth, i
        count += 1
        low, high = min(low, depth), max(high, depth)
    # counting sort
    start = np.zeros(_BINS + 1, np.int32)
    per_depth = np.float32(_BINS - 1) / max(high - low, np.float32(1e-12))
    for j in range(count):
        start[int((depths[j] - low) * per_depth) + 1] += 1
    for b in range(_BINS):
        start[b + 1] += start[b]
    for j in range(count):
        i = kept[j]
        b = int((depths[j] - low) * per_depth)
        s = splats[start[b]]
        start[b] += 1
        x, y, z = means[i, 0] - center[0], means[i, 1] - center[1], means[i, 2] - center[2]
        c = covariances[i]
        # rows of the projection's Jacobian J (EWA, Zwicker et al. 2001); for a distant light the rows of f
        scale = np.float32(1) / (np.float32(1) + nearness * depths[j])
        u = scale * (f[0, 0] * x + f[0, 1] * y + f[0, 2] * z)
        v = scale * (f[1, 0] * x + f[1, 1] * y + f[1, 2] * z)
        du, dv = scale * nearness * u, scale * nearness * v
        j0, j1, j2 = scale * f[0, 0] - du * f[2, 0], scale * f[0, 1] - du * f[2, 1], scale * f[0, 2] - du * f[2, 2]
        k0, k1, k2 = scale * f[1, 0] - dv * f[2, 0], scale * f[1, 1] - dv * f[2, 1], scale * f[1, 2] - dv * f[2, 2]
        # rows of J C, then J C J^T for (u, v) and the depth column
        a0 = j0 * c[0, 0] + j1 * c[1, 0] + j2 * c[2, 0]
        a1 = j0 * c[0, 1] + j1 * c[1, 1] + j2 * c[2, 1]
        a2 = j0 * c[0, 2] + j1 * c[1, 2] + j2 * c[2, 2]
        b0 = k0 * c[0, 0] + k1 * c[1, 0] + k2 * c[2, 0]
        b1 = k0 * c[0, 1] + k1 * c[1, 1] + k2 * c[2, 1]
        b2 = k0 * c[0, 2] + k1 * c[1, 2] + k2 * c[2, 2]
        uu = (a0 * j0 + a1 * j1 + a2 * j2) * square + _DILATION
        uv = (a0 * k0 + a1 * k1 + a2 * k2) * square
        vv = (b0 * k0 + b1 * k1 + b2 * k2) * square + _DILATION
        uz = (a0 * f[2, 0] + a1 * f[2, 1] + a2 * f[2, 2]) * per_unit
        vz = (b0 * f[2, 0] + b1 * f[2, 1] + b2 * f[2, 2]) * per_unit
        inverse = np.float32(1) / (uu * vv - uv * uv)
        s[0], s[1] = (u + radius) * per_unit, (v + radius) * per_unit
        s[2] = depths[j]
        s[3], s[4], s[5] = vv * inverse, -uv * inverse, uu * inverse
        s[6], s[7] = s[3] * uz + s[4] * vz, s[4] * uz + s[5] * vz
        s[8], s[9] = opacities[i], vv
        s[10] = np.float32(2) * np.log(opacities[i] / _FAINTEST)
        s[11] = np.float32(i)
    return count


@kernel(fastmath=True, inline="always")
@no_type_check
def _blend(splat, at, dv, du, maps):
    """Blend one splat over a row of pixels; return weights, weighted depths, and whether all pixels are finished."""
    _, _, depth, ca, cb, cc, su, sv, opacity, _, cut, _ = splat
    near, transmittance = maps
    q = du * (du * ca + np.float32(2) * cb * dv) + cc * dv * dv
    # exp(-q / 2) to 0.004, by squaring (1 - q / 128) six times; nothing is blended where q is above 64, and without
    # that bound the squares would be denormal numbers there, which are slow to compute
    bell = np.float32(1) - smaller(q, np.float32(64)) * np.float32(1 / 128)
    bell = bell * bell
    bell = bell * bell
    bell = bell * bell
    bell = bell * bell
    bell = bell * bell
    bell = bell * bell
    before = load(transmittance, at)
    weight = before * where_below(q, cut, smaller(bell * opacity, _MAX_ALPHA))
    after = before - weight
    pixel_depth = du * su + (depth + sv * dv)
    store(near, at, load(near, at) + where_at_least(before, _HALF, where_below(after, _HALF, pixel_depth)))
    store(transmittance, at, after)
    return weight, weight * pixel_depth, largest(after) < _SPENT


@serialized
@kernel(parallel=True, fastmath=True)
@no_type_check
def _splat(geometry, rgb, view, limits, maps, threads):
    frames, center, radius = view
    nearest, nearness = limits
    first, transmittances, mean, color = maps
    size = first.shape[1]
    for thread in prange(threads):
        splats = np.empty((len(geometry[0]), 12), np.float32)
        for k in range(thread, len(frames), threads):
            count = _project(frames[k], geometry, (center, radius, size), (nearest[k], nearness[k]), splats)
            finished = np.zeros((size, size // LANES), np.bool_)
            near, transmittance = first[k], transmittances[k]
            for j in range(count):
                u, v, _, ca, cb, cc, _, _, _, var_v, cut, who = splats[j]
                reach = np.sqrt(cut * var_v)
                for row in range(max(0, int(np.ceil(v - reach - 0.5))), min(size, int(np.floor(v + reach + 0.5)))):
                    dv = np.float32(row) + np.float32(0.5) - v
                    # intersection of the ellipse q = cut with the row
                    across = cb * dv
                    root = across * across - ca * (cc * dv * dv - cut)
                    if root <= 0:
                        continue
                    half = np.sqrt(root) / ca
                    middle = u - across / ca - np.float32(0.5)
                    low, high = max(0, int(np.ceil(middle - half))), min(size - 1, int(np.floor(middle + half)))
                    if low > high:
                        continue
                    for tile in range(low // LANES, high // LANES + 1):
                        if finished[row, tile]:
                            continue
                        at = row * size + tile * LANES
                        du = lanes() + (np.float32(tile * LANES) + np.float32(0.5) - u)
                        weight, weighted_depth, finished[row, tile] = _blend(
                            splats[j], at, dv, du, (near, transmittance)
                        )
                        if len(color):
                            store(mean[k], at, load(mean[k], at) + weighted_depth)
                            for channel in range(3):
                                plane = color[k, channel]
                                store(plane, at, load(plane, at) + weight * rgb[int(who), channel])


@serialized
@kernel(parallel=True, fastmath=True)
@no_type_check
def _filter_visibility(receivers, view, maps, bias, out):
    points, normals, heights = receivers
    frames, center, radius = view
    first, alpha = maps
    size = first.shape[1]
    texel = np.float32(2 * radius / size)
    for i in prange(len(points)):
        for k in range(len(frames)):
            f = frames[k]
            cosine = -(f[2, 0] * normals[i, 0] + f[2, 1] * normals[i, 1] + f[2, 2] * normals[i, 2])
            # a map pixel on a tilted surface spans tan(angle) of depth; the offset along the normal covers most of that
            lift = texel * _LIFT
            x = points[i, 0] - center[0] + lift * normals[i, 0]
            y = points[i, 1] - center[1] + lift * normals[i, 1]
            z = points[i, 2] - center[2] + lift * normals[i, 2]
            u = (f[0, 0] * x + f[0, 1] * y + f[0, 2] * z) / texel + np.float32(0.5 * size - 0.5)
            v = (f[1, 0] * x + f[1, 1] * y + f[1, 2] * z) / texel + np.float32(0.5 * size - 0.5)
            depth = f[2, 0] * x + f[2, 1] * y + f[2, 2] * z
            if u < 0 or v < 0 or u >= size - 1 or v >= size - 1:
                continue
            steepness = max(abs(cosine), _FLATTEST)
            slope = np.sqrt(max(np.float32(0), 1 - cosine * cosine)) / steepness
            limit = depth - bias - texel * slope - heights[i] / steepness
            column, row = int(u), int(v)
            fu, fv = u - column, v - row
            blocked = np.float32(0)
            for dv in range(2):
                for du in range(2):
                    at = first[k, row + dv, column + du]
                    if at < limit:
                        share = (fu if du == 1 else 1 - fu) * (fv if dv == 1 else 1 - fv)
                        # fades in over one pixel's depth, against a visible step
                        blocked += share * alpha[k, row + dv, column + du] * min(1, (limit - at) / texel)
            out[i, k] = 1 - blocked
