"""The true light at a place of a synthetic scene, from a rendered panorama and the suns that it leaves out.

The panorama is not clipped: the sun of an environment map, or a studio's lamp, is 100 to 1000 times the mean.

1. Each peak, with the pixels near it, becomes a source, and the median of its surroundings replaces it.
2. The brightest patches of the rest, as a camera would clip them, become sources, too.
3. The remainder is fitted by ambient light of degree 2.
"""

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor

from splatgraft.core.directions import even_directions, fit_sh
from splatgraft.core.images import srgb_from_linear
from splatgraft.relighting.light.light import Light, LightSource, angular_radius_deg, light_from_json, light_to_json
from splatgraft.relighting.light.panorama import Panorama, cube_directions

TRUE_LIGHT_FILE = "true_light.json"

# patches that are sources, set by hand
_CLIPPED = 0.97  # sRGB; minimum of the brightest channel of a patch
_BRIGHTEST_MEAN = 0.85  # sRGB; minimum mean of the three channels, since saturated colours are no light
_SMALLEST = 2e-4  # steradians; a smaller patch is a highlight
_LARGEST = (
    0.6,
    1.5,
)  # steradians; larger patches are sky and stay ambient. The limit with the better irradiance is used
_MAX_PATCHES = 4
_MAX_JOINED = 32  # number of the largest patches, which may be joined; others are dropped
_WIDEST = math.radians(15)  # radians, half the extent; longer patches are cut in half

_NORMALS = even_directions(100)
_FACE = 64  # pixels; width of a face of the cube map
# factors on the mean gray radiance, set by hand: windows of rooms stay below the first
_PEAK_OVER_MEAN, _PEAK_AROUND = 50.0, 5.0  # minimum of a peak's brightest pixel, and of the other pixels of the peak
_PEAK_NEAR_DEG = 15.0  # degrees; distance of a peak's pixels from its brightest
_MAX_PEAKS = 6


def light_from_probe(panorama: Float[Tensor, "h w 3"], suns: list[dict]) -> Light:
    """Fit a light to an equirectangular panorama of linear radiance and the entries of suns.json.

    Row 0 is up (+z), the middle column +x, to the right -y. A sun has a direction (unit, towards it), irradiance
    (linear RGB) and angular_radius (radians).
    """
    panorama, peaks = _without_peaks(panorama)
    directions, solid_angles = cube_directions(_FACE)
    cube = Panorama(
        radiance=sample_panorama(panorama, directions),
        alpha=torch.ones(6, _FACE, _FACE),
        directions=directions,
        solid_angles=solid_angles,
    )
    sources = [
        LightSource(
            direction=_triple(sun["direction"]),
            irradiance=_triple(sun["irradiance"]),
            angular_radius_deg=math.degrees(sun["angular_radius"]),
            name="sun",
        )
        for sun in suns
    ]
    groups = _bright_groups(cube)
    lights = [_patches_and_rest(cube, groups, largest) for largest in _LARGEST]
    found = min(lights, key=lambda light: _error(light, cube))
    ordered = sorted([*sources, *peaks, *found.sources], key=lambda source: -source.luminance)
    return replace(found, sources=tuple(ordered))


def _patches_and_rest(panorama: Panorama, groups: list[Bool[Tensor, "6 s s"]], largest: float) -> Light:
    """Represent the brightest groups of up to `largest` steradians by sources, all other radiance by ambient light.

    Patches wider than 30 degrees are cut in half along their longest extent, twice at most (median cut, Debevec 2005).
    """
    patches: list[_Patch] = []
    for group in groups:
        if _SMALLEST <= float(panorama.solid_angles[group].sum()) <= largest:
            patches += _cut(panorama, group)
    patches = sorted(patches, key=lambda patch: -patch.power)[:_MAX_PATCHES]
    covered = sum((patch.pixels for patch in patches), torch.zeros_like(panorama.alpha, dtype=torch.bool))
    weights = (panorama.solid_angles * ~covered).flatten()
    ambient = fit_sh(panorama.directions.reshape(-1, 3), panorama.radiance.reshape(-1, 3), weights)
    return Light(sources=tuple(patch.source for patch in patches), ambient=ambient)


def _error(light: Light, panorama: Panorama) -> float:
    """Compute the mean squared error of a light's irradiance in logarithms."""
    cosine = (_NORMALS @ panorama.directions.reshape(-1, 3).T).clamp_min(0)
    true = (cosine * panorama.solid_angles.flatten()) @ panorama.radiance.reshape(-1, 3)
    return float((light.irradiance(_NORMALS) / true.clamp_min(1e-6)).log().square().mean())


def _without_peaks(panorama: Float[Tensor, "h w 3"]) -> tuple[Float[Tensor, "h w 3"], list[LightSource]]:
    """Split a panorama into peaks, as sources, and the rest, in which the median of nearby pixels fills the peaks."""
    directions, solid_angles = panorama_pixels(panorama)
    mean = float((panorama.mean(-1) * solid_angles).sum()) / (4 * math.pi)
    rest, peaks = panorama.clone(), []
    while len(peaks) < _MAX_PEAKS:
        gray = rest.mean(-1)
        brightest = int(gray.argmax())
        if float(gray.flatten()[brightest]) <= _PEAK_OVER_MEAN * mean:
            break
        near = directions @ directions.reshape(-1, 3)[brightest] > math.cos(math.radians(_PEAK_NEAR_DEG))
        peak = near & (gray > _PEAK_AROUND * mean)
        around = rest[near & ~peak] if bool((near & ~peak).any()) else rest[~peak]
        peaks.append(_source(rest[peak], directions[peak], solid_angles[peak]))
        rest[peak] = around.median(0).values
    return rest, peaks


def _source(
    radiance: Float[Tensor, "k 3"], directions: Float[Tensor, "k 3"], solid_angles: Float[Tensor, "k"]
) -> LightSource:
    """Replace pixels by one disc-shaped source of their irradiance, mean direction and effective solid angle."""
    power = radiance * solid_angles[:, None]
    gray = power.mean(1)
    extent = float(gray.sum() ** 2 / (gray * radiance.mean(1)).sum())
    return LightSource(
        direction=_triple(torch.nn.functional.normalize((gray[:, None] * directions).sum(0), dim=0).tolist()),
        irradiance=_triple(power.sum(0).tolist()),
        angular_radius_deg=angular_radius_deg(extent),
        name="bright peak",
    )


def panorama_pixels(panorama: Float[Tensor, "h w 3"]) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
    """Compute unit directions and solid angles of an equirectangular panorama's pixels (see `light_from_probe`)."""
    h, w = panorama.shape[:2]
    down = (torch.arange(h) + 0.5) / h * math.pi
    turn = (2 * math.pi * (0.5 - (torch.arange(w) + 0.5) / w)).expand(h, w)
    flat, up = down.sin()[:, None].expand(h, w), down.cos()[:, None].expand(h, w)
    directions = torch.stack([flat * turn.cos(), flat * turn.sin(), up], -1)
    return directions, flat * (math.pi / h) * (2 * math.pi / w)


def sample_panorama(panorama: Float[Tensor, "h w 3"], directions: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    """Sample an equirectangular panorama at unit directions, bilinearly; differentiable in both."""
    x, y, z = directions.reshape(-1, 3).unbind(-1)
    across = -torch.atan2(y, x) / math.pi
    # equals the arc sine of z, but has a finite gradient at the poles
    down = -torch.atan2(z, torch.hypot(x, y).clamp_min(1e-6)) / (math.pi / 2)
    # one column is repeated on both sides, so that the seam at -x is interpolated too
    wide = torch.cat([panorama[:, -1:], panorama, panorama[:, :1]], 1).permute(2, 0, 1)[None]
    across = across * panorama.shape[1] / (panorama.shape[1] + 2)
    grid = torch.stack([across, down], -1)[None, None]
    values = torch.nn.functional.grid_sample(wide, grid, padding_mode="border", align_corners=False)
    return values[0, :, 0].T.reshape(directions.shape).contiguous()


@dataclass(frozen=True)
class _Patch:
    """A bright patch: its power, by which patches are sorted, its source, and its pixels."""

    power: float
    source: LightSource
    pixels: Bool[Tensor, "6 s s"]


def _bright_groups(panorama: Panorama) -> list[Bool[Tensor, "6 s s"]]:
    """Find connected groups of pixels that a camera would clip; those on two faces that meet are joined."""
    srgb = srgb_from_linear(panorama.radiance)
    bright = (srgb.max(-1).values >= _CLIPPED) & (srgb.mean(-1) > _BRIGHTEST_MEAN)
    labels = np.zeros(bright.shape, np.int32)
    count = 0
    for face in range(6):
        found, n = ndimage.label(bright[face].numpy(), structure=np.ones((3, 3)))  # pyright: ignore[reportGeneralTypeIssues]
        labels[face] = np.where(found > 0, found + count, 0)
        count += n
    return _joined([torch.from_numpy(labels == i) for i in range(1, count + 1)], panorama)


def _joined(groups: list[Bool[Tensor, "6 s s"]], panorama: Panorama) -> list[Bool[Tensor, "6 s s"]]:
    """Join the groups that are at most two pixels apart."""
    # a face spans 2 units of tan(angle)
    touching = 2 * 2.0 / panorama.alpha.shape[1]
    out: list[Bool[Tensor, "6 s s"]] = []
    for group in sorted(groups, key=lambda g: -int(g.sum()))[:_MAX_JOINED]:
        for i, other in enumerate(out):
            cosine = panorama.directions[group][::3] @ panorama.directions[other][::3].T
            if float(cosine.max()) > math.cos(touching):
                out[i] = other | group
                break
        else:
            out.append(group)
    return out


def _cut(panorama: Panorama, group: Bool[Tensor, "6 s s"], *, depth: int = 0) -> list[_Patch]:
    """Replace a group by one source of its power, or by several if it is long."""
    directions, angles = panorama.directions[group], panorama.solid_angles[group]
    radiance = panorama.radiance[group]
    weight = angles * radiance.mean(-1)
    weight = weight / weight.sum()
    center = torch.nn.functional.normalize((weight[:, None] * directions).sum(0), dim=0)
    spread = directions - center
    values, vectors = torch.linalg.eigh(spread.T @ (weight[:, None] * spread))
    # a uniform strip of half-width w has variance w^2 / 3
    if depth < 2 and float(values[-1].clamp_min(0).sqrt()) * math.sqrt(3) > _WIDEST:
        side = spread @ vectors[:, -1] > 0
        halves = []
        for half in (side, ~side):
            part = torch.zeros_like(group)
            part[group] = half
            if bool(part.any()):
                halves += _cut(panorama, part, depth=depth + 1)
        return halves
    mean, solid_angle = (angles[:, None] * radiance).sum(0) / angles.sum(), float(angles.sum())
    source = LightSource(
        direction=_triple(center.tolist()),
        irradiance=_triple((mean * solid_angle).tolist()),
        angular_radius_deg=angular_radius_deg(solid_angle),
        name="bright patch",
    )
    return [_Patch(float(mean.sum()) * solid_angle, source, group)]


def _triple(values: list[float]) -> tuple[float, float, float]:
    x, y, z = values
    return (x, y, z)


def read_probe(panorama: Path, suns: Path) -> Light:
    """Read the light measured at a place: a panorama without the suns (.npy), and a list of suns (.json)."""
    try:
        radiance = torch.from_numpy(np.load(panorama, allow_pickle=False)).float()
        return light_from_probe(radiance, json.loads(suns.read_text(encoding="utf-8")))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{panorama}, {suns.name}: expected a measured light, found {error}") from error


def write_true_light(scene: Path) -> None:
    """Write true_light.json from probe.npy and suns.json of a gathered scene."""
    light = read_probe(scene / "probe.npy", scene / "suns.json")
    (scene / TRUE_LIGHT_FILE).write_text(light_to_json(light), encoding="utf-8")


def read_true_light(path: Path) -> Light:
    """Read true_light.json."""
    if not path.is_file():
        raise ValueError(f"{path}: expected the scene's true light, found none")
    return light_from_json(path.read_text(encoding="utf-8"), name=str(path))
