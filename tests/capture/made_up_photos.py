"""Photos with known true poses, rendered by plain numpy: a textured box on a turntable before a still wall."""

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


def _box(pose: np.ndarray, textures: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return colours (h, w, 3) and the rays' intersections with the box from -0.7 to 0.7 (slab test)."""
    width, height = SIZE
    v, u = np.mgrid[0:height, 0:width] + 0.5
    rays = np.stack([(u - width / 2) / FOCAL, (v - height / 2) / FOCAL, np.ones_like(u)], -1) @ pose[:3, :3].T
    near, far = np.sort([(sign * 0.7 - pose[:3, 3]) / rays for sign in (-1, 1)], axis=0)
    hit = near.max(-1) < far.min(-1)
    spots = pose[:3, 3] + near.max(-1, keepdims=True) * rays
    color = np.zeros((height, width, 3), np.float32)
    for axis in range(3):
        for sign in (-1, 1):
            here = hit & (near.argmax(-1) == axis) & (np.sign(-rays[..., axis]) == sign)
            a, b = ((np.delete(spots, axis, -1) + 0.7) / 1.4 * 511).astype(np.float32).transpose(2, 0, 1)
            face = cv2.remap(textures[2 * axis + (sign > 0)], a, b, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
            color[here] = face[here]
    return color, hit
