"""Light-transfer priors of rendered pairs under perturbed lights: the log ratio of each pixel's colour.

The light transfer's own functions compute the ratios, at the surface points of the pixels.
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
from splatgraft.relighting.shading.irradiance import irradiance, shade_ratio
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
from splatgraft_paper.benchmark.true_light import light_from_probe
from splatgraft_paper.synthesis.benchmark import rendered_cameras
from splatgraft_paper.synthesis.pairs import samples_in
from splatgraft_paper.training.compact.light_perturbation import perturb_light
from splatgraft_paper.training.compact.rendered_surfaces import SurfacePixels, read_pixels, read_surfels, surfels

_GRAY = torch.tensor([0.5, 0.5, 0.5])


@dataclass(frozen=True)
class PriorSettings:
    """Numbers of the priors."""

    reach: float = 8.0
    """Extent of the scene's shadow maps in radii of the object, as in `RelightOptions`."""
    region_margin: float = 1.2
    """Radius of the region of occluders over `reach`. Set by hand."""
    offset_m: float = 0.004
    """Metres by which a point is raised along its normal, against self-shadowing by its own surfels. Set by hand."""
    normal_noise_deg: float = 12.0
    """Error of normals, as on Gaussians. Set by hand."""
    noise_px: int = 10
    """Pixels over which the errors of normals are alike. Set by hand."""
    min_coverage: float = 0.02
    """Coverage from which a pixel gets the object's ratio, and below one minus which it gets the scene's."""


SETTINGS = PriorSettings()


@dataclass(frozen=True)
class PairPrior:
    """The light transfer's result for all views of an object captured under one light."""

    log_ratio: Float[Tensor, "v h w 3"]
    """Natural logarithm of the factor on linear colours."""
    prior_confidence: float
    """Confidence in the target light, see `light_confidence`."""


def write_priors(folders: Sequence[Path], out: Path, *, seed: int, progress: Progress = silent) -> None:
    """Compute the priors of all objects and lights of rendered folders, one .npz file per folder.

    Files that exist are kept.

    Args:
        folders: rendered scenes.
        out: folder for the files.
        seed: of the perturbed lights.
        progress: called after each folder.

    Raises:
        ValueError: a folder lacks a file.
    """
    out.mkdir(parents=True, exist_ok=True)
    for number, folder in enumerate(folders):
        path = out / f"{folder.name}.npz"
        if not path.is_file():
            arrays: dict[str, np.ndarray] = {}
            takes = sorted({(s.object, s.light) for s in samples_in(folder)})
            for object_ in sorted({o for o, _ in takes}):
                lights = [light for o, light in takes if o == object_]
                for light, prior in zip(lights, light_transfer_priors(folder, object_, lights, seed=seed), strict=True):
                    arrays[f"{object_}_{light}"] = prior.log_ratio.numpy().astype(np.float16)
                    arrays[f"{object_}_{light}_trust"] = np.array(prior.prior_confidence, np.float32)
            with atomic_write(path) as stream:
                np.savez_compressed(stream, allow_pickle=False, **arrays)
        progress(number + 1, len(folders), folder.name)


def read_light(folder: Path) -> Light:
    """Read the light that a probe take measured.

    Raises:
        ValueError: it is missing or broken.
    """
    try:
        panorama = torch.from_numpy(np.load(folder / "0000.npy", allow_pickle=False)).float()
        suns = json.loads((folder / "suns.json").read_text())
    except (OSError, ValueError) as error:
        raise ValueError(f"{folder}: expected 0000.npy and suns.json, found {error}") from error
    return light_from_probe(panorama, suns)


def light_transfer_priors(folder: Path, object_: str, lights: list[str], *, seed: int) -> list[PairPrior]:
    """Compute one prior per light of an object.

    Args:
        folder: a rendered scene.
        object_: name of the object.
        lights: names of the lights under which it was rendered alone.
        seed: of the perturbed lights.

    Raises:
        ValueError: the folder lacks a file.
    """
    count = len(json.loads((folder / "cameras.json").read_text())["poses"])
    cameras = rendered_cameras(folder, tuple(f"{i:04d}" for i in range(count)))
    pixels = read_pixels(folder, object_, cameras)
    object_surfels = read_surfels(folder, object_, _GRAY)
    scene_surfels = read_surfels(folder, "scene", _GRAY)
    light_at_place = read_light(folder / "place_probe")
    priors = []
    for light in lights:
        rng = random.Random(f"prior-{seed}-{folder.name}-{object_}-{light}")
        target_light = perturb_light(light_at_place, rng)
        source_light = perturb_light(read_light(folder / f"{object_}_{light}_probe"), rng)
        noise = torch.Generator().manual_seed(rng.randrange(2**31))
        transfer = _PairTransfer(pixels, object_surfels, scene_surfels, source_light, target_light)
        on_object, on_scene = transfer.object_log_ratio(noise), transfer.scene_log_ratio()
        mask = pixels.mask[..., None]
        priors.append(PairPrior(mask * on_object + (1 - mask) * on_scene, light_confidence(target_light)))
    return priors


class _PairTransfer:
    """Light transfer of one object from its source light to the target light."""

    def __init__(
        self,
        pixels: SurfacePixels,
        object_surfels: Gaussians,
        scene_surfels: Gaussians,
        source_light: Light,
        target_light: Light,
    ) -> None:
        self._pixels, self._source_light = pixels, source_light
        self._samples = sample_light(target_light)
        self._sphere = bounding_sphere(object_surfels)
        radius = SETTINGS.region_margin * SETTINGS.reach * self._sphere.radius
        self._region = BoundingSphere(self._sphere.center, radius)
        self._object_maps = object_shadow_maps(object_surfels, self._sphere, self._samples)
        self._scene_maps = scene_shadow_maps(scene_surfels, self._region, self._samples)

    def object_log_ratio(self, noise: torch.Generator) -> Float[Tensor, "v h w 3"]:
        """Log ratio of the object's irradiance; 0 in the other pixels."""
        pixels, samples = self._pixels, self._samples
        inside = (pixels.mask > SETTINGS.min_coverage) & pixels.hit
        normals = torch.nn.functional.normalize(pixels.normals + _smooth_noise(pixels.normals.shape, noise), dim=-1)
        normals = normals[inside].contiguous()
        points = surfels(pixels.points[inside] + SETTINGS.offset_m * pixels.normals[inside], normals, _GRAY)
        visible = scene_visibility(self._scene_maps, points.means, normals)
        visible = torch.where(torch.as_tensor(samples.is_source), visible, torch.ones(()))
        self_visible = self_visibility(self._object_maps, points, normals, samples)
        target = irradiance(samples, normals, sample_visibility=self_visible * visible)
        source_samples = sample_light(self._source_light)
        self_visible = self_visibility(self._object_maps, points, normals, source_samples)
        source = irradiance(source_samples, normals, sample_visibility=self_visible)
        log_ratio = torch.zeros(*inside.shape, 3)
        log_ratio[inside] = shade_ratio(target, source, torch.ones(len(normals))).log()
        return log_ratio

    def scene_log_ratio(self) -> Float[Tensor, "v h w 3"]:
        """Log ratio of the shadow and bounce that the object causes on the scene; 0 in the other pixels."""
        pixels, samples = self._pixels, self._samples
        outside = (pixels.mask < 1 - SETTINGS.min_coverage) & pixels.hit
        points, normals = pixels.points[outside], pixels.normals[outside]
        near = reachable(points, self._sphere, samples, farthest=self._region.radius)
        points, normals = points[near] + SETTINGS.offset_m * normals[near], normals[near].contiguous()
        visible = scene_visibility(self._scene_maps, points, normals)
        ratio = scene_ratio(self._object_maps, points, normals, sample_visibility=visible)
        found = torch.zeros(len(near), 3)
        found[near] = (ratio.shadow + ratio.bounce).log()
        log_ratio = torch.zeros(*outside.shape, 3)
        log_ratio[outside] = found
        return log_ratio


def _smooth_noise(shape: torch.Size, generator: torch.Generator) -> Float[Tensor, "v h w 3"]:
    """Errors of normals as on Gaussians: alike over several pixels."""
    v, h, w, _ = shape
    coarse = torch.randn(
        v, 3, max(2, h // SETTINGS.noise_px), max(2, w // SETTINGS.noise_px), generator=generator
    ) * math.tan(math.radians(SETTINGS.normal_noise_deg))
    return torch.nn.functional.interpolate(coarse, size=(h, w), mode="bilinear").permute(0, 2, 3, 1)
