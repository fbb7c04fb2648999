"""Training pairs without Blender: two balls on a floor under a sun and uniform light, in closed form.

One ball belongs to the scene and shows the direction of the light; the other one is the inserted object. The pairs are
for the recipe `tiny`, which shows all steps of a training in minutes.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch

from splatgraft_paper.training.pairs import RelitSample

_SAMPLES = 3  # rays per pixel in each direction, so that masks have soft edges


@dataclass(frozen=True)
class Sun:
    """A directional light."""

    direction: np.ndarray
    """Unit vector towards the sun; z is up."""
    irradiance: np.ndarray
    """Irradiance of a surface that faces the sun, linear RGB."""


def render_spheres(seed: int, *, width: int, height: int, lights: int) -> RelitSample:
    """Render the scene of a seed, and its view under `lights` other suns."""
    rng = np.random.default_rng(seed)
    floor, sky = rng.uniform(0.2, 0.6, 3), rng.uniform(0.2, 0.8, 3)
    albedos = [rng.uniform(0.3, 0.7, 1).repeat(3), rng.uniform(0.15, 0.8, 3)]
    places = [np.array([rng.uniform(-0.65, -0.45), rng.uniform(-0.1, 0.2)]), rng.uniform((0.2, -0.2), (0.55, 0.15))]
    radii = [rng.uniform(0.24, 0.3), rng.uniform(0.28, 0.38)]
    balls = [(np.append(place, r), r, albedo) for place, r, albedo in zip(places, radii, albedos, strict=True)]
    suns = [_sun(rng) for _ in range(1 + lights)]
    rays, eye = _rays(width, height)

    def reduced(samples: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(samples.reshape(height, _SAMPLES, width, _SAMPLES, -1).mean((1, 3))).float()

    def picture(shown: list, sun: Sun) -> torch.Tensor:
        return reduced(_srgb(_radiance(rays, eye, shown, (floor, sky), sun)))

    hit = _distance(rays, eye, balls[1])
    first = np.isfinite(hit) & (hit < _distance(rays, eye, balls[0]))
    return RelitSample(
        target=picture(balls, suns[0]),
        background=picture(balls[:1], suns[0]),
        mask=reduced(first[..., None].astype(float))[..., 0],
        relit=[picture(balls, sun) for sun in suns[1:]],
    )


def _sun(rng: np.random.Generator) -> Sun:
    azimuth, up = rng.uniform(0, 2 * math.pi), rng.uniform(0.5, 1.1)
    direction = np.array([math.cos(up) * math.cos(azimuth), math.cos(up) * math.sin(azimuth), math.sin(up)])
    return Sun(direction, rng.uniform(1.8, 2.8) * np.array([1.0, rng.uniform(0.8, 1.0), rng.uniform(0.6, 1.0)]))


def _rays(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Compute unit rays (h w 3) of a camera that looks slightly down, and its position."""
    eye, down = np.array([0.0, -2.4, 1.3]), 0.4
    focal = 0.5 * width * _SAMPLES / math.tan(0.5 * 0.9)
    v, u = np.meshgrid(np.arange(height * _SAMPLES) + 0.5, np.arange(width * _SAMPLES) + 0.5, indexing="ij")
    x, y = (u - width * _SAMPLES / 2) / focal, (v - height * _SAMPLES / 2) / focal
    forward = np.array([0.0, math.cos(down), -math.sin(down)])
    below = np.array([0.0, -math.sin(down), -math.cos(down)])
    rays = x[..., None] * np.array([1.0, 0, 0]) + y[..., None] * below + forward
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True), eye


def _distance(rays: np.ndarray, origin: np.ndarray, ball: tuple) -> np.ndarray:
    """Compute the distance along unit rays to a ball, infinite for rays that miss it."""
    centre, radius, _ = ball
    offset = origin - centre
    b, c = (rays * offset).sum(-1), (offset**2).sum(-1) - radius**2
    inside = b**2 - c
    t = -b - np.sqrt(np.maximum(inside, 0))
    return np.where((inside > 0) & (t > 1e-4), t, np.inf)


def _radiance(rays: np.ndarray, eye: np.ndarray, balls: list, surroundings: tuple, sun: Sun) -> np.ndarray:
    """Shade the nearest surfaces (h w 3), linear: albedo / pi * irradiance, with cast shadows and ambient occlusion."""
    floor, sky = surroundings
    to_floor = np.where(rays[..., 2] < 0, -eye[2] / np.minimum(rays[..., 2], -1e-6), np.inf)
    distances = [to_floor, *(_distance(rays, eye, ball) for ball in balls)]
    nearest = np.argmin(distances, axis=0)
    t = np.min(distances, axis=0)
    point = eye + np.where(np.isfinite(t), t, 0)[..., None] * rays
    normal = np.broadcast_to(np.array([0.0, 0, 1]), rays.shape).copy()
    albedo = np.broadcast_to(floor, rays.shape).copy()
    for number, (centre, radius, colour) in enumerate(balls, 1):
        mine = nearest == number
        normal[mine] = (point[mine] - centre) / radius
        albedo[mine] = colour
    towards = np.broadcast_to(sun.direction, rays.shape)
    lit = (normal @ sun.direction).clip(0)
    open_share = 0.5 + 0.5 * normal[..., 2]
    for number, ball in enumerate(balls, 1):
        lit = np.where((nearest != number) & np.isfinite(_distance(towards, point, ball)), 0, lit)
        away = ball[0] - point
        far = np.linalg.norm(away, axis=-1)
        facing = ((away * normal).sum(-1) / np.maximum(far, 1e-6)).clip(0)
        open_share = open_share * np.where(nearest == number, 1, 1 - facing * np.minimum(1, ball[1] / far) ** 2)
    irradiance = math.pi * 0.5 * open_share[..., None] + lit[..., None] * sun.irradiance
    return np.where(np.isfinite(t)[..., None], albedo / math.pi * irradiance, sky)


def _srgb(linear: np.ndarray) -> np.ndarray:
    linear = linear.clip(0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
