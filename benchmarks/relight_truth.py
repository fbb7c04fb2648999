"""Measure the error of shadows of a ball and a box on a plane: the transfer's picture against ray casting.

`python benchmarks/relight_truth.py [--pictures FOLDER]`. The light is given: a sun of half a degree, round lights of 10
and 30 degrees, an even sky. The plane consists of small, middle or large Gaussians. The transfer splits those that are
wider than an edge; it is also measured without splitting. Errors are of the ratio of linear light after to before, over
pixels beside the object whose true ratio is below 0.95.
"""

import argparse
import math
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from PIL import Image
from torch import Tensor

from splatgraft.compositing.composite import Composite, PlacedObject
from splatgraft.core.cameras import Cameras, look_at, pinhole
from splatgraft.core.directions import even_directions, frames_along, vogel_offsets
from splatgraft.core.gaussians import Gaussians
from splatgraft.core.images import linear_from_srgb
from splatgraft.core.rotations import quaternion_from_rotation
from splatgraft.core.similarity import Similarity
from splatgraft.core.spherical_harmonics import dc_from_rgb
from splatgraft.relighting import Light, LightSource, RelightOptions, relight
from splatgraft.relighting.light.light import fit_ambient
from splatgraft.rendering import render

SUN = (0.5, -0.3, 0.8)
SIZES = {"small": 0.006, "middle": 0.03, "large": 0.15}  # of the plane's Gaussians; the ball's radius is 0.3
BAND = 0.95
KINDS = ("soft", "hard")
VIEW = 7


@dataclass(frozen=True)
class Ball:
    """Ball on the plane z = 0."""

    radius: float = 0.3

    def blocks(self, origin: Float[Tensor, "... 3"], direction: Float[Tensor, "... 3"]) -> Bool[Tensor, "..."]:
        """Return whether rays hit the ball."""
        away = torch.tensor([0.0, 0.0, self.radius]) - origin
        along = (away * direction).sum(-1)
        return (along > 0) & ((away**2).sum(-1) - along**2 < self.radius**2)

    def gaussians(self) -> Gaussians:
        """Return black Gaussians, which bounce no light."""
        around, width = even_directions(40000), self.radius / 110
        # the silhouette at half alpha is 0.5% wider than the true one
        return surfels(self.radius * around + torch.tensor([0.0, 0.0, self.radius]), around, width)


@dataclass(frozen=True)
class Box:
    """Turned box on the plane, taller than wide."""

    half: tuple[float, float, float] = (0.2, 0.14, 0.3)

    def blocks(self, origin: Float[Tensor, "... 3"], direction: Float[Tensor, "... 3"]) -> Bool[Tensor, "..."]:
        """Return whether rays hit the box."""
        half = torch.tensor(self.half)
        start = (origin - torch.tensor([0.0, 0.0, self.half[2]])) @ self._turn()
        step = direction @ self._turn()
        step = torch.where(step.abs() < 1e-9, 1e-9, step)
        one, other = (-half - start) / step, (half - start) / step
        enters, leaves = torch.minimum(one, other).amax(-1), torch.maximum(one, other).amin(-1)
        return (leaves > enters) & (leaves > 0)

    def gaussians(self) -> Gaussians:
        """Return black Gaussians, which bounce no light."""
        gap, half = 0.004, torch.tensor(self.half)
        points, normals = [], []
        for axis in range(3):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            across = [torch.arange(-float(half[i]) + gap / 2, float(half[i]), gap) for i in (u, v)]
            grid = torch.stack(torch.meshgrid(*across, indexing="ij"), -1).reshape(-1, 2)
            for side in (-1.0, 1.0):
                face = torch.zeros(len(grid), 3)
                face[:, axis], face[:, u], face[:, v] = side * float(half[axis]), grid[:, 0], grid[:, 1]
                points.append(face)
                normals.append(side * torch.eye(3)[axis].repeat(len(grid), 1))
        turn = self._turn()
        moved = torch.cat(points) @ turn.T + torch.tensor([0.0, 0.0, self.half[2]])
        return surfels(moved, torch.cat(normals) @ turn.T, 0.7 * gap)

    @staticmethod
    def _turn() -> Float[Tensor, "3 3"]:
        c, s = math.cos(0.5), math.sin(0.5)
        return torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def surfels(points: Tensor, normals: Tensor, width: float, gray: float = 0.0) -> Gaussians:
    n = len(points)
    return Gaussians(
        points,
        torch.tensor([width, width, 0.1 * width]).log().repeat(n, 1),
        quaternion_from_rotation(frames_along(-normals).transpose(1, 2)),
        torch.full((n,), 3.0),
        dc_from_rgb(torch.full((n, 1, 3), gray)),
    )


def plane(width: float) -> Gaussians:
    """Return Gaussians of standard deviation `width`, 1.5 `width` apart, so that no ground shows through."""
    generator = torch.Generator().manual_seed(0)
    x = torch.arange(-2.4, 2.4, 1.5 * width)
    grid = torch.stack(torch.meshgrid(x, x, indexing="ij"), -1).reshape(-1, 2)
    grid = grid + 0.1 * width * torch.randn(grid.shape, generator=generator)
    up = torch.tensor([[0.0, 0.0, 1.0]]).repeat(len(grid), 1)
    # thin: the plane is where the truth has it
    flat = surfels(torch.cat([grid, torch.zeros(len(grid), 1)], 1), up, width, gray=0.5)
    flat.log_scales[:, 2] = math.log(0.002)
    return flat


def disk(direction: Tensor, radius_deg: float, count: int) -> Float[Tensor, "n 3"]:
    """Return directions spread evenly over the solid angle of a round light."""
    i = torch.arange(count) + 0.5
    cosine = 1 - i / count * (1 - math.cos(math.radians(radius_deg)))
    return vogel_offsets(direction, (1 - cosine**2).sqrt(), i) + cosine[:, None] * direction


def true_ratio(shape: Ball | Box, light: Light, points: Float[Tensor, "m 3"]) -> Float[Tensor, " m"]:
    """Return irradiance on the plane with the object over irradiance without it, by ray casting."""
    hemisphere = even_directions(8192)
    hemisphere = hemisphere[hemisphere[:, 2] > 0]
    sky = float(light.ambient_radiance(hemisphere[:1])[0, 0]) * 2 * math.pi / len(hemisphere)
    rays, weights = [hemisphere], [sky * hemisphere[:, 2]]
    for source in light.sources:
        towards = disk(torch.tensor(source.direction), source.angular_radius_deg, 1024)
        rays.append(towards)
        weights.append(source.irradiance[0] / len(towards) * towards[:, 2].clamp_min(0))
    direction, weight = torch.cat(rays), torch.cat(weights)
    out = torch.empty(len(points))
    for start in range(0, len(points), 512):
        blocked = shape.blocks(points[start : start + 512, None], direction[None])
        out[start : start + 512] = 1 - (blocked * weight).sum(1) / weight.sum()
    return out


def lights() -> dict[str, Light]:
    direction = tuple(torch.nn.functional.normalize(torch.tensor(SUN), dim=0).tolist())
    sky = fit_ambient(torch.full((3,), 0.25))

    def round_light(radius_deg: float) -> Light:
        return Light(sources=(LightSource(direction, (3.0, 3.0, 3.0), angular_radius_deg=radius_deg),), ambient=sky)

    return {
        "hard": round_light(0.25),
        "soft 10": round_light(5.0),
        "soft 30": round_light(15.0),
        "sky": Light(sources=(), ambient=sky),
    }


def views() -> Cameras:
    turns = torch.arange(12) / 12 * 2 * math.pi
    eyes = torch.stack([2.2 * turns.cos(), 2.2 * turns.sin(), torch.full((12,), 1.5)], 1)
    return pinhole(
        look_at(eyes, torch.tensor([-0.2, 0.1, 0.1]), torch.tensor([0.0, 0.0, 1.0])), 480.0, width=512, height=384
    )


def on_plane(camera: Cameras) -> Float[Tensor, "m 3"]:
    """Return the intersection of each pixel's ray with z = 0."""
    width, height = camera.sizes[0].tolist()
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    k, pose = camera.intrinsics[0], camera.world_from_camera[0]
    rays = torch.stack([(u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], torch.ones_like(u)], -1) @ pose[:3, :3].T
    return (pose[:3, 3] - rays * (pose[2, 3] / rays[..., 2:])).reshape(-1, 3)


@dataclass(frozen=True)
class Measured:
    """One view of one case."""

    truth: Float[Tensor, "h w"]
    found: Float[Tensor, "h w"]
    band: Bool[Tensor, "h w"]

    @property
    def rmse(self) -> float:
        """Return the root mean square error over the band."""
        return float(((self.truth - self.found)[self.band] ** 2).mean().sqrt())


def measure(shape: Ball | Box, light: Light, truth: Float[Tensor, "h w"], *, width: float, split: bool) -> Measured:
    """Return the transfer's shadow on a plane of Gaussians `width` wide, in one view, with the truth."""
    scene, thing, cameras = plane(width), shape.gaussians(), views()
    nothing_erased = torch.zeros(scene.count, dtype=torch.bool)
    composite = Composite(scene, (PlacedObject(thing, Similarity(1.0, torch.eye(3), torch.zeros(3))),), nothing_erased)
    options = RelightOptions() if split else RelightOptions(most_added=0.0)
    relit = relight(composite, cameras, light=light, options=options)
    camera = cameras[VIEW]
    before = render(scene, camera)
    # the plane alone is rendered; pixels that the object's own splats cover are not measured
    after = render(relit.shaded().select(~relit.is_object), camera)
    covered = render(thing, camera).alpha[0] > 0.001
    light_before, light_after = (linear_from_srgb(r.color[0].clamp(0, 1)).mean(-1) for r in (before, after))
    whole = before.alpha[0] > 0.9
    band = (truth < BAND) & ~covered & whole
    return Measured(truth=truth, found=light_after / light_before.clamp_min(1e-3), band=band)


def picture(one: Measured) -> Float[Tensor, "h w"]:
    """Return truth, transfer, and three times their difference around grey, side by side."""
    difference = (0.5 + 3 * (one.found - one.truth) * one.band).clamp(0, 1)
    return torch.cat([one.truth.clamp(0, 1), one.found.clamp(0, 1), difference], 1)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pictures", type=Path, help="folder for truth, result and difference of every case")
    folder = parser.parse_args().pictures
    camera = views()[VIEW]
    wide, height = camera.sizes[0].tolist()
    errors: dict[tuple[str, bool], list[float]] = {(kind, split): [] for kind in KINDS for split in (False, True)}
    for light_name, light in lights().items():
        kind = "hard" if light_name == "hard" else "soft"
        for shape in (Ball(), Box()):
            truth = true_ratio(shape, light, on_plane(camera)).reshape(height, wide)
            for size, width in SIZES.items():
                row = {}
                for split in (False, True):
                    one = measure(shape, light, truth, width=width, split=split)
                    row[split] = one.rmse
                    errors[kind, split].append(one.rmse)
                    if folder is not None:
                        folder.mkdir(parents=True, exist_ok=True)
                        name = f"{light_name}_{type(shape).__name__}_{size}_{'split' if split else 'whole'}.png"
                        Image.fromarray((picture(one) * 255).byte().numpy()).save(folder / name.replace(" ", ""))
                case = f"{light_name:8s} {type(shape).__name__:5s} {size:7s}"
                print(f"{case} whole {row[False]:.3f}   split {row[True]:.3f}", flush=True)
    for split in (False, True):
        worst = " ".join(f"worst_{kind}={max(errors[kind, split]):.3f}" for kind in KINDS)
        mean = " ".join(f"{kind}_rmse={sum(errors[kind, split]) / len(errors[kind, split]):.3f}" for kind in KINDS)
        print(f"{'split' if split else 'whole'}: {worst} {mean}")


if __name__ == "__main__":
    main()
