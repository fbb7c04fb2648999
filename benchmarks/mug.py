"""Write a mug as .glb, for the gallery: `python benchmarks/mug.py mug.glb`. Its shape and its print are our own."""

import math
import sys
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

RADIUS, HEIGHT, WALL = 0.04, 0.095, 0.004  # metres
SIZE = 1024  # pixels of the print


def swept(rings: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Join closed rings of points (m, n + 1, 3), the last point of each being the first; v is each ring's row."""
    m, n = rings.shape[:2]
    i, j = (x.ravel() for x in np.meshgrid(np.arange(m - 1), np.arange(n - 1), indexing="ij"))
    a, b, c, d = i * n + j, i * n + j + 1, (i + 1) * n + j + 1, (i + 1) * n + j
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    uv = np.stack(np.broadcast_arrays(np.linspace(0, 1, n)[None], v[:, None]), 2).reshape(-1, 2)
    return rings.reshape(-1, 3), faces, uv


def body() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Turn the profile about y: foot, outer wall, rounded rim, inner wall, bottom."""
    rim = [
        (RADIUS - WALL / 2 * (1 - math.cos(a)), HEIGHT - WALL / 2 + WALL / 2 * math.sin(a))
        for a in np.linspace(0, math.pi, 9)
    ]
    profile = [
        (0, 0.003),
        (0.03, 0.003),
        (0.032, 0),
        (0.036, 0),
        (RADIUS, 0.006),
        *((RADIUS, y) for y in np.linspace(0.01, 0.09, 17)),
    ]
    profile += [*rim, (RADIUS - WALL, 0.01), (RADIUS - 2 * WALL, 0.006), (0, 0.006)]
    r, y = np.array(profile).T
    turn = np.linspace(0, 2 * math.pi, 97)
    rings = np.stack(
        [r[:, None] * np.sin(turn), np.broadcast_to(y[:, None], (len(r), 97)), r[:, None] * np.cos(turn)], 2
    )
    outside = np.arange(len(r)) < 5 + 17
    return swept(rings, np.where(outside, 1 - 0.8 * y / HEIGHT, 0.05))


def handle() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sweep an oval along half of an ellipse beside the body; its ends lie inside the wall."""
    along = np.linspace(-0.5 * math.pi, 0.5 * math.pi, 41)[:, None]
    middle = np.concatenate([RADIUS - 0.002 + 0.027 * np.cos(along), 0.05 + 0.028 * np.sin(along), 0 * along], 1)
    outwards = np.concatenate([np.cos(along), np.sin(along), 0 * along], 1)
    around = np.linspace(0, 2 * math.pi, 25)
    rings = middle[:, None] + 0.004 * np.cos(around)[:, None] * outwards[:, None]
    rings = rings + 0.006 * np.sin(around)[:, None] * np.array([0, 0, 1.0])
    return swept(rings, np.full(41, 0.05))


def print_() -> Image.Image:
    """Draw a cream glaze with a blue band of waves and dots; the plain glaze is at the top."""
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    pixels = np.ones((SIZE, SIZE, 3)) * (235, 226, 205)
    wave = 0.55 + 0.05 * np.sin(2 * math.pi * 8 * x)
    pixels[np.abs(y - wave) < 0.05] = (32, 70, 128)
    dots = ((x * 16) % 1 - 0.5) ** 2 + (((y - 0.4) * 16 / 1.6) % 1 - 0.5) ** 2 < 0.06
    pixels[dots & (np.abs(y - 0.38) < 0.04)] = (176, 62, 40)
    pixels[y > 0.93] = (32, 70, 128)
    return Image.fromarray(pixels.astype(np.uint8))


def main(path: Path) -> None:
    vertices, faces, uv, count = [], [], [], 0
    for points, triangles, places in (body(), handle()):
        vertices, faces, uv = [*vertices, points], [*faces, triangles + count], [*uv, places]
        count += len(points)
    material = PBRMaterial(baseColorTexture=print_(), metallicFactor=0.0, roughnessFactor=0.3)
    # trimesh counts v from below
    visual = TextureVisuals(uv=np.concatenate(uv) * (1, -1) + (0, 1), material=material)
    mesh = trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), visual=visual, process=False)
    path.write_bytes(trimesh.exchange.gltf.export_glb(mesh))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
