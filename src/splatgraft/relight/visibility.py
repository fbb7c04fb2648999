"""Orthographic depth maps splatted from Gaussians along many directions, and visibility looked up in them.

Knows nothing about light, colour spaces or objects: occluders in, maps out; points in, visibility out.
"""

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float
from numba import njit, prange
from torch import Tensor

from splatgraft.gaussians import Gaussians
from splatgraft.images import linear_from_srgb
from splatgraft.spherical_harmonics import rgb_from_dc

FAR = np.float32(1e30)
_BINS = 4096
_CUTOFF = 3.0  # standard deviations; at this distance a splat of opacity 1 has alpha 0.011


@dataclass(frozen=True)
class Window:
    """The ball that depth maps look at, and their frames."""

    center: Float[Tensor, "3"]
    """World; the middle of every map and depth 0."""
    radius: float
    """Half the width of every map, world units."""
    frames: Float[Tensor, "k 3 3"]
    """Rows right, down, away from the light; x_in_light = frame @ (x_in_world - center)."""

    @property
    def directions(self) -> Float[Tensor, "k 3"]:
        """Unit vectors towards each light."""
        return -self.frames[:, 2]


@dataclass(frozen=True)
class Occluders:
    """What Gaussians' maps need of them, computed once for many maps."""

    means: Float[Tensor, "n 3"]
    covariances: Float[Tensor, "n 3 3"]
    opacities: Float[Tensor, "n"]
    linear_rgb: Float[Tensor, "n 3"]
    """Mean colour, linear."""


def occluders_of(gaussians: Gaussians) -> Occluders:
    """The Gaussians as things that block light."""
    return Occluders(
        means=gaussians.means,
        covariances=gaussians.covariances,
        opacities=gaussians.opacities,
        linear_rgb=linear_from_srgb(rgb_from_dc(gaussians.sh[:, 0]).clamp(0, 1)),
    )


@dataclass(frozen=True)
class DepthMaps:
    """What k far lights see of some occluders."""

    window: Window
    first: Float[Tensor, "k s s"]
    """Depth at which light is half blocked; 1e30 where less than half is blocked."""
    alpha: Float[Tensor, "k s s"]
    """Share of the light blocked, in [0, 1]."""
    mean: Float[Tensor, "k s s"]
    """Blended depth of what blocks; 0 where nothing does."""
    color: Float[Tensor, "c s s 3"]
    """Blended linear colour of the side towards the light, over black; c is k, or 0 where none was asked for."""

    @property
    def texel(self) -> float:
        """Width of a pixel, world units."""
        return 2 * self.window.radius / self.first.shape[1]


def splat_depth_maps(
    occluders: Occluders, window: Window, *, size: int, with_color: bool, nearest: Float[Tensor, "k"] | None = None
) -> DepthMaps:
    """Depth maps of `occluders`, `size` pixels square; blended front to back as the renderer does.

    Colour is kept where `with_color` asks for it. Occluders at a depth below `nearest` (that is, farther than
    -`nearest` from the window's centre towards that light) are left out.
    """
    k = len(window.frames)
    first = np.full((k, size, size), FAR, np.float32)
    alpha = np.zeros((k, size, size), np.float32)
    mean = np.zeros((k, size, size), np.float32)
    color = np.zeros((k if with_color else 0, size, size, 3), np.float32)
    geometry = (_array(occluders.means), _array(occluders.covariances), _array(occluders.opacities))
    view = (_array(window.frames), _array(window.center), np.float32(window.radius))
    limits = _array(nearest) if nearest is not None else np.full(k, -FAR, np.float32)
    _splat(geometry, _array(occluders.linear_rgb), view, limits, (first, alpha, mean, color))
    return DepthMaps(
        window=window,
        first=torch.from_numpy(first),
        alpha=torch.from_numpy(alpha),
        mean=torch.from_numpy(mean),
        color=torch.from_numpy(color),
    )


def visibility(
    maps: DepthMaps, points: Float[Tensor, "m 3"], normals: Float[Tensor, "m 3"], *, bias: float
) -> Float[Tensor, "m k"]:
    """Share of each light that reaches `points` on a surface with `normals`; 1 outside the window.

    `bias` is the distance, world units, below which an occluder is the surface itself.
    """
    out = np.ones((len(points), len(maps.first)), np.float32)
    view = (_array(maps.window.frames), _array(maps.window.center), np.float32(maps.window.radius))
    _look_up(_array(points), _array(normals), view, (_array(maps.first), _array(maps.alpha)), np.float32(bias), out)
    return torch.from_numpy(out)


def _array(tensor: Tensor) -> np.ndarray:
    return np.ascontiguousarray(tensor.detach().cpu().numpy(), dtype=np.float32)


@njit(cache=True, parallel=True, fastmath=True)
@no_type_check
def _splat(geometry, rgb, view, limits, maps):  # noqa: PLR0912, PLR0915  (one kernel: projection, sort and blending)
    means, covariances, opacities = geometry
    frames, center, radius = view
    first, alpha, mean, color = maps
    n, size, with_color = len(means), first.shape[1], len(color) > 0
    per_unit = np.float32(size / (2 * radius))
    for k in prange(len(frames)):
        f = frames[k]
        kept = np.empty(n, np.int32)
        splats = np.empty((n, 9), np.float32)  # u, v, depth, conic abc, depth slope uv, opacity
        count = 0
        nearest, farthest = np.float32(1e30), np.float32(-1e30)
        for i in range(n):
            x, y, z = means[i, 0] - center[0], means[i, 1] - center[1], means[i, 2] - center[2]
            opacity = opacities[i]
            depth = f[2, 0] * x + f[2, 1] * y + f[2, 2] * z
            if opacity < 0.02 or depth < limits[k]:
                continue
            u = (f[0, 0] * x + f[0, 1] * y + f[0, 2] * z + radius) * per_unit
            v = (f[1, 0] * x + f[1, 1] * y + f[1, 2] * z + radius) * per_unit
            c = covariances[i]
            reach = _CUTOFF * np.sqrt(max(c[0, 0], c[1, 1], c[2, 2]) * 3) * per_unit + 1
            if u < -reach or v < -reach or u > size + reach or v > size + reach:
                continue
            # rows of F C, then F C F^T for (u, v) and the depth column
            a0 = f[0, 0] * c[0, 0] + f[0, 1] * c[1, 0] + f[0, 2] * c[2, 0]
            a1 = f[0, 0] * c[0, 1] + f[0, 1] * c[1, 1] + f[0, 2] * c[2, 1]
            a2 = f[0, 0] * c[0, 2] + f[0, 1] * c[1, 2] + f[0, 2] * c[2, 2]
            b0 = f[1, 0] * c[0, 0] + f[1, 1] * c[1, 0] + f[1, 2] * c[2, 0]
            b1 = f[1, 0] * c[0, 1] + f[1, 1] * c[1, 1] + f[1, 2] * c[2, 1]
            b2 = f[1, 0] * c[0, 2] + f[1, 1] * c[1, 2] + f[1, 2] * c[2, 2]
            square = per_unit * per_unit
            uu = (a0 * f[0, 0] + a1 * f[0, 1] + a2 * f[0, 2]) * square + np.float32(0.15)
            uv = (a0 * f[1, 0] + a1 * f[1, 1] + a2 * f[1, 2]) * square
            vv = (b0 * f[1, 0] + b1 * f[1, 1] + b2 * f[1, 2]) * square + np.float32(0.15)
            uz = (a0 * f[2, 0] + a1 * f[2, 1] + a2 * f[2, 2]) * per_unit
            vz = (b0 * f[2, 0] + b1 * f[2, 1] + b2 * f[2, 2]) * per_unit
            inverse = np.float32(1) / (uu * vv - uv * uv)
            s = splats[count]
            s[0], s[1], s[2] = u, v, depth
            s[3], s[4], s[5] = vv * inverse, -uv * inverse, uu * inverse
            s[6], s[7] = s[3] * uz + s[4] * vz, s[4] * uz + s[5] * vz
            s[8] = opacity
            kept[count] = i
            count += 1
            nearest, farthest = min(nearest, depth), max(farthest, depth)
        # counting sort by depth
        start = np.zeros(_BINS + 1, np.int32)
        per_depth = np.float32(_BINS - 1) / max(farthest - nearest, np.float32(1e-12))
        for j in range(count):
            start[int((splats[j, 2] - nearest) * per_depth) + 1] += 1
        for b in range(_BINS):
            start[b + 1] += start[b]
        order = np.empty(count, np.int32)
        for j in range(count):
            b = int((splats[j, 2] - nearest) * per_depth)
            order[start[b]] = j
            start[b] += 1
        for o in range(count):
            j = order[o]
            u, v, depth, ca, cb, cc, su, sv, opacity = splats[j]
            determinant = ca * cc - cb * cb
            limit = 2 * np.log(opacity * np.float32(100))
            if limit <= 0:
                continue
            reach_u, reach_v = np.sqrt(limit * cc / determinant), np.sqrt(limit * ca / determinant)
            for row in range(max(0, int(np.ceil(v - reach_v - 0.5))), min(size, int(np.floor(v + reach_v + 0.5)))):
                dv = np.float32(row) + np.float32(0.5) - v
                left = max(0, int(np.ceil(u - reach_u - 0.5)))
                for column in range(left, min(size, int(np.floor(u + reach_u + 0.5)))):
                    transmitted = 1 - alpha[k, row, column]
                    if transmitted < 0.02:
                        continue
                    du = np.float32(column) + np.float32(0.5) - u
                    q = ca * du * du + 2 * cb * du * dv + cc * dv * dv
                    if q > limit:
                        continue
                    weight = min(np.float32(0.99), opacity * np.exp(np.float32(-0.5) * q)) * transmitted
                    at = depth + su * du + sv * dv
                    if transmitted > 0.5 and transmitted - weight <= 0.5:
                        first[k, row, column] = at
                    alpha[k, row, column] += weight
                    mean[k, row, column] += weight * at
                    if with_color:
                        for channel in range(3):
                            color[k, row, column, channel] += weight * rgb[kept[j], channel]
        for row in range(size):
            for column in range(size):
                if alpha[k, row, column] > 1e-6:
                    mean[k, row, column] /= alpha[k, row, column]


@njit(cache=True, parallel=True, fastmath=True)
@no_type_check
def _look_up(points, normals, view, maps, bias, out):
    frames, center, radius = view
    first, alpha = maps
    size = first.shape[1]
    texel = np.float32(2 * radius / size)
    for i in prange(len(points)):
        for k in range(len(frames)):
            f = frames[k]
            cosine = -(f[2, 0] * normals[i, 0] + f[2, 1] * normals[i, 1] + f[2, 2] * normals[i, 2])
            # a map pixel on a tilted surface spans tan(angle) of depth; the offset along the normal takes most of it
            lift = texel * np.float32(1.5)
            x = points[i, 0] - center[0] + lift * normals[i, 0]
            y = points[i, 1] - center[1] + lift * normals[i, 1]
            z = points[i, 2] - center[2] + lift * normals[i, 2]
            u = (f[0, 0] * x + f[0, 1] * y + f[0, 2] * z) / texel + np.float32(0.5 * size - 0.5)
            v = (f[1, 0] * x + f[1, 1] * y + f[1, 2] * z) / texel + np.float32(0.5 * size - 0.5)
            depth = f[2, 0] * x + f[2, 1] * y + f[2, 2] * z
            if u < 0 or v < 0 or u >= size - 1 or v >= size - 1:
                continue
            slope = np.sqrt(max(np.float32(0), 1 - cosine * cosine)) / max(abs(cosine), np.float32(0.2))
            limit = depth - bias - texel * slope
            column, row = int(u), int(v)
            fu, fv = u - column, v - row
            blocked = np.float32(0)
            for dv in range(2):
                for du in range(2):
                    at = first[k, row + dv, column + du]
                    if at < limit:
                        share = (fu if du == 1 else 1 - fu) * (fv if dv == 1 else 1 - fv)
                        # fades in over one pixel's depth, so that no hard step shows
                        blocked += share * alpha[k, row + dv, column + du] * min(1, (limit - at) / texel)
            out[i, k] = 1 - blocked
