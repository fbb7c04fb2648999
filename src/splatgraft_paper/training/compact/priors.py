"""Light-transfer priors of rendered pairs under perturbed lights: the log ratio of each pixel's colour.

1. The true lights at both places get the errors, uncertainty and confidence of estimates.
2. Pixels are unprojected to surface points; sampled surface points become surfels that cast shadows.
3. The light transfer's own functions compute the ratio of new to old light at the points.
"""

import json
import math
import random
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import KDTree
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere, bounding_sphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.directions import frames_along
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import read_mask, read_rgb
from splatgraft.core.rotations import quaternion_from_rotation
from splatgraft.core.spherical_harmonics import C0
from splatgraft.relighting.light.light import Light, LightSource, light_confidence
from splatgraft.relighting.light.samples import sample_light
from splatgraft.relighting.shading import irradiance, shade_ratio
from splatgraft.relighting.shadows.scene_ratio import (
    object_shadow_maps,
    reachable,
    scene_ratio,
    scene_shadow_maps,
    scene_visibility,
    self_visibility,
)
from splatgraft.runtime.files import atomic_write
from splatgraft.runtime.progress import Progress, silent
from splatgraft_paper.benchmark.true_light import read_probe
from splatgraft_paper.synthesis.benchmark import rendered_cameras
from splatgraft_paper.synthesis.pairs import samples_in

_GRAY = torch.tensor([0.5, 0.5, 0.5])
# errors of lights, set by hand
_MAX_SPREAD_DEG = 20.0  # degrees; maximum standard deviation of a source's direction
_MAX_ANGLE_DEG = 30.0  # degrees; maximum error of a source's direction
_LEVEL_DEVIATION, _MAX_LEVEL = 0.35, 1.4  # standard deviation and maximum of the log error of the overall level
_TINT_DEVIATION = 0.06  # standard deviation of the log error of each colour channel
_MAX_STRENGTH_FACTOR = 4.0  # maximum error, either way, of the ratio of sources to ambient light
_STRENGTH_DEVIATION = 0.45  # standard deviation of the log of that error, relative to the log of its maximum
_MISSED_SHARE = 0.05  # probability that a source is missed
_COVERAGE, _CONFIDENCE = (0.45, 1.0), (0.6, 1.0)  # ranges of the environment's coverage and a source's confidence
_UNCERTAINTY_OFFSET_DEG = 2.0  # degrees; added to every source's recorded uncertainty
_UNCERTAINTY_FACTOR = (0.7, 1.3)  # range of the recorded uncertainty relative to the standard deviation
# geometry, set by hand
_REACH, _REGION_MARGIN = 8.0, 1.2  # radius of shadow maps in radii of the object (`RelightOptions`); margin on it
_OFFSET_M = 0.004  # metres along the normal; keeps a point out of the shadow of its own surfels
_NORMAL_NOISE_DEG, _NOISE_PX = 12.0, 10  # error of normals, as on Gaussians, and its correlation distance, pixels
_MIN_COVERAGE = 0.02  # minimum coverage by the object, or by the scene, of a pixel that gets its ratio


@dataclass(frozen=True)
class PairPrior:
    """Result of the light transfer for all views of an object captured under one light."""

    log_ratio: Float[Tensor, "v h w 3"]
    """Natural logarithm of the factor on linear colours."""
    prior_confidence: float
    """Confidence in the target light (see `light_confidence`)."""


def write_priors(folders: Sequence[Path], out: Path, *, seed: int, progress: Progress = silent) -> None:
    """Compute the priors of all objects and lights of rendered folders, one .npz each; existing files are kept."""
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


def light_transfer_priors(folder: Path, object_: str, lights: list[str], *, seed: int) -> list[PairPrior]:
    """Compute one prior for each light under which an object was rendered alone."""
    count = len(json.loads((folder / "cameras.json").read_text())["poses"])
    cameras = rendered_cameras(folder, tuple(f"{i:04d}" for i in range(count)))
    pixels = read_pixels(folder, object_, cameras)
    object_surfels = read_surfels(folder, object_, _GRAY)
    scene_surfels = read_surfels(folder, "scene", _GRAY)
    light_at_place = _probe(folder / "place_probe")
    priors = []
    for light in lights:
        rng = random.Random(f"prior-{seed}-{folder.name}-{object_}-{light}")
        target_light = perturb_light(light_at_place, rng)
        source_light = perturb_light(_probe(folder / f"{object_}_{light}_probe"), rng)
        noise = torch.Generator().manual_seed(rng.randrange(2**31))
        transfer = _PairTransfer(pixels, object_surfels, scene_surfels, source_light, target_light)
        on_object, on_scene = transfer.object_log_ratio(noise), transfer.scene_log_ratio()
        mask = pixels.mask[..., None]
        priors.append(PairPrior(mask * on_object + (1 - mask) * on_scene, light_confidence(target_light)))
    return priors


@dataclass(frozen=True)
class SurfacePixels:
    """Surface points visible in the pixels of all cameras, with one object in the scene."""

    points: Float[Tensor, "v h w 3"]
    """Positions, world, metres."""
    normals: Float[Tensor, "v h w 3"]
    """Unit normals, world."""
    mask: Float[Tensor, "v h w"]
    """Coverage by the object, in [0, 1]."""
    hit: Bool[Tensor, "v h w"]
    """Whether the pixel shows a surface instead of the sky."""


def read_pixels(folder: Path, object_: str, cameras: Cameras) -> SurfacePixels:
    """Read the pixels of an object's take and unproject them by their depth."""
    take, points, normals, masks = folder / object_, [], [], []
    for i in range(len(cameras)):
        path = take / f"{i:04d}_depth.npy"
        try:
            depth = torch.from_numpy(np.load(path, allow_pickle=False).astype(np.float32))
        except (OSError, ValueError) as error:
            raise ValueError(f"{path}: expected a depth map, found {error}") from error
        k, pose = cameras.intrinsics[i], cameras.world_from_camera[i]
        h, w = depth.shape
        v, u = torch.meshgrid(torch.arange(h) + 0.5, torch.arange(w) + 0.5, indexing="ij")
        rays = torch.stack([(u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], torch.ones_like(u)], -1)
        points.append((rays * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3])
        normal = read_rgb(take / f"{i:04d}_normal.png") * 2 - 1
        normals.append(torch.nn.functional.normalize(normal, dim=-1))
        masks.append(torch.where(depth > 0, read_mask(take / f"{i:04d}_mask.png"), -1.0))
    mask = torch.stack(masks)
    return SurfacePixels(torch.stack(points), torch.stack(normals), mask.clamp_min(0), mask >= 0)


def read_surfels(folder: Path, name: str, color: Float[Tensor, "3"]) -> Gaussians:
    """Read surface points of an object, or of the `scene`, as surfels."""
    path = folder / f"{name}_surface" / "0000.npy"
    try:
        found = torch.from_numpy(np.load(path, allow_pickle=False).astype(np.float32))
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: expected points on surfaces, found {error}") from error
    if found.ndim != 2 or found.shape[1] != 6 or len(found) < 10:
        raise ValueError(f"{path}: expected (n, 6) points and normals, found {tuple(found.shape)}")
    return surfels(found[:, :3], torch.nn.functional.normalize(found[:, 3:], dim=1), color)


def surfels(points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], color: Float[Tensor, "3"]) -> Gaussians:
    """Make flat, opaque Gaussians that close the surface; their width follows the spacing of the points."""
    # the spacing is the median distance to the fourth neighbour, measured at every seventh point; set by hand, like all
    distances, _ = KDTree(points.numpy()).query(points.numpy()[::7], k=5)
    width = max(1e-4, 0.6 * float(np.median(distances[:, -1])))
    rotations = frames_along(-normals).transpose(1, 2)
    return Gaussians(
        means=points,
        log_scales=torch.tensor([width, width, 0.1 * width]).log().repeat(len(points), 1),
        quaternions=quaternion_from_rotation(rotations),
        opacity_logits=torch.full((len(points),), 3.0),
        sh=((color - 0.5) / C0).repeat(len(points), 1)[:, None],
    )


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
        radius = _REGION_MARGIN * _REACH * self._sphere.radius
        self._region = BoundingSphere(self._sphere.center, radius)
        self._object_maps = object_shadow_maps(object_surfels, self._sphere, self._samples)
        self._scene_maps = scene_shadow_maps(scene_surfels, self._region, self._samples)

    def object_log_ratio(self, noise: torch.Generator) -> Float[Tensor, "v h w 3"]:
        """Compute the log ratio of the object's irradiance; 0 in other pixels."""
        pixels, samples = self._pixels, self._samples
        inside = (pixels.mask > _MIN_COVERAGE) & pixels.hit
        normals = torch.nn.functional.normalize(pixels.normals + _smooth_noise(pixels.normals.shape, noise), dim=-1)
        normals = normals[inside].contiguous()
        points = surfels(pixels.points[inside] + _OFFSET_M * pixels.normals[inside], normals, _GRAY)
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
        """Compute the log ratio of the object's shadow and bounce on the scene; 0 in other pixels."""
        pixels, samples = self._pixels, self._samples
        outside = (pixels.mask < 1 - _MIN_COVERAGE) & pixels.hit
        points, normals = pixels.points[outside], pixels.normals[outside]
        near = reachable(points, self._sphere, samples, farthest=self._region.radius)
        points, normals = points[near] + _OFFSET_M * normals[near], normals[near].contiguous()
        visible = scene_visibility(self._scene_maps, points, normals)
        ratio = scene_ratio(self._object_maps, points, normals, sample_visibility=visible)
        found = torch.zeros(len(near), 3)
        found[near] = (ratio.shadow + ratio.bounce).log()
        log_ratio = torch.zeros(*outside.shape, 3)
        log_ratio[outside] = found
        return log_ratio


def _smooth_noise(shape: torch.Size, generator: torch.Generator) -> Float[Tensor, "v h w 3"]:
    """Draw errors of normals like those of Gaussians, correlated over several pixels."""
    v, h, w, _ = shape
    coarse = torch.randn(v, 3, max(2, h // _NOISE_PX), max(2, w // _NOISE_PX), generator=generator) * math.tan(
        math.radians(_NORMAL_NOISE_DEG)
    )
    return torch.nn.functional.interpolate(coarse, size=(h, w), mode="bilinear").permute(0, 2, 3, 1)


def _probe(folder: Path) -> Light:
    return read_probe(folder / "0000.npy", folder / "suns.json")


def perturb_light(light: Light, rng: random.Random) -> Light:
    """Draw a copy of a known light with the errors, uncertainty and confidence of an estimate.

    The recorded uncertainty is the standard deviation from which the error in direction was drawn, times a factor.
    """
    spread = rng.uniform(0.0, _MAX_SPREAD_DEG)
    level = math.exp(max(-_MAX_LEVEL, min(_MAX_LEVEL, rng.gauss(0.0, _LEVEL_DEVIATION))))
    tint = [math.exp(rng.gauss(0.0, _TINT_DEVIATION)) for _ in range(3)]
    log_strength = max(-1.0, min(1.0, rng.gauss(0.0, _STRENGTH_DEVIATION)))
    strength = math.exp(log_strength * math.log(_MAX_STRENGTH_FACTOR))
    factor = [level * strength * t for t in tint]
    sources = [
        _perturb_source(source, rng, spread, factor=factor) for source in light.sources if rng.random() > _MISSED_SHARE
    ]
    coverage = rng.uniform(*_COVERAGE)
    return Light(
        tuple(sources),
        ambient=light.ambient * (level * torch.tensor(tint)),
        coverage=coverage,
        unseen_up=1 - coverage,
    )


def _perturb_source(source: LightSource, rng: random.Random, spread: float, *, factor: list[float]) -> LightSource:
    angle = math.radians(min(_MAX_ANGLE_DEG, abs(rng.gauss(0.0, spread))))
    azimuth = rng.uniform(0.0, 2 * math.pi)
    direction = torch.tensor(source.direction)
    helper = torch.tensor([0.0, 0.0, 1.0]) if abs(source.direction[2]) < 0.9 else torch.tensor([1.0, 0.0, 0.0])
    tangent = torch.nn.functional.normalize(torch.linalg.cross(direction, helper), dim=0)
    bitangent = torch.linalg.cross(direction, tangent)
    offset = math.cos(azimuth) * tangent + math.sin(azimuth) * bitangent
    x, y, z = (math.cos(angle) * direction + math.sin(angle) * offset).tolist()
    r, g, b = (value * f for value, f in zip(source.irradiance, factor, strict=True))
    return replace(
        source,
        direction=(x, y, z),
        irradiance=(r, g, b),
        uncertainty_deg=_UNCERTAINTY_OFFSET_DEG + spread * rng.uniform(*_UNCERTAINTY_FACTOR),
        confidence=rng.uniform(*_CONFIDENCE),
    )
