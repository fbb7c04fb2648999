"""The true light at a place of a synthetic scene: a rendered panorama and the suns that it leaves out.

The panorama is not clipped, as a photograph is: the sun of an environment map, or a studio's lamp, is some hundred
times as bright as the rest. Such peaks become sources first; what is left is divided as a photograph's panorama.
"""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.relighting.light.light import Light, LightSource, angular_radius_deg, light_from_json, light_to_json
from splatgraft.relighting.light.panorama import Panorama, cube_directions
from splatgraft.relighting.light.panorama_sources import light_from_panorama

_FACE = 64
"""Pixels; width of a face of the cube map."""


_PEAK_OVER_MEAN, _PEAK_AROUND = 50.0, 5.0
"""Times the mean gray radiance: a pixel above the first makes a peak, and near it pixels above the second belong to it.
Set by hand: suns and lamps of environment maps are 100 to 1000 times the mean; windows of rooms stay below."""
_PEAK_NEAR_DEG = 15.0
"""Degrees from the brightest pixel to what belongs to its peak."""
_MAX_PEAKS = 6


def light_from_probe(panorama: Float[Tensor, "h w 3"], suns: list[dict]) -> Light:
    """A light from a rendered panorama and a list of suns.

    Args:
        panorama: Equirectangular linear radiance; row 0 is up (+z), the middle column +x, to the right -y.
        suns: Entries of suns.json: direction (unit, towards the sun), irradiance (linear rgb) and angular_radius
            (radians).
    """
    panorama, peaks = _without_peaks(panorama)
    directions, solid_angles = cube_directions(_FACE)
    cube = Panorama(
        radiance=_sampled(panorama, directions),
        alpha=torch.ones(6, _FACE, _FACE),
        directions=directions,
        solid_angles=solid_angles,
    )
    captured = light_from_panorama(cube, torch.tensor([0.0, 0.0, 1.0]))
    sources = [
        LightSource(
            direction=_triple(sun["direction"]),
            irradiance=_triple(sun["irradiance"]),
            angular_radius_deg=math.degrees(sun["angular_radius"]),
            name="sun",
        )
        for sun in suns
    ]
    patches = [replace(source, uncertainty_deg=0.0) for source in captured.sources]
    ordered = sorted([*sources, *peaks, *patches], key=lambda source: -source.luminance)
    return Light(sources=tuple(ordered), ambient=captured.ambient, coverage=1.0, unseen_up=0.0)


def _without_peaks(panorama: Float[Tensor, "h w 3"]) -> tuple[Float[Tensor, "h w 3"], list[LightSource]]:
    """The panorama with its peaks replaced by the median of what is near them, and the peaks as sources."""
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
    """Pixels as one round source: as much irradiance, from their mean direction, of their effective solid angle."""
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
    """Unit directions and solid angles of the pixels of an equirectangular panorama, as `light_from_probe` takes it."""
    h, w = panorama.shape[:2]
    down = (torch.arange(h) + 0.5) / h * math.pi
    turn = (2 * math.pi * (0.5 - (torch.arange(w) + 0.5) / w)).expand(h, w)
    flat, up = down.sin()[:, None].expand(h, w), down.cos()[:, None].expand(h, w)
    directions = torch.stack([flat * turn.cos(), flat * turn.sin(), up], -1)
    return directions, flat * (math.pi / h) * (2 * math.pi / w)


def _sampled(panorama: Float[Tensor, "h w 3"], directions: Float[Tensor, "6 s s 3"]) -> Float[Tensor, "6 s s 3"]:
    x, y, z = directions.unbind(-1)
    across, down = -torch.atan2(y, x) / math.pi, -torch.asin(z.clamp(-1, 1)) / (math.pi / 2)
    # one column repeated on both sides, so that the seam at -x is interpolated too
    wide = torch.cat([panorama[:, -1:], panorama, panorama[:, :1]], 1).permute(2, 0, 1)[None]
    across = across * panorama.shape[1] / (panorama.shape[1] + 2)
    grid = torch.stack([across, down], -1).reshape(1, 6 * directions.shape[1], directions.shape[2], 2)
    values = torch.nn.functional.grid_sample(wide, grid, padding_mode="border", align_corners=False)
    return values[0].permute(1, 2, 0).reshape(directions.shape).contiguous()


def _triple(values: list[float]) -> tuple[float, float, float]:
    x, y, z = values
    return (x, y, z)


TRUE_LIGHT_FILE = "true_light.json"


def read_probe(panorama: Path, suns: Path) -> Light:
    """Read the light that was measured at a place: a panorama without the suns (.npy), and a list of suns (.json).

    Raises:
        ValueError: A file is missing or damaged.
    """
    try:
        radiance = torch.from_numpy(np.load(panorama, allow_pickle=False)).float()
        return light_from_probe(radiance, json.loads(suns.read_text()))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{panorama}, {suns.name}: expected a measured light, found {error}") from error


def write_true_light(scene: Path) -> None:
    """Write true_light.json from probe.npy and suns.json of a gathered scene.

    Raises:
        ValueError: One of the two is missing or damaged.
    """
    light = read_probe(scene / "probe.npy", scene / "suns.json")
    (scene / TRUE_LIGHT_FILE).write_text(light_to_json(light))


def read_true_light(path: Path) -> Light:
    """Read true_light.json.

    Raises:
        ValueError: There is no such file.
    """
    if not path.is_file():
        raise ValueError(f"{path}: expected the scene's true light, found none")
    return light_from_json(path.read_text(), name=str(path))
