"""Soft shadows of a compact object: irradiance with and without the object, and the bounce of its unlit side.

Percentage-closer soft shadows (Fernando 2005) from one prefiltered depth map per light sample: a blocker search gives
the penumbra's width, then a second filter of that width gives visibility.
"""

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from numba import prange
from torch import Tensor

from splatgraft.relighting.light.samples import LightSamples
from splatgraft.relighting.shadows.shadow_maps import FAR, DepthMaps
from splatgraft.runtime.kernels import kernel, serialized

# compiled into the kernel; all set by hand
_COARSEST = 4  # pixels; width of the mip pyramid's last level
_SEARCH_TAPS = 8  # taps of the blocker search
_SOURCE_TAPS, _AMBIENT_TAPS = 24, 12  # taps of the visibility filter; over many ambient samples noise averages out
_FEW_SAMPLES = 16  # fewer samples than this are taken for sources
_SEARCH_GAP = np.float32(0.8)  # distance between neighbouring taps of the search over the radius of its disk
_BLUR = np.float32(1.5)  # pixels of a mip level; a larger distance between taps needs the next level
_WIDEST_CONE = np.float32(1.2)  # radians; the filter of a wider cone stays this wide
_GOLDEN_ANGLE = 2.399963  # radians; the exact `core.directions.GOLDEN_ANGLE` would change results in the last bits
_MIN_ALPHA = 1e-4  # alpha below which a texel blocks nothing


@dataclass(frozen=True)
class Occlusion:
    """An object's depth maps as k mip pyramids, one per light sample."""

    center: Float[Tensor, "3"]
    """Centre of the maps' window, world units."""
    radius: float
    """Half the width of the maps, world units."""
    frames: Float[Tensor, "k 3 3"]
    """Rows right, down, away from the light."""
    nearness: Float[Tensor, "k"]
    """One over the light's distance from the centre; 0 for directional samples."""
    texels: Float[Tensor, "k p 6"]
    """Alpha of all p texels, finest level first; then, premultiplied by it, depth of the lit side, depth of the middle
    and linear rgb of the unlit side."""
    size: int
    """Width of the finest level, pixels."""


def occlusion_from_maps(maps: DepthMaps, front: Int[Tensor, "k"], back: Int[Tensor, "k"]) -> Occlusion:
    """Build mip pyramids from an object's depth maps.

    Args:
        maps: Depth maps of the object, with colour.
        front: Position in `maps` of each sample's map.
        back: Position of the map from the opposite direction, which shows the unlit side (mirrored in u, depth
            negated).
    """
    alpha = maps.alpha[front]
    first = torch.where(maps.first < float(FAR) / 2, maps.first, maps.mean)
    lit_side = first[front]
    far_side = torch.maximum(-first[back].flip(2), lit_side)
    planes = [alpha, alpha * lit_side, alpha * 0.5 * (lit_side + far_side)]
    unlit = (maps.color[back] / maps.alpha[back][:, None].clamp_min(1e-3)).flip(3)
    planes += [alpha * unlit[:, channel] for channel in range(3)]
    level = torch.stack(planes, 1)
    levels = []
    while True:
        levels.append(level.flatten(2).transpose(1, 2))
        if level.shape[-1] <= _COARSEST:
            break
        level = F.avg_pool2d(level, 2)
    window = maps.window
    return Occlusion(
        center=window.center,
        radius=window.radius,
        frames=window.frames[front],
        nearness=torch.zeros(len(front)) if window.nearness is None else window.nearness[front],
        texels=torch.cat(levels, 1).contiguous(),
        size=maps.first.shape[1],
    )


def occluded_irradiance(
    occlusion: Occlusion,
    samples: LightSamples,
    points: Float[Tensor, "m 3"],
    normals: Float[Tensor, "m 3"],
    *,
    sample_visibility: Float[Tensor, "m k"],
    bias: float,
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    """Compute irradiance around an object for differential rendering (Debevec 1998, Eq. 1).

    Args:
        occlusion: The object's k pyramids, one per sample.
        samples: The k samples of the light.
        points: World units.
        normals: Unit normals of the surface at each point.
        sample_visibility: Share of each sample that the rest of the scene lets through, in [0, 1].
        bias: World units; an occluder nearer than this is the point's own surface.

    Returns:
        Linear rgb irradiance without the object, with it, and from the object's unlit side.
    """
    arrays = [
        np.ascontiguousarray(t.numpy(), dtype=np.float32)
        for t in (
            occlusion.frames,
            occlusion.nearness,
            samples.irradiance,
            samples.softness,
            points,
            normals,
            sample_visibility,
        )
    ]
    out = np.zeros((3, len(points), 3), np.float32)
    place = np.array([*occlusion.center.tolist(), occlusion.radius, bias], np.float32)
    softness = arrays[3]
    spirals = [_vogel(_SEARCH_TAPS), _vogel(_SOURCE_TAPS if len(softness) < _FEW_SAMPLES else _AMBIENT_TAPS)]
    spreads = np.tan(np.minimum(softness, _WIDEST_CONE))
    edges = np.sin(np.minimum(softness, np.float32(np.pi / 2)))  # a wider cone still ends at the horizon
    maps = (np.ascontiguousarray(occlusion.texels.numpy()), occlusion.size)
    _sum_samples(maps, place, tuple(arrays), (np.concatenate(spirals), spreads, edges), out)
    without, with_object, bounce = torch.from_numpy(out)
    return without, with_object, bounce


def _vogel(count: int) -> Float[np.ndarray, "t 2"]:
    """Return points spread evenly over the unit disk."""
    index = np.arange(count)
    angle = index * _GOLDEN_ANGLE
    radius = np.sqrt((index + 0.5) / count)[:, None]
    return (radius * np.stack([np.cos(angle), np.sin(angle)], 1)).astype(np.float32)


@kernel(fastmath=True)
@no_type_check
def _soft_cosine(cosine, edge):
    """Compute the mean of max(0, cos) over a cone whose radius has the sine `edge`, as `shading.soft_cosine` does."""
    if cosine >= edge:
        return cosine
    if cosine <= -edge:
        return np.float32(0)
    return (cosine + edge) * (cosine + edge) / (4 * edge)


@kernel(fastmath=True)
@no_type_check
def _sum_samples_at(i, maps, place, arrays, cones, out):  # noqa: PLR0912, PLR0915  (search, filter, sums)
    """Fill `out` for point i. Numba compiles this in half the time that it takes for the body of a `prange` loop."""
    texels, size = maps
    frames, nearness, irradiance, _, points, normals, sample_visibility = arrays
    disk, spreads, edges = cones
    radius, bias = place[3], place[4]
    texel = 2 * radius / size
    search, taps = _SEARCH_TAPS, len(disk) - _SEARCH_TAPS
    search_gap, tap_gap = _SEARCH_GAP, np.float32(2 / np.sqrt(taps))
    x, y, z = points[i, 0] - place[0], points[i, 1] - place[1], points[i, 2] - place[2]
    for k in range(len(frames)):
        f, near = frames[k], nearness[k]
        # towards the light, in units of its distance from the centre
        lx, ly, lz = -f[2, 0] - near * x, -f[2, 1] - near * y, -f[2, 2] - near * z
        square = max(lx * lx + ly * ly + lz * lz, np.float32(1e-6))
        cosine = (lx * normals[i, 0] + ly * normals[i, 1] + lz * normals[i, 2]) / np.sqrt(square)
        weight = _soft_cosine(cosine, edges[k]) * sample_visibility[i, k] / square
        if weight <= 0:
            continue
        for c in range(3):
            out[0, i, c] += weight * irradiance[k, c]
        depth = f[2, 0] * x + f[2, 1] * y + f[2, 2] * z
        # in the plane through the centre, seen from the light
        zoom = np.float32(1) / max(np.float32(1) + near * depth, np.float32(1e-3))
        u = zoom * (f[0, 0] * x + f[0, 1] * y + f[0, 2] * z)
        v = zoom * (f[1, 0] * x + f[1, 1] * y + f[1, 2] * z)
        spread = spreads[k]
        # the cosine changes over the cone, and directions below the surface give no light
        tilt_u = spread * (f[0, 0] * normals[i, 0] + f[0, 1] * normals[i, 1] + f[0, 2] * normals[i, 2])
        tilt_v = spread * (f[1, 0] * normals[i, 0] + f[1, 1] * normals[i, 1] + f[1, 2] * normals[i, 2])
        facing = np.float32(0)
        width = spread * zoom * max(np.float32(0), depth + radius) / (np.float32(1) - near * radius)
        blocked, red, green, blue = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
        if depth > -radius and abs(u) < radius + width and abs(v) < radius + width:
            found, distance = np.float32(0), np.float32(0)
            level_size, level_start, over = size, 0, np.float32(1) / texel
            for t in range(search + taps):
                if t == search:
                    if found < _MIN_ALPHA:
                        break
                    behind = max(np.float32(0), distance / found)
                    width = spread * zoom * behind / (np.float32(1) + near * (depth - behind))
                if t in (0, search):
                    # the mip level whose pixels are about as wide as the distance between taps
                    gap = width / texel * (search_gap if t < search else tap_gap)
                    level_size, level_start, scale = size, 0, np.float32(1)
                    while level_size > _COARSEST and gap > scale * _BLUR:
                        level_start += level_size * level_size
                        level_size //= 2
                        scale *= 2
                    over = np.float32(1) / (texel * scale)
                tap_cosine = max(np.float32(0), cosine + disk[t, 0] * tilt_u + disk[t, 1] * tilt_v)
                if t >= search:
                    facing += tap_cosine
                if tap_cosine <= 0:
                    continue
                pu = (u + disk[t, 0] * width + radius) * over - np.float32(0.5)
                pv = (v + disk[t, 1] * width + radius) * over - np.float32(0.5)
                column, row = int(np.floor(pu)), int(np.floor(pv))
                fu, fv = pu - column, pv - row
                for dv in range(2):
                    for du in range(2):
                        cu, cv = column + du, row + dv
                        if cu < 0 or cv < 0 or cu >= level_size or cv >= level_size:
                            continue
                        p = texels[k, level_start + cv * level_size + cu]
                        if p[0] < _MIN_ALPHA or p[1] > (depth - bias) * p[0]:
                            continue
                        share = (fu if du == 1 else 1 - fu) * (fv if dv == 1 else 1 - fv)
                        if t < search:
                            found += share * p[0]
                            distance += share * (depth * p[0] - p[2])
                        else:
                            share *= tap_cosine
                            blocked += share * p[0]
                            red += share * p[3]
                            green += share * p[4]
                            blue += share * p[5]
        if facing > 0:
            blocked, red, green, blue = blocked / facing, red / facing, green / facing, blue / facing
        blocked = min(blocked, np.float32(1))
        # the unlit side's radiance times the projected solid angle of the sample's cone, pi * sin^2
        cone = np.float32(np.pi) * edges[k] ** 2
        for c in range(3):
            out[1, i, c] += weight * (1 - blocked) * irradiance[k, c]
        out[2, i, 0] += weight * red * cone
        out[2, i, 1] += weight * green * cone
        out[2, i, 2] += weight * blue * cone


@serialized
@kernel(parallel=True, fastmath=True)
@no_type_check
def _sum_samples(maps, place, arrays, cones, out):
    for i in prange(len(arrays[4])):
        # numba also compiles the call with the loop's unsigned index, unless it is converted
        _sum_samples_at(np.int64(i), maps, place, arrays, cones, out)
