"""Scenes and captures for the tests of the formats."""

import json
import struct
import zipfile
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from splatgraft.core.gaussians import Gaussians

GOLDEN = Path(__file__).parent / "golden"
TOOLS = GOLDEN / "tools"


def random_gaussians(n: int = 40, degree: int = 3, seed: int = 0) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.randn(n, 3, generator=g),
        log_scales=torch.randn(n, 3, generator=g) * 0.5 - 3,
        quaternions=torch.randn(n, 4, generator=g),
        opacity_logits=torch.randn(n, generator=g) * 2,
        sh=torch.randn(n, (degree + 1) ** 2, 3, generator=g) * 0.2,
    )


def equal(a: Gaussians, b: Gaussians) -> bool:
    """Check equality bit for bit, nan included."""
    return all(
        getattr(a, name).numpy().tobytes() == getattr(b, name).numpy().tobytes()
        and getattr(a, name).shape == getattr(b, name).shape
        for name in ("means", "log_scales", "quaternions", "opacity_logits", "sh")
    )


def rotation_and_quaternion(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a rotation by Rodrigues' formula and its quaternion wxyz, independent of the package."""
    rng = np.random.default_rng(seed)
    axis, angle = rng.normal(size=3), rng.uniform(0.3, 2.8)
    axis /= np.linalg.norm(axis)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    rotation = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return rotation, np.array([np.cos(angle / 2), *(np.sin(angle / 2) * axis)])


def write_photo(path: Path, width: int = 24, height: int = 16, *, seed: int = 0) -> np.ndarray:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(path)
    return pixels


COLMAP_IDS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4, "OPENCV_FISHEYE": 5}


def write_colmap(
    folder: Path,
    *,
    names: tuple[str, ...] = ("b.png", "a.png"),
    camera: tuple[str, int, int, tuple[float, ...]] = ("PINHOLE", 24, 16, (20.0, 21.0, 12.0, 8.0)),
    text: bool = False,
    points: int = 3,
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Write a model with one camera and the poses camera_from_world in the order of `names`."""
    folder.mkdir(parents=True, exist_ok=True)
    model, width, height, parameters = camera
    poses, lines, records = [], [], []
    for i, name in enumerate(names):
        rotation, quaternion = rotation_and_quaternion(i)
        translation = np.array([0.1 * i, -0.2, 3.0 + i])
        poses.append((rotation, translation))
        numbers = [*quaternion, *translation]
        observations = "1.5 2.5 -1" if i % 2 else ""
        lines.append(f"{i + 1} {' '.join(map(repr, map(float, numbers)))} 7 {name}\n{observations}\n")
        seen = [(1.5, 2.5, -1)] if i % 2 else []
        record = struct.pack("<I7dI", i + 1, *numbers, 7) + name.encode() + b"\0" + struct.pack("<Q", len(seen))
        records.append(record + b"".join(struct.pack("<ddq", *observation) for observation in seen))
    cloud = [(i + 1, (0.5 * i, 1.0, -2.0), (10 * i % 256, 20, 255)) for i in range(points)]
    if text:
        head = "# comment\n"
        numbers = " ".join(map(repr, parameters))
        (folder / "cameras.txt").write_text(f"{head}7 {model} {width} {height} {numbers}\n")
        (folder / "images.txt").write_text(head + "".join(lines))
        rows = [f"{i} {x} {y} {z} {r} {g} {b} 0.5 1 0 2 0\n" for i, (x, y, z), (r, g, b) in cloud]
        (folder / "points3D.txt").write_text(head + "".join(rows))
    else:
        packed = struct.pack("<IiQQ", 7, COLMAP_IDS[model], width, height) + np.array(parameters, "<f8").tobytes()
        (folder / "cameras.bin").write_bytes(struct.pack("<Q", 1) + packed)
        (folder / "images.bin").write_bytes(struct.pack("<Q", len(records)) + b"".join(records))
        rows = [struct.pack("<Q3d3BdQ4I", i, *xyz, *rgb, 0.5, 2, 1, 0, 2, 0) for i, xyz, rgb in cloud]
        (folder / "points3D.bin").write_bytes(struct.pack("<Q", len(rows)) + b"".join(rows))
    return poses


def write_transforms(folder: Path, content: dict, *, frames: int = 2, size: tuple[int, int] = (24, 16)) -> Path:
    """Write a transforms.json of `frames` existing photographs; `content` overrides or adds keys."""
    listed = []
    for i in range(frames):
        write_photo(folder / "images" / f"{i:04d}.png", *size, seed=i)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation_and_quaternion(i)[0], (i, 1, 2)
        listed.append({"file_path": f"images/{i:04d}.png", "transform_matrix": pose.tolist()})
    path = folder / "transforms.json"
    path.write_text(json.dumps({"fl_x": 20.0, "frames": listed, **content}))
    return path


def glb(content: dict, binary: bytes) -> bytes:
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    binary += bytes(-len(binary) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks


def parts_of_glb(data: bytes) -> tuple[dict, bytes]:
    """Return JSON and binary chunk."""
    length = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def write_zip(path: Path, files: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return path


def files_of_zip(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}
