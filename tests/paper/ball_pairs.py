"""Rendered pairs without Blender: a grey ball on a plane under a sun and uniform light, in closed form."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import torch

from splatgraft.core.cameras import look_at
from splatgraft.core.images import srgb_from_linear, write_image

RADIUS, CENTER = 0.3, torch.tensor([0.0, 0.0, 0.3])
GROUND, BODY = torch.tensor([0.35, 0.3, 0.25]), torch.tensor([0.3, 0.4, 0.5])
WIDTH, HEIGHT, FIELD = 96, 64, 0.8


def sun(azimuth, height=0.8):
    direction = [math.cos(height) * math.cos(azimuth), math.cos(height) * math.sin(azimuth), math.sin(height)]
    return {"direction": direction, "irradiance": [2.2, 2.0, 1.7], "angular_radius": 0.0047}


def shaded(points, normals, albedo, light, *, ball):
    """Return linear radiance: albedo / pi times irradiance; the ball blocks the sun and part of the uniform light."""
    towards = torch.tensor(light["direction"])
    cosine = (normals @ towards).clamp_min(0)
    away = CENTER - points
    along = away @ towards
    aside = (away - along[..., None] * towards).norm(dim=-1)
    blocked = (along > 1e-3) & (aside < RADIUS) & torch.tensor(ball)
    distance = away.norm(dim=-1)
    hidden = (away / distance[..., None] * normals).sum(-1).clamp_min(0) * (RADIUS / distance).clamp_max(1) ** 2
    even = math.pi * 0.3 * (1 - hidden * (distance > 1.01 * RADIUS) * torch.tensor(float(ball)))
    irradiance = even[..., None] + torch.tensor(light["irradiance"]) * (cosine * ~blocked)[..., None]
    return albedo / math.pi * irradiance


def write_ball_pairs(folder: Path, *, seed: int = 0, pattern: str = "plain", cameras: int = 2) -> None:
    """Write one scene with one object and two lights, like the render worker."""
    turns = [0.6 * i + seed for i in range(cameras)]
    eyes = torch.tensor([[2 * math.cos(t), 2 * math.sin(t), 1.1] for t in turns])
    poses = look_at(eyes, torch.tensor([0.0, 0, 0.2]), torch.tensor([0.0, 0, 1]))
    now, others = sun(1.0 + seed), [sun(3.0 + seed), sun(5.0 + seed, 0.5)]
    for name in ("background", "object0", "object0_light0", "object0_light1"):
        (folder / name).mkdir(parents=True)
    for i, pose in enumerate(poses):
        for name, picture in _pictures(pose, now, others).items():
            take, _, kind = name.partition(" ")
            path = folder / take / f"{i:04d}{'_' + kind if kind else ''}"
            if kind == "depth":
                np.save(path, picture.numpy().astype(np.float16))
            elif picture.shape[-1] == 4:
                levels = (255 * picture.clamp(0, 1)).round().numpy().astype(np.uint8)
                cv2.imwrite(str(path.with_suffix(".png")), cv2.cvtColor(levels, cv2.COLOR_RGBA2BGRA))
            else:
                write_image(path.with_suffix(".png"), picture)
    opengl = poses.clone()
    opengl[:, :3, 1:3] *= -1
    described = {"width": WIDTH, "height": HEIGHT, "field_of_view": [FIELD] * cameras, "poses": opengl.tolist()}
    (folder / "cameras.json").write_text(json.dumps(described))
    _write_lights(folder, {"place": now, "object0_light0": others[0], "object0_light1": others[1]})
    _write_surfaces(folder)
    takes = [{"name": "background"}, {"name": "object0"}]
    takes += [{"name": f"object0_light{i}", "world": {"path": f"map{i}.exr"}} for i in range(2)]
    job = {"takes": takes, "cameras": [{}] * cameras, "objects": {"object0": [{"material": {"pattern": pattern}}]}}
    (folder / "job.json").write_text(json.dumps(job))


def _pictures(pose, now, others):
    focal = 0.5 * WIDTH / math.tan(0.5 * FIELD)
    v, u = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    local = torch.stack([(u - WIDTH / 2) / focal, (v - HEIGHT / 2) / focal, torch.ones_like(u)], -1)
    rays, eye = local @ pose[:3, :3].T, pose[:3, 3]
    to_ground = -eye[2] / rays[..., 2]
    ground_there = to_ground > 0
    offset = eye - CENTER
    a, b, c = (rays**2).sum(-1), 2 * (rays @ offset), offset @ offset - RADIUS**2
    inside = b**2 - 4 * a * c > 0
    to_ball = (-b - (b**2 - 4 * a * c).clamp_min(0).sqrt()) / (2 * a)
    up = torch.tensor([0.0, 0, 1]).expand(HEIGHT, WIDTH, 3)
    ground = eye + to_ground.where(ground_there, 1.0)[..., None] * rays
    body = eye + to_ball[..., None] * rays
    facing = (body - CENTER) / RADIUS
    sky = torch.tensor([0.3, 0.3, 0.3])

    def on_ground(ball):
        return torch.where(ground_there[..., None], shaded(ground, up, GROUND, now, ball=ball), sky)

    def object_alone(light):
        picture = srgb_from_linear(shaded(body, facing, BODY, light, ball=False))
        return torch.cat([picture, inside[..., None].float()], -1)

    on = inside[..., None]
    target = torch.where(on, shaded(body, facing, BODY, now, ball=False), on_ground(True))
    depth = torch.where(inside, to_ball, torch.where(ground_there, to_ground, 0.0))
    return {
        "background": srgb_from_linear(on_ground(False)),
        "object0": srgb_from_linear(target),
        "object0 mask": inside.float(),
        "object0 depth": depth,
        "object0 normal": torch.where(on, facing, up) * 0.5 + 0.5,
        "object0 albedo": srgb_from_linear(torch.where(on, BODY, GROUND)),
        "object0_light0": object_alone(others[0]),
        "object0_light1": object_alone(others[1]),
    }


def _write_lights(folder, lights):
    for name, light in lights.items():
        take = folder / f"{name}_probe"
        take.mkdir()
        np.save(take / "0000.npy", np.full((64, 128, 3), 0.3, np.float32))
        (take / "suns.json").write_text(json.dumps([light]))


def _write_surfaces(folder):
    generator = torch.Generator().manual_seed(0)
    around = torch.nn.functional.normalize(torch.randn(4000, 3, generator=generator), dim=1)
    flat = 6 * torch.rand(20_000, 2, generator=generator) - 3
    ground = torch.cat([flat, torch.zeros(20_000, 1), torch.tensor([[0.0, 0, 1]]).repeat(20_000, 1)], 1)
    for name, points in (("object0", torch.cat([CENTER + RADIUS * around, around], 1)), ("scene", ground)):
        take = folder / f"{name}_surface"
        take.mkdir()
        np.save(take / "0000.npy", points.numpy())
