"""Photos with known true poses, rendered by plain numpy: a textured box before a still wall, or in a textured room."""

from pathlib import Path

import cv2
import numpy as np
from PIL import Image

SIZE, FOCAL = (400, 300), 500.0


def turntable(folder: Path, count: int, step_deg: float, *, wall: bool = True) -> np.ndarray:
    """Write `count` photos to `folder`/images and masks of the box to `folder`/masks.

    Returns:
        World from camera (count, 4, 4), OpenCV axes, in the frame of the box.
    """
    (folder / "images").mkdir(parents=True)
    (folder / "masks").mkdir()
    generator = np.random.default_rng(0)
    textures = [texture(generator, 512) for _ in range(6)]
    behind = np.kron(texture(generator, 400), np.ones((1, 2, 1), np.float32))[:300, :400]
    poses = np.stack([_pose(np.deg2rad(i * step_deg)) for i in range(count)])
    for i, pose in enumerate(poses):
        color, hit = _box(pose, textures)
        color[~hit] = np.resize(behind, color.shape)[~hit] if wall else 0.5
        Image.fromarray((color * 255).round().astype(np.uint8)).save(folder / "images" / f"{i:02d}.png")
        Image.fromarray(hit).save(folder / "masks" / f"{i:02d}.png")
    return poses


def turned_between_series(
    folder: Path,
    counts: tuple[int, int],
    step_deg: float,
    turned_deg: float,
    *,
    moved: tuple[float, float, float] = (0, 0, 0),
    half: float = 0.7,
) -> np.ndarray:
    """Write two series of photos of a box in a room, and masks of the box, which is turned and moved in between.

    Returns:
        World from camera (count, 4, 4), OpenCV axes, in the frame of the box.
    """
    (folder / "images").mkdir(parents=True)
    (folder / "masks").mkdir()
    generator = np.random.default_rng(0)
    textures, walls = ([texture(generator, 512) for _ in range(6)] for _ in range(2))
    poses = np.stack([_pose(np.deg2rad(i * step_deg)) for i in range(sum(counts))])
    for i, pose in enumerate(poses):
        color, hit = _box(pose, textures, half=half)
        in_room = _about_z(np.deg2rad(turned_deg if i >= counts[0] else 0)) @ pose
        in_room[:3, 3] += moved if i >= counts[0] else (0, 0, 0)
        color[~hit] = _box(in_room, walls, half=6.0, inside=True)[0][~hit]
        Image.fromarray((color * 255).round().astype(np.uint8)).save(folder / "images" / f"{i:02d}.png")
        Image.fromarray(hit).save(folder / "masks" / f"{i:02d}.png")
    return poses


def panoramas(folder: Path, count: int, width: int, *, is_video: bool = False) -> np.ndarray:
    """Write `count` panoramas from a path through a textured room, each turned otherwise, with a person below.

    Those of a video turn slowly, and the camera stays at one height.

    The person is a disc of one texture below 50 degrees under the horizon, which moves and turns with the camera.

    Returns:
        World from panorama (count, 4, 4), +z in the middle of the picture and +y down, in a world with z up.
    """
    folder.mkdir(parents=True)
    generator = np.random.default_rng(0)
    walls, person = [texture(generator, 1024) for _ in range(6)], texture(generator, 512)
    v, u = np.mgrid[0 : width // 2, 0:width] + 0.5
    yaw, pitch = 2 * np.pi * (u / width - 0.5), np.pi * (0.5 - 2 * v / width)
    rays = np.stack([np.cos(pitch) * np.sin(yaw), -np.sin(pitch), np.cos(pitch) * np.cos(yaw)], -1)
    poses = []
    for i in range(count):
        turn = 2 * np.pi * i / count if is_video else 1.3 * i
        pose = _about_z(turn)
        pose[:3, :3] = pose[:3, :3] @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
        pose[:3, 3] = 1.5 * np.cos(2 * np.pi * i / count), 1.2 * np.sin(2 * np.pi * i / count), 0.2 * np.sin(5 * i)
        if is_video:
            pose[2, 3] = 0.2 * np.sin(6 * np.pi * i / count)
        color, _ = _box(pose, walls, half=3.0, inside=True, rays=rays)
        below = pitch < np.deg2rad(-50)
        a, b = (100 * (1 + rays[below][:, [0, 2]] / rays[below][:, 1:2])).astype(int).T
        color[below] = person[b, a]
        Image.fromarray((color * 255).round().astype(np.uint8)).save(folder / f"{i:02d}.jpg", quality=95)
        poses.append(pose)
    return np.stack(poses)


def texture(generator: np.random.Generator, side: int) -> np.ndarray:
    layers = [generator.random((8 * 2**i, 8 * 2**i, 3)).astype(np.float32) for i in range(4)]
    return sum(cv2.resize(layer, (side, side)) / 4 for layer in layers)


def similarity_to(truth: np.ndarray, found: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the rotation of the best similarity (Umeyama 1991), and the largest distance of the points after it."""
    x, y = found - found.mean(0), truth - truth.mean(0)
    u, s, vt = np.linalg.svd(y.T @ x)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = (s * np.diag(sign)).sum() / (x**2).sum()
    rotation = u @ sign @ vt
    return rotation, float(np.linalg.norm(y - scale * x @ rotation.T, axis=1).max())


def _pose(angle: float) -> np.ndarray:
    eye = np.array([4 * np.cos(angle), 4 * np.sin(angle), 2.0])
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    pose[:3, 3] = eye
    return pose


def _about_z(angle: float) -> np.ndarray:
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return turn


def _box(
    pose: np.ndarray,
    textures: list[np.ndarray],
    *,
    half: float = 0.7,
    inside: bool = False,
    rays: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return colours (h, w, 3) and the rays' intersections with the box from -half to half (slab test).

    `rays` are in the camera's axes; a pinhole's by default.
    """
    if rays is None:
        v, u = np.mgrid[0 : SIZE[1], 0 : SIZE[0]] + 0.5
        rays = np.stack([(u - SIZE[0] / 2) / FOCAL, (v - SIZE[1] / 2) / FOCAL, np.ones_like(u)], -1)
    height, width, _ = rays.shape
    rays = rays @ pose[:3, :3].T
    near, far = np.sort([(sign * half - pose[:3, 3]) / rays for sign in (-1, 1)], axis=0)
    hit = near.max(-1) < far.min(-1)
    depth, through = (far.min(-1), far.argmin(-1)) if inside else (near.max(-1), near.argmax(-1))
    spots = pose[:3, 3] + depth[..., None] * rays
    color = np.zeros((height, width, 3), np.float32)
    for axis in range(3):
        for sign in (-1, 1):
            here = hit & (through == axis) & (np.sign(-rays[..., axis]) == sign)
            a, b = ((np.delete(spots, axis, -1) + half) / (2 * half) * 511).astype(np.float32).transpose(2, 0, 1)
            face = cv2.remap(textures[2 * axis + (sign > 0)], a, b, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
            color[here] = face[here]
    return color, hit
