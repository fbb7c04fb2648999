"""A `Light` from a panorama: bright patches become sources, the rest becomes ambient light of degree 2."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor

from splatgraft.core.directions import fit_sh
from splatgraft.core.images import srgb_from_linear
from splatgraft.relighting.light.light import Light, LightSource, angular_radius_deg
from splatgraft.relighting.light.panorama import Panorama


@dataclass(frozen=True)
class PanoramaSourceSettings:
    """Which patches of a panorama are sources, all set by hand."""

    clipped: float = 0.97
    """sRGB of the brightest channel from which a photograph may be clipped."""
    brightest_mean: float = 0.85
    """sRGB that the mean of the three channels exceeds, besides: saturated colours are no light."""
    covered: float = 0.5
    """Alpha above which a pixel counts as captured."""
    smallest: float = 2e-4
    """Steradians; a smaller patch is a highlight or a stray Gaussian (the sun's glare in a photograph is larger)."""
    largest: float = 0.6
    """Steradians; a larger patch is sky and stays ambient."""
    most: int = 4
    """Sources."""
    joined_px: float = 2.0
    """Pixels between patches that are joined."""
    most_joined: int = 32
    """Patches that are joined at all, the largest ones."""
    widest: float = math.radians(15)
    """Radians, half the extent; longer patches are cut in half (median cut, Debevec 2005)."""
    cuts: int = 2
    """Most cuts of a patch, one after another."""
    uncertainty_deg: float = 2.0
    """Degrees, of a source's direction."""
    overhead: float = 0.5
    """Cosine to the up direction of what counts as ceiling, 60 degrees."""


@dataclass(frozen=True)
class Patch:
    """A bright, connected part of a panorama."""

    direction: Float[Tensor, "3"]
    """Unit, towards its middle."""
    radiance: Float[Tensor, "3"]
    """Mean linear rgb, as clipped by the camera."""
    solid_angle: float
    """Steradians."""


def light_from_panorama(
    panorama: Panorama, up: Float[Tensor, "3"], *, settings: PanoramaSourceSettings = PanoramaSourceSettings()
) -> Light:
    """The light in a panorama; sources are as bright as the camera's clipping left them.

    Args:
        panorama: At the place.
        up: Unit, world frame; for the share of the ceiling that was not captured.
        settings: Which patches are sources.
    """
    captured = panorama.alpha > settings.covered
    patches, of_sources = bright_patches(panorama, settings=settings)
    weights = (panorama.solid_angles * panorama.alpha * (captured & ~of_sources)).flatten()
    ambient = fit_sh(panorama.directions.reshape(-1, 3), panorama.radiance.reshape(-1, 3), weights)
    above = (panorama.directions @ up) > settings.overhead
    overhead = panorama.solid_angles * above
    sources = [
        LightSource(
            direction=_tuple(patch.direction),
            irradiance=_tuple(patch.radiance * patch.solid_angle),
            angular_radius_deg=angular_radius_deg(patch.solid_angle),
            uncertainty_deg=settings.uncertainty_deg,
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


def bright_patches(
    panorama: Panorama, *, settings: PanoramaSourceSettings = PanoramaSourceSettings()
) -> tuple[list[Patch], Bool[Tensor, "6 s s"]]:
    """Connected parts of a panorama near the camera's clipping point, brightest first, and the pixels they cover.

    Parts that an edge between faces separates are joined. Parts wider than 30 degrees are cut in half along their
    longest extent, twice at most (median cut, Debevec 2005).
    """
    srgb = srgb_from_linear(panorama.radiance)
    bright = srgb.max(-1).values >= settings.clipped
    bright &= (srgb.mean(-1) > settings.brightest_mean) & (panorama.alpha > settings.covered)
    labels = np.zeros(bright.shape, np.int32)
    count = 0
    for face in range(6):
        found, n = ndimage.label(bright[face].numpy(), structure=np.ones((3, 3)))  # pyright: ignore[reportGeneralTypeIssues]
        labels[face] = np.where(found > 0, found + count, 0)
        count += n
    groups: list[Bool[Tensor, "6 s s"]] = [torch.from_numpy(labels == i) for i in range(1, count + 1)]
    groups = _joined(groups, panorama, settings)
    covered = torch.zeros_like(bright)
    patches = []
    for group in groups:
        solid_angle = float(panorama.solid_angles[group].sum())
        if not settings.smallest <= solid_angle <= settings.largest:
            continue
        covered |= group
        patches += _cut(panorama, group, settings)
    patches.sort(key=lambda p: -float(p.radiance.sum()) * p.solid_angle)
    return patches[: settings.most], covered


def _joined(
    groups: list[Bool[Tensor, "6 s s"]], panorama: Panorama, settings: PanoramaSourceSettings
) -> list[Bool[Tensor, "6 s s"]]:
    """The groups, of which those with pixels nearer than two pixels' angle are joined."""
    # a face spans 2 units of tan(angle)
    touching = 2 * settings.joined_px / panorama.alpha.shape[1]
    out: list[Bool[Tensor, "6 s s"]] = []
    for group in sorted(groups, key=lambda g: -int(g.sum()))[: settings.most_joined]:
        for i, other in enumerate(out):
            cosine = panorama.directions[group][::3] @ panorama.directions[other][::3].T
            if float(cosine.max()) > math.cos(touching):
                out[i] = other | group
                break
        else:
            out.append(group)
    return out


def _cut(
    panorama: Panorama, group: Bool[Tensor, "6 s s"], settings: PanoramaSourceSettings, *, depth: int = 0
) -> list[Patch]:
    """The group as one patch, or as several where it is long."""
    directions, angles = panorama.directions[group], panorama.solid_angles[group]
    radiance = panorama.radiance[group]
    weight = angles * radiance.mean(-1)
    weight = weight / weight.sum()
    center = torch.nn.functional.normalize((weight[:, None] * directions).sum(0), dim=0)
    spread = directions - center
    covariance = spread.T @ (weight[:, None] * spread)
    values, vectors = torch.linalg.eigh(covariance)
    # a uniform strip of half-width w has variance w^2 / 3
    if depth < settings.cuts and float(values[-1].clamp_min(0).sqrt()) * math.sqrt(3) > settings.widest:
        side = spread @ vectors[:, -1] > 0
        halves = []
        for half in (side, ~side):
            part = torch.zeros_like(group)
            part[group] = half
            if bool(part.any()):
                halves += _cut(panorama, part, settings, depth=depth + 1)
        return halves
    mean = (angles[:, None] * radiance).sum(0) / angles.sum()
    return [Patch(direction=center, radiance=mean, solid_angle=float(angles.sum()))]


def _tuple(vector: Float[Tensor, "3"]) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return (x, y, z)
