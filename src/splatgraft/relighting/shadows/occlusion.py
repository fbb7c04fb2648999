"""How much light a compact occluder takes from points around it, with soft edges, and what it sends back instead.

Depth maps of the occluder in, per-point sums out. Knows nothing about Gaussians' colours, files or where light is from.
"""

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from numba import njit, prange
from torch import Tensor

from splatgraft.relighting.shadows.shadow_maps import FAR, DepthMaps
from splatgraft.runtime.kernel_lock import serialized

_COARSEST = 4  # pixels; the top of the pyramids


@dataclass(frozen=True)
class LightSamples:
    """k narrow bundles of light that together light a place."""

    directions: Float[Tensor, "k 3"]
    """Unit, towards the light."""
    irradiance: Float[Tensor, "k 3"]
    """Linear rgb on a plane that faces the bundle."""
    softness: Float[Tensor, "k"]
    """Radius of the cone that a bundle fills, radians."""
    is_source: tuple[bool, ...]
    """Whether the bundle is a dominant source, or a piece of the ambient light."""
    blockers_within: tuple[float, ...]
    """World units; what is farther towards the light lets it through."""

    def __len__(self) -> int:
        """Number of bundles k."""
        return len(self.is_source)


@dataclass(frozen=True)
class Occlusion:
    """The occluder as every bundle meets it: mip pyramids, finest level first, flattened."""

    center: Float[Tensor, "3"]
    radius: float
    frames: Float[Tensor, "k 3 3"]
    texels: Float[Tensor, "k p 6"]
    """Premultiplied by alpha: alpha, depth of the lit side, depth of the middle, linear rgb of the unlit side."""
    size: int
    """Width of the finest level, pixels."""


def occlusion_from_maps(maps: DepthMaps, front: Int[Tensor, "k"], back: Int[Tensor, "k"]) -> Occlusion:
    """Pyramids of the maps `front`, completed by the opposite maps `back` (mirrored in u, depth negated).

    Both were made with colour.
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
        texels=torch.cat(levels, 1).contiguous(),
        size=maps.first.shape[1],
    )


def cast(
    occlusion: Occlusion,
    beams: LightSamples,
    points: Float[Tensor, "m 3"],
    normals: Float[Tensor, "m 3"],
    *,
    arrives: Float[Tensor, "m k"],
    bias: float,
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    """Irradiance at `points`: without the occluder, with it, and what the occluder's unlit side adds.

    `arrives` is the share of each bundle that the rest of the scene lets through. An occluder nearer than `bias`,
    world units, is the point's own surface. (Debevec 1998, Eq. 1: the differences of these are what compositing needs.)
    """
    arrays = [
        np.ascontiguousarray(t.numpy(), dtype=np.float32)
        for t in (occlusion.frames, beams.irradiance, beams.softness, points, normals, arrives)
    ]
    out = np.zeros((3, len(points), 3), np.float32)
    place = np.array([*occlusion.center.tolist(), occlusion.radius, bias], np.float32)
    _cast(np.ascontiguousarray(occlusion.texels.numpy()), occlusion.size, place, tuple(arrays), out)
    before, after, bounce = torch.from_numpy(out)
    return before, after, bounce


@njit(cache=True, fastmath=True, inline="always")
@no_type_check
def _soft_cosine(cosine, softness):
    """Mean of max(0, cos) over a cone, to a quadratic."""
    edge = np.sin(softness)
    if cosine >= edge:
        return cosine
    if cosine <= -edge:
        return np.float32(0)
    return (cosine + edge) * (cosine + edge) / (4 * edge)


@serialized
@njit(cache=True, parallel=True, fastmath=True)
@no_type_check
def _cast(texels, size, place, arrays, out):  # noqa: PLR0912, PLR0915  (one kernel: search, filter, sums)
    frames, irradiance, softness, points, normals, arrives = arrays
    radius, bias = place[3], place[4]
    texel = 2 * radius / size
    # many ambient bundles average their own noise away; few dominant ones need finer filters
    search, taps = 8, 24 if len(frames) < 16 else 12
    disk = np.empty((search + taps, 2), np.float32)  # Vogel spirals
    search_gap, tap_gap = np.float32(0.8), np.float32(2 / np.sqrt(taps))
    for t in range(search + taps):
        count, j = (search, t) if t < search else (taps, t - search)
        r, angle = np.sqrt((j + 0.5) / count), j * 2.399963
        disk[t, 0], disk[t, 1] = r * np.cos(angle), r * np.sin(angle)
    for i in prange(len(points)):
        x, y, z = points[i, 0] - place[0], points[i, 1] - place[1], points[i, 2] - place[2]
        for k in range(len(frames)):
            f = frames[k]
            cosine = -(f[2, 0] * normals[i, 0] + f[2, 1] * normals[i, 1] + f[2, 2] * normals[i, 2])
            weight = _soft_cosine(cosine, softness[k]) * arrives[i, k]
            if weight <= 0:
                continue
            for c in range(3):
                out[0, i, c] += weight * irradiance[k, c]
            u, v = f[0, 0] * x + f[0, 1] * y + f[0, 2] * z, f[1, 0] * x + f[1, 1] * y + f[1, 2] * z
            depth = f[2, 0] * x + f[2, 1] * y + f[2, 2] * z
            spread = np.tan(min(softness[k], np.float32(1.2)))
            # how the cosine changes over the cone: what lies behind the surface lights nothing
            lean_u = spread * (f[0, 0] * normals[i, 0] + f[0, 1] * normals[i, 1] + f[0, 2] * normals[i, 2])
            lean_v = spread * (f[1, 0] * normals[i, 0] + f[1, 1] * normals[i, 1] + f[1, 2] * normals[i, 2])
            facing = np.float32(0)
            width = spread * max(np.float32(0), depth + radius)
            blocked, red, green, blue = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
            if depth > -radius and abs(u) < radius + width and abs(v) < radius + width:
                found, distance = np.float32(0), np.float32(0)
                for t in range(search + taps):
                    if t == search:
                        if found < 1e-4:
                            break
                        width = spread * max(np.float32(0), distance / found)
                    tilt = max(np.float32(0), cosine + disk[t, 0] * lean_u + disk[t, 1] * lean_v)
                    if t >= search:
                        facing += tilt
                    if tilt <= 0:
                        continue
                    # the level whose pixels are about as wide as the gap between taps
                    gap = width / texel * (search_gap if t < search else tap_gap)
                    level_size, level_start, scale = size, 0, np.float32(1)
                    while level_size > 4 and gap > scale * np.float32(1.5):
                        level_start += level_size * level_size
                        level_size //= 2
                        scale *= 2
                    pu = (u + disk[t, 0] * width + radius) / (texel * scale) - np.float32(0.5)
                    pv = (v + disk[t, 1] * width + radius) / (texel * scale) - np.float32(0.5)
                    column, row = int(np.floor(pu)), int(np.floor(pv))
                    fu, fv = pu - column, pv - row
                    for dv in range(2):
                        for du in range(2):
                            cu, cv = column + du, row + dv
                            if cu < 0 or cv < 0 or cu >= level_size or cv >= level_size:
                                continue
                            p = texels[k, level_start + cv * level_size + cu]
                            if p[0] < 1e-4 or p[1] > (depth - bias) * p[0]:
                                continue
                            share = (fu if du == 1 else 1 - fu) * (fv if dv == 1 else 1 - fv)
                            if t < search:
                                found += share * p[0]
                                distance += share * (depth * p[0] - p[2])
                            else:
                                share *= tilt
                                blocked += share * p[0]
                                red += share * p[3]
                                green += share * p[4]
                                blue += share * p[5]
            if facing > 0:
                blocked, red, green, blue = blocked / facing, red / facing, green / facing, blue / facing
            blocked = min(blocked, np.float32(1))
            # radiance of the unlit side over the solid angle it fills: of the bundle's pi * sin^2 cone
            cone = np.float32(np.pi) * np.sin(softness[k]) ** 2
            for c in range(3):
                out[1, i, c] += weight * (1 - blocked) * irradiance[k, c]
            out[2, i, 0] += weight * red * cone
            out[2, i, 1] += weight * green * cone
            out[2, i, 2] += weight * blue * cone
