"""A `Light` from a panorama: bright patches become sources, the rest an ambient part. Knows nothing about shadows."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor

from splatgraft.core.directions import fit_sh
from splatgraft.core.images import srgb_from_linear
from splatgraft.relighting.light.light import Light, LightSource
from splatgraft.relighting.light.panorama import Panorama

_CLIPPED = 0.97  # sRGB at which a photograph may hide more light
_SMALLEST = 2e-4  # steradians; fewer is a glint or a stray Gaussian (the sun's glare in a photograph is larger)
_LARGEST = 0.6  # steradians; a wider bright patch is a sky, and stays ambient
_MAX_SOURCES = 4


@dataclass(frozen=True)
class Patch:
    """A bright, connected part of a panorama."""

    direction: Float[Tensor, "3"]
    radiance: Float[Tensor, "3"]
    """Mean linear rgb, as clipped by the camera."""
    solid_angle: float
    """Steradians."""


def light_from_panorama(panorama: Panorama, up: Float[Tensor, "3"]) -> Light:
    """The light that a panorama shows, as far as its camera did not clip it."""
    seen = panorama.alpha > 0.5
    patches, covered = bright_patches(panorama)
    weights = (panorama.solid_angles * panorama.alpha * (seen & ~covered)).flatten()
    ambient = fit_sh(panorama.directions.reshape(-1, 3), panorama.radiance.reshape(-1, 3), weights)
    above = (panorama.directions @ up) > 0.5
    overhead = panorama.solid_angles * above
    sources = [
        LightSource(
            direction=_tuple(patch.direction),
            irradiance=_tuple(patch.radiance * patch.solid_angle),
            angular_radius_deg=math.degrees(math.acos(1 - patch.solid_angle / (2 * math.pi))),
            uncertainty_deg=2.0,
            confidence=1.0,
            name="bright patch",
        )
        for patch in patches
    ]
    return Light(
        sources=tuple(sorted(sources, key=lambda s: -s.luminance)),
        ambient=ambient,
        coverage=panorama.coverage,
        unseen_up=float((overhead * (1 - panorama.alpha)).sum() / overhead.sum()),
    )


def bright_patches(panorama: Panorama) -> tuple[list[Patch], Bool[Tensor, "6 s s"]]:
    """Connected parts near the camera's clipping point, brightest first, and the pixels they cover.

    Parts that are cut by an edge between faces are joined where they touch; long ones are cut in half along their
    longest extent until none is wider than 30 degrees (median cut, Debevec 2005).
    """
    srgb = srgb_from_linear(panorama.radiance)
    bright = (srgb.max(-1).values >= _CLIPPED) & (srgb.mean(-1) > 0.85) & (panorama.alpha > 0.5)
    labels = np.zeros(bright.shape, np.int32)
    count = 0
    for face in range(6):
        found, n = ndimage.label(bright[face].numpy(), structure=np.ones((3, 3)))  # pyright: ignore[reportGeneralTypeIssues]
        labels[face] = np.where(found > 0, found + count, 0)
        count += n
    groups: list[Bool[Tensor, "6 s s"]] = [torch.from_numpy(labels == i) for i in range(1, count + 1)]
    groups = _joined(groups, panorama)
    covered = torch.zeros_like(bright)
    patches = []
    for group in groups:
        solid_angle = float(panorama.solid_angles[group].sum())
        if not _SMALLEST <= solid_angle <= _LARGEST:
            continue
        covered |= group
        patches += _cut(panorama, group)
    patches.sort(key=lambda p: -float(p.radiance.sum()) * p.solid_angle)
    return patches[:_MAX_SOURCES], covered


def _joined(groups: list[Bool[Tensor, "6 s s"]], panorama: Panorama) -> list[Bool[Tensor, "6 s s"]]:
    """Groups whose nearest pixels lie within two pixels' angle become one."""
    touching = 4.0 / panorama.alpha.shape[1]
    out: list[Bool[Tensor, "6 s s"]] = []
    for group in sorted(groups, key=lambda g: -int(g.sum()))[:32]:
        for i, other in enumerate(out):
            cosine = panorama.directions[group][::3] @ panorama.directions[other][::3].T
            if float(cosine.max()) > math.cos(touching):
                out[i] = other | group
                break
        else:
            out.append(group)
    return out


def _cut(panorama: Panorama, group: Bool[Tensor, "6 s s"], depth: int = 0) -> list[Patch]:
    directions, angles = panorama.directions[group], panorama.solid_angles[group]
    radiance = panorama.radiance[group]
    weight = angles * radiance.mean(-1)
    weight = weight / weight.sum()
    center = torch.nn.functional.normalize((weight[:, None] * directions).sum(0), dim=0)
    spread = directions - center
    covariance = spread.T @ (weight[:, None] * spread)
    values, vectors = torch.linalg.eigh(covariance)
    # an even strip of half-width w has variance w^2 / 3
    if depth < 2 and float(values[-1].clamp_min(0).sqrt()) * math.sqrt(3) > math.radians(15):
        side = spread @ vectors[:, -1] > 0
        halves = []
        for half in (side, ~side):
            part = torch.zeros_like(group)
            part[group] = half
            if bool(part.any()):
                halves += _cut(panorama, part, depth + 1)
        return halves
    mean = (angles[:, None] * radiance).sum(0) / angles.sum()
    return [Patch(direction=center, radiance=mean, solid_angle=float(angles.sum()))]


def _tuple(vector: Float[Tensor, "3"]) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return (x, y, z)
