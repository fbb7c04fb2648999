"""Flat Gaussians on surfaces of known geometry, and cameras around them, for tests in closed form."""

import math
from collections.abc import Callable
from dataclasses import fields
from datetime import UTC, datetime

import torch
from torch import Tensor

from splatgraft.core.cameras import Cameras, look_at, pinhole
from splatgraft.core.clock_sun import ClockSun, SunCandidate
from splatgraft.core.directions import even_directions, frames_along
from splatgraft.core.gaussians import Gaussians, KnownSurface
from splatgraft.core.images import srgb_from_linear
from splatgraft.core.rotations import quaternion_from_rotation
from splatgraft.core.spherical_harmonics import dc_from_rgb

UP = torch.tensor([0.0, 0.0, 1.0])


def surfels(
    points: Tensor,
    normals: Tensor,
    *,
    width: float,
    srgb: Tensor | tuple[float, float, float] | float = 0.5,
    thickness: float | None = None,
) -> Gaussians:
    """Return discs of standard deviation `width` at `points (n, 3)`; `srgb` is a gray, a colour or one per point."""
    n = len(points)
    thickness = 0.1 * width if thickness is None else thickness
    return Gaussians(
        means=points,
        log_scales=torch.tensor([width, width, thickness]).log().repeat(n, 1),
        quaternions=quaternion_from_rotation(frames_along(-normals).transpose(1, 2)),
        opacity_logits=torch.full((n,), 3.0),
        sh=dc_from_rgb(torch.as_tensor(srgb).expand(n, 3))[:, None].clone(),
    )


def blobs(
    points: Tensor, width: float, *, srgb: Tensor | tuple[float, float, float] | float = 0.5, opacity_logit: float = 3.0
) -> Gaussians:
    """Return round Gaussians of standard deviation `width`, whose own shape tells no normal."""
    n = len(points)
    return Gaussians(
        means=points,
        log_scales=torch.full((n, 3), math.log(width)),
        quaternions=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        opacity_logits=torch.full((n,), opacity_logit),
        sh=dc_from_rgb(torch.as_tensor(srgb).expand(n, 3))[:, None].clone(),
    )


def same_bits(one: Gaussians, other: Gaussians) -> bool:
    return all(torch.equal(getattr(one, f.name), getattr(other, f.name)) for f in fields(Gaussians))


def ball(albedo=0.5, *, metallic=0.0, roughness=1.0, emission=0.0, count=1500) -> KnownSurface:
    """Return a ball of radius 0.3 as sampled from a mesh."""
    around = even_directions(count)
    # flat discs of .65 spacings
    flat = surfels(
        0.3 * around,
        around,
        width=0.65 * 0.3 * math.sqrt(4 * math.pi / count),
        srgb=float(srgb_from_linear(torch.tensor(albedo))),
    )
    full = torch.full((count,), 1.0)
    return KnownSurface(
        **vars(flat),
        normals=around,
        metallic=metallic * full,
        roughness=roughness * full,
        emission=emission * torch.ones(count, 3),
    )


def ring(
    count: int = 12,
    *,
    height: float = 1.5,
    radius: float = 2.5,
    center: tuple[float, float, float] = (0.0, 0.0, 0.0),
    focal: float = 100.0,
    size: tuple[int, int] = (128, 96),
) -> Cameras:
    """Return cameras on a circle `height` above `center`, looking at it."""
    turn = torch.arange(count) / count * 2 * math.pi
    middle = torch.tensor(center)
    eyes = middle + torch.stack([radius * turn.cos(), radius * turn.sin(), torch.full((count,), height)], 1)
    return pinhole(look_at(eyes, middle, UP), focal, width=size[0], height=size[1])


def random_scene(n: int, degree: int, seed: int) -> Gaussians:
    """Return Gaussians of a tenth of a unit within a few units of the origin."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    return Gaussians(
        means=normal(n, 3),
        log_scales=normal(n, 3) * 0.6 - 2.5,
        quaternions=normal(n, 4),
        opacity_logits=normal(n) * 1.5 + 0.5,
        sh=normal(n, (degree + 1) ** 2, 3) * 0.4,
    )


def camera_inside(width: int = 37, height: int = 29) -> Cameras:
    """Return a camera in `random_scene`, some Gaussians behind it, in sizes that no tile divides."""
    pose = look_at(torch.tensor([[0.5, 0.3, -2.2]]), torch.zeros(3), torch.tensor([0.0, -1.0, 0.0]))
    return pinhole(pose, 40.0, width=width, height=height)


def sunlit_scene(sun: Tensor, strength: float) -> Gaussians:
    """Return balls on a floor of one material, lit by `sun` and an even sky; both of their shadows are exact."""
    return _lit_scene(sun.expand_as, strength)


def lamplit_scene(lamp: Tensor, strength: float) -> Gaussians:
    """Return the balls and the floor of `sunlit_scene` under a lamp at a position; `strength` is that at the origin."""

    def light_at(points: Tensor) -> Tensor:
        towards = lamp - points
        return float(lamp @ lamp) * towards / towards.norm(dim=1, keepdim=True) ** 3

    return _lit_scene(light_at, strength)


def _lit_scene(light_at: Callable[[Tensor], Tensor], strength: float) -> Gaussians:
    """Return the scene under a light with this vector irradiance at points, over that of the sky times `strength`."""
    generator = torch.Generator().manual_seed(1)
    centers = torch.tensor([[1.0, 0.2, 0.25], [-0.6, 0.9, 0.25], [-0.7, -0.8, 0.25], [0.5, -1.1, 0.25]])
    grid = (torch.rand(12000, 2, generator=generator) - 0.5) * 5
    points = [torch.cat([grid, torch.zeros(len(grid), 1)], 1)]
    normals = [UP.repeat(len(grid), 1)]
    for center in centers:
        around = even_directions(900)
        points.append(center + 0.25 * around)
        normals.append(around)
    point, normal = torch.cat(points), torch.cat(normals)
    light = light_at(point)
    towards = torch.nn.functional.normalize(light, dim=1)
    lit = (normal * light).sum(1).clamp_min(0)
    for center in centers:
        away = center - point - 1e-3 * normal
        along = (away * towards).sum(1)
        hit = (along > 0) & ((away**2).sum(1) - along**2 < 0.25**2)
        lit = torch.where(hit & ((point - center).norm(dim=1) > 0.26), 0, lit)
    # a ball takes its form factor of the floor's sky
    distance = (point[:, None] - centers).norm(dim=-1)
    sky = torch.where(point[:, 2] > 0, 1, 1 - (0.25**3 / distance**3).sum(1))
    gray = 0.15 * (sky + strength * lit)
    keep = (point[:, None, :2] - centers[:, :2]).norm(dim=-1).min(1).values > 0.05
    keep |= point[:, 2] > 0.01
    return surfels(point[keep], normal[keep], width=0.03, srgb=srgb_from_linear(gray)[keep, None].repeat(1, 3))


def clock_at(*directions: Tensor, error_deg: float = 5.0, height_error_deg: float = 5.0) -> ClockSun:
    """Return the sun by a clock with these candidates."""
    noon = datetime(2026, 6, 1, 12, tzinfo=UTC)
    candidates = [SunCandidate(noon, "GPS", 30.0, tuple(one.tolist())) for one in directions]
    return ClockSun(tuple(candidates), (0.0, 0.0, 1.0), error_deg, height_error_deg, "a compass", None)
