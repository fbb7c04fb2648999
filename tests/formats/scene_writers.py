"""Writes scenes in layouts that no published tool writes any more, from the published readers."""

import gzip
import io
import json
import struct
import zipfile
from pathlib import Path

import numpy as np
from PIL import Image

from splatgraft.core.gaussians import Gaussians

LARGEST_OTHERS = {0: [1, 2, 3], 1: [0, 2, 3], 2: [0, 1, 3], 3: [0, 1, 2]}


def picture(pixels: np.ndarray, width: int) -> bytes:
    """Rows of RGBA bytes as lossless WebP, `width` wide."""
    height = -(-len(pixels) // width)
    full = np.zeros((height * width, 4), np.uint8)
    full[:, 3] = 255
    full[: len(pixels)] = pixels
    stream = io.BytesIO()
    Image.fromarray(full.reshape(height, width, 4), "RGBA").save(stream, "WEBP", lossless=True, exact=True)
    return stream.getvalue()


def quantized(values: np.ndarray, low, high) -> np.ndarray:
    return np.clip(np.round((values - low) / (np.asarray(high) - low) * 255), 0, 255).astype(np.uint8)


def opaque(rgb: np.ndarray) -> np.ndarray:
    return np.concatenate([rgb, np.full((len(rgb), 1), 255, np.uint8)], 1)


def sog_v1(g: Gaussians) -> dict[str, bytes]:
    """The files of version 1: bytes between bounds; the palette has an entry per Gaussian."""
    n, width = g.count, 8
    means = g.means.numpy()
    logarithm = np.sign(means) * np.log1p(np.abs(means))
    low, high = logarithm.min(0), logarithm.max(0)
    fixed = np.round((logarithm - low) / (high - low) * 65535).astype(np.int64)
    scales = g.log_scales.numpy()
    color = np.concatenate([g.sh[:, 0].numpy(), g.opacity_logits.numpy()[:, None]], 1)
    unit = g.quaternions.numpy() / np.linalg.norm(g.quaternions.numpy(), axis=1, keepdims=True)
    quaternions = np.zeros((n, 4), np.uint8)
    for i, q in enumerate(unit):
        largest = int(np.abs(q).argmax())
        three = (q * np.sign(q[largest]))[LARGEST_OTHERS[largest]]
        quaternions[i] = [*np.round((three * 2**0.5 + 1) / 2 * 255), 252 + largest]
    bands = g.sh[:, 1:].numpy()
    k = bands.shape[1]
    rows = -(-n // 64)
    palette = np.zeros((rows * 64, k, 3), np.uint8)
    palette[:n] = quantized(bands, bands.min(), bands.max())
    labels = np.stack([np.arange(n) & 255, np.arange(n) >> 8, np.zeros(n), np.full(n, 255)], 1).astype(np.uint8)
    files = {
        "means_l.webp": picture(opaque((fixed & 255).astype(np.uint8)), width),
        "means_u.webp": picture(opaque((fixed >> 8).astype(np.uint8)), width),
        "quats.webp": picture(quaternions, width),
        "scales.webp": picture(opaque(quantized(scales, scales.min(0), scales.max(0))), width),
        "sh0.webp": picture(quantized(color, color.min(0), color.max(0)), width),
        "shN_centroids.webp": picture(opaque(palette.reshape(-1, 3)), 64 * k),
        "shN_labels.webp": picture(labels, width),
    }
    means_files = ["means_l.webp", "means_u.webp"]
    palette_files = ["shN_centroids.webp", "shN_labels.webp"]
    meta = {
        "means": {"shape": [n, 3], "mins": low.tolist(), "maxs": high.tolist(), "files": means_files},
        "scales": {"mins": scales.min(0).tolist(), "maxs": scales.max(0).tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"mins": color.min(0).tolist(), "maxs": color.max(0).tolist(), "files": ["sh0.webp"]},
        "shN": {"mins": float(bands.min()), "maxs": float(bands.max()), "files": palette_files},
    }  # fmt: skip
    return files | {"meta.json": json.dumps(meta).encode()}


def write_folder(folder: Path, files: dict[str, bytes]) -> Path:
    folder.mkdir(parents=True)
    for name, data in files.items():
        (folder / name).write_bytes(data)
    return folder


def write_zip(path: Path, files: dict[str, bytes], *, method: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return path


def spz_of_version_1(means: np.ndarray, *, extensions: bytes = b"", flags: int = 0) -> bytes:
    """Half floats, first three of the quaternion; everything else constant; degree 0."""
    n = len(means)
    body = struct.pack("<IIIBBBB", 0x5053474E, 1, n, 0, 0, flags, 0)
    body += means.astype("<f2").tobytes() + bytes([255]) * n + bytes([128]) * 3 * n + bytes([96]) * 3 * n
    body += bytes([128, 128, 128]) * n
    return gzip.compress(body + extensions)


def coordinate_system(number: int) -> bytes:
    """The extension record by which Adobe's writer states the axes, after one that nobody knows."""
    return struct.pack("<II3s", 0x12340001, 3, b"abc") + struct.pack("<III", 0xADBE0003, 4, number)


def glb(content: dict, binary: bytes) -> bytes:
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    binary += bytes(-len(binary) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks


def parts_of_glb(data: bytes) -> tuple[dict, bytes]:
    """JSON and binary chunk."""
    length = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + length]), data[28 + length :]
