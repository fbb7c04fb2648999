"""The light transfer's opinion on a rendered pair, under lights made wrong on purpose: log ratios per pixel.

The same functions as in a transfer are asked, at the pixels' own points. Knows no network.
"""

import json
import math
import random
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere, bounding_sphere
from splatgraft.core.gaussians import Gaussians
from splatgraft.relighting.light.confidence import light_confidence
from splatgraft.relighting.light.light import Light
from splatgraft.relighting.light.true_light import light_from_probe
from splatgraft.relighting.shading.irradiance import irradiance, shade_ratio
from splatgraft.relighting.shading.normals import Normals
from splatgraft.relighting.shadows.light_sampling import sample_light
from splatgraft.relighting.shadows.scene_ratio import (
    object_shadow_maps,
    reachable,
    scene_ratio,
    scene_shadow_maps,
    scene_visibility,
    self_visibility,
)
from splatgraft.runtime.atomic_file import atomic_write
from splatgraft.runtime.progress import Progress, silent
from splatgraft.synthesis.benchmark import rendered_cameras
from splatgraft.synthesis.pairs import samples_in
from splatgraft.training.compact.surfaces import Pixels, read_pixels, read_surfels, surfels
from splatgraft.training.compact.wrong_light import wrong

_REACH = 8.0  # as RelightOptions
_GRAY = torch.tensor([0.5, 0.5, 0.5])
_LIFT = 0.004  # metres above a pixel's point, against its own surfels
_NOISE_DEG = 12.0


@dataclass(frozen=True)
class Prior:
    """What light transfer says of all views of an object under one light."""

    log_ratio: Float[Tensor, "v h w 3"]
    """Natural logarithm of the factor on linear colours."""
    prior_confidence: float
    """In the light at the new place, see `trust_in`."""


def write_priors(folders: Sequence[Path], out: Path, *, seed: int, progress: Progress = silent) -> None:
    """Make the priors that `out` lacks of all objects and lights of rendered folders, one file each folder.

    Raises: ValueError where a folder lacks something.
    """
    out.mkdir(parents=True, exist_ok=True)
    for number, folder in enumerate(folders):
        path = out / f"{folder.name}.npz"
        if not path.is_file():
            arrays: dict[str, np.ndarray] = {}
            takes = sorted({(s.object, s.light) for s in samples_in(folder)})
            for object_ in sorted({o for o, _ in takes}):
                lights = [light for o, light in takes if o == object_]
                for light, prior in zip(lights, priors_of(folder, object_, lights, seed=seed), strict=True):
                    arrays[f"{object_}_{light}"] = prior.log_ratio.numpy().astype(np.float16)
                    arrays[f"{object_}_{light}_trust"] = np.array(prior.prior_confidence, np.float32)
            with atomic_write(path) as stream:
                np.savez_compressed(stream, allow_pickle=False, **arrays)
        progress(number + 1, len(folders), folder.name)


def read_light(folder: Path) -> Light:
    """The light that a probe take measured.

    Raises: ValueError where it is missing or broken.
    """
    try:
        panorama = torch.from_numpy(np.load(folder / "0000.npy", allow_pickle=False)).float()
        suns = json.loads((folder / "suns.json").read_text())
    except (OSError, ValueError) as error:
        raise ValueError(f"{folder}: expected 0000.npy and suns.json, found {error}") from error
    return light_from_probe(panorama, suns)


def priors_of(folder: Path, object_: str, lights: list[str], *, seed: int) -> list[Prior]:
    """One prior per light of an object in a folder of pairs.

    Raises: ValueError where the folder lacks something.
    """
    count = len(json.loads((folder / "cameras.json").read_text())["poses"])
    cameras = rendered_cameras(folder, tuple(f"{i:04d}" for i in range(count)))
    pixels = read_pixels(folder, object_, cameras)
    body = read_surfels(folder, object_, _GRAY)
    scene = read_surfels(folder, "scene", _GRAY)
    place = read_light(folder / "place_probe")
    found = []
    for light in lights:
        rng = random.Random(f"prior-{seed}-{folder.name}-{object_}-{light}")
        now, then = wrong(place, rng), wrong(read_light(folder / f"{object_}_{light}_probe"), rng)
        noise = torch.Generator().manual_seed(rng.randrange(2**31))
        asked = _Asked(pixels, body, scene, now, then)
        on_object, on_scene = asked.object_log_ratio(noise), asked.scene_log_ratio()
        inside = pixels.mask[..., None]
        found.append(Prior(inside * on_object + (1 - inside) * on_scene, light_confidence(now)))
    return found


class _Asked:
    """One object under one pair of lights."""

    def __init__(self, pixels: Pixels, body: Gaussians, scene: Gaussians, now: Light, then: Light) -> None:
        self._pixels, self._body, self._then = pixels, body, then
        self._seen = 0.5 * (now.coverage + then.coverage)
        self._beams = sample_light(now)
        self._ball = bounding_sphere(body)
        self._region = BoundingSphere(self._ball.center, 1.2 * _REACH * self._ball.radius)
        self._maps = object_shadow_maps(body, self._ball, self._beams)
        self._around = scene_shadow_maps(scene, self._region, self._beams)

    def object_log_ratio(self, noise: torch.Generator) -> Float[Tensor, "v h w 3"]:
        pixels, beams = self._pixels, self._beams
        inside = (pixels.mask > 0.02) & pixels.there
        facing = torch.nn.functional.normalize(pixels.normals + _smooth_noise(pixels.normals.shape, noise), dim=-1)
        facing = facing[inside].contiguous()
        points = surfels(pixels.points[inside] + _LIFT * pixels.normals[inside], facing, _GRAY)
        shares = scene_visibility(self._around, points.means, facing)
        shares = torch.where(torch.as_tensor(beams.is_source), shares, torch.ones(()))
        own = self_visibility(self._maps, points, facing, beams)
        lit = irradiance(beams, facing, sample_visibility=own * shares)
        before = sample_light(self._then)
        was = irradiance(before, facing, sample_visibility=self_visibility(self._maps, points, facing, before))
        sure = Normals(facing, torch.ones(len(facing)), torch.ones(len(facing), dtype=torch.bool))
        out = torch.zeros(*inside.shape, 3)
        out[inside] = shade_ratio(lit, was, sure, torch.ones(len(facing)), coverage=self._seen).log()
        return out

    def scene_log_ratio(self) -> Float[Tensor, "v h w 3"]:
        pixels, beams = self._pixels, self._beams
        outside = (pixels.mask < 0.98) & pixels.there
        points, facing = pixels.points[outside], pixels.normals[outside]
        near = reachable(points, self._ball, beams, farthest=self._region.radius)
        points, facing = points[near] + _LIFT * facing[near], facing[near].contiguous()
        shares = scene_visibility(self._around, points, facing)
        ratio = scene_ratio(self._maps, points, facing, sample_visibility=shares)
        whole = torch.zeros(len(near), 3)
        whole[near] = (ratio.shadow + ratio.bounce).log()
        out = torch.zeros(*outside.shape, 3)
        out[outside] = whole
        return out


def _smooth_noise(shape: torch.Size, generator: torch.Generator) -> Float[Tensor, "v h w 3"]:
    """Errors of normals as those of Gaussians are: alike over some ten pixels."""
    v, h, w, _ = shape
    coarse = torch.randn(v, 3, max(2, h // 10), max(2, w // 10), generator=generator) * math.tan(
        math.radians(_NOISE_DEG)
    )
    return torch.nn.functional.interpolate(coarse, size=(h, w), mode="bilinear").permute(0, 2, 3, 1)
