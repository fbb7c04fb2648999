"""Reads and writes 3DGS scenes as .ply; the raw fields are stored exactly.

Layout of the original code (Kerbl et al. 2023): x y z, nx ny nz (zeros), f_dc_0..2, f_rest (channel-major), opacity,
scale_0..2, rot_0..3 (wxyz), all float32. Read in any order, with extra properties or without normals and f_rest.
Values that are not finite are kept, so that reading and writing copies a file exactly; renderers cull them.
Variants: red, green, blue in place of f_dc (nerfstudio), filter_3D (Mip-Splatting), two scales (2DGS), degree 4, files
of inverse-rendering programs (`ply_peers.py`). What is not used is said in the notes.
"""

import re
from pathlib import Path

import numpy as np
import torch

from splatgraft.core import spherical_harmonics
from splatgraft.core.gaussians import Gaussians
from splatgraft.formats.scenes import ply
from splatgraft.formats.scenes.compressed_ply import is_compressed, read_compressed_ply
from splatgraft.formats.scenes.ply_peers import REFLECTION, is_gaussian_shader, left_out_notes, shader_sh
from splatgraft.formats.scenes.ply_variants import (
    comments_of,
    disks_thickened,
    header_metres,
    header_notes,
    header_up,
    smoothed,
    with_colors,
    without_degree_4,
)
from splatgraft.formats.scenes.scene_file import SceneFile
from splatgraft.formats.scenes.scene_metadata import SceneMetadata
from splatgraft.runtime.atomic_file import atomic_write

_MEANS = ("x", "y", "z")
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_RGB = ("red", "green", "blue")
_SCALES = ("scale_0", "scale_1", "scale_2")
_QUATERNION = ("rot_0", "rot_1", "rot_2", "rot_3")
_FILTER = "filter_3D"
_ROWS_PER_WRITE = 1 << 14
_REST_COUNTS = tuple(3 * (spherical_harmonics.coefficient_count(d) - 1) for d in range(5))
_SHADER_REST_COUNTS = (0, *(3 * spherical_harmonics.coefficient_count(d) for d in range(1, 5)))
"""Of GaussianShader, whose f_rest has a band 0 of its own."""


def read_gaussian_ply(path: Path) -> SceneFile:
    """The scene in a 3DGS .ply, or SuperSplat's compressed form of one; other number types become float32.

    Raises: ValueError where the file is no whole PLY with the properties of Gaussians.
    """
    header = ply.read_header(path)
    vertex = header.element("vertex")
    if vertex is None:
        raise ValueError(f"{path}: expected an element 'vertex', found {[e.name for e in header.elements]}")
    up, notes, metres = header_up(header), header_notes(header), header_metres(header)
    if is_compressed(header):
        return SceneFile(read_compressed_ply(header), up=up, notes=notes, metres_per_unit=metres)
    shader = is_gaussian_shader(vertex)
    rest = _rest_names(path, vertex, _SHADER_REST_COUNTS if shader else _REST_COUNTS)
    has_rgb = not set(_DC) & set(vertex.names) and set(_RGB) <= set(vertex.names)
    scales = _SCALES if _SCALES[2] in vertex.names or not set(_SCALES[:2]) <= set(vertex.names) else _SCALES[:2]
    _require_gaussians(path, vertex, _RGB if has_rgb else _DC, scales)
    n, k = vertex.count, 1 + len(rest) // 3
    means, log_scales = np.empty((n, 3), np.float32), np.full((n, 3), -np.inf, np.float32)
    quaternions, logits = np.empty((n, 4), np.float32), np.empty((n, 1), np.float32)
    sh, filters = np.empty((n, k, 3), np.float32), np.empty(n if _FILTER in vertex.names else 0, np.float32)
    reflection = np.empty(n, np.float32) if REFLECTION in vertex.names else None
    columns = [
        *((name, means[:, i]) for i, name in enumerate(_MEANS)),
        *((name, log_scales[:, i]) for i, name in enumerate(scales)),
        *((name, quaternions[:, i]) for i, name in enumerate(_QUATERNION)),
        ("opacity", logits[:, 0]),
        *((name, sh[:, 0, i]) for i, name in enumerate(_RGB if has_rgb else _DC)),
        *(
            (name, sh[:, 1 + i // 3, i % 3] if shader else sh[:, 1 + i % (k - 1), i // (k - 1)])
            for i, name in enumerate(rest)
        ),
        *([(_FILTER, filters)] if len(filters) else []),
        *([] if reflection is None else [(REFLECTION, reflection)]),
    ]
    with np.errstate(over="ignore"):  # a double beyond float32 becomes infinite, and is culled as such
        for start, rows in ply.read_chunks(header, vertex):
            for name, column in columns:
                column[start : start + len(rows)] = rows[name]
    gaussians = Gaussians(
        means=torch.from_numpy(means),
        log_scales=torch.from_numpy(log_scales),
        quaternions=torch.from_numpy(quaternions),
        opacity_logits=torch.from_numpy(logits[:, 0]),
        sh=shader_sh(torch.from_numpy(sh[:, 0]), torch.from_numpy(sh[:, 1:])) if shader else torch.from_numpy(sh),
    )
    notes = (*notes, *left_out_notes(vertex, None if reflection is None else torch.from_numpy(reflection)))
    scene = SceneFile(gaussians, up=up, notes=notes, metres_per_unit=metres)
    if has_rgb:
        scene = with_colors(scene, _range_of(vertex))
    if len(scales) == 2:
        scene = disks_thickened(scene)
    if len(filters):
        scene = smoothed(scene, torch.from_numpy(filters))
    return without_degree_4(scene)


def _range_of(vertex: ply.Element) -> float:
    """The value of full red: 255 for bytes, 1 for floats."""
    kind = next(p.type for p in vertex.properties if p.name == _RGB[0])
    return 1.0 if kind.startswith("f") else 255.0


def _rest_names(path: Path, vertex: ply.Element, counts: tuple[int, ...]) -> tuple[str, ...]:
    """f_rest_0 .. in the order of their numbers, whatever their order in the row."""
    count = sum(bool(re.fullmatch(r"f_rest_[0-9]+", name)) for name in vertex.names)
    names = tuple(f"f_rest_{i}" for i in range(count))
    missing = [name for name in names if name not in vertex.names]
    if count not in counts or missing:
        detail = f"{count}, without {missing[0]}" if missing else str(count)
        wanted = f"{', '.join(map(str, counts[:-1]))} or {counts[-1]}"
        raise ValueError(f"{path}: expected {wanted} properties f_rest_0 .. (SH degree 0 to 4), found {detail}")
    return names


def _require_gaussians(path: Path, vertex: ply.Element, colors: tuple[str, ...], scales: tuple[str, ...]) -> None:
    needed = (*_MEANS, *colors, "opacity", *scales, *_QUATERNION)
    missing = [name for name in needed if name not in vertex.names]
    if not missing:
        return
    if set(_MEANS) <= set(vertex.names) and not {"opacity", *_SCALES, *_QUATERNION} & set(vertex.names):
        raise ValueError(
            f"{path}: expected 3D Gaussians (opacity, scale_0.., rot_0.., f_dc_0..), "
            f"found a plain point cloud with {', '.join(vertex.names)[:80]}"
        )
    raise ValueError(f"{path}: expected the properties of 3D Gaussians, found none called {', '.join(missing)}")


def write_gaussian_ply(path: Path, gaussians: Gaussians, metadata: SceneMetadata = SceneMetadata()) -> None:
    """Write the layout of the original code, byte for byte, atomically; what is known of the frame in comments."""
    n, k = gaussians.sh.shape[:2]
    rest = [f"f_rest_{i}" for i in range(3 * (k - 1))]
    names = [*_MEANS, "nx", "ny", "nz", *_DC, *rest, "opacity", *_SCALES, *_QUATERNION]
    with atomic_write(path) as stream:
        ply.write_header(stream, ("vertex", n, [("float", name) for name in names]), comments=comments_of(metadata))
        for start in range(0, n, _ROWS_PER_WRITE):
            part = gaussians.map(lambda t, i=start: t[i : i + _ROWS_PER_WRITE].detach().cpu().float())
            columns = [
                part.means,
                torch.zeros_like(part.means),
                part.sh[:, 0],
                part.sh[:, 1:].transpose(1, 2).flatten(1),
                part.opacity_logits[:, None],
                part.log_scales,
                part.quaternions,
            ]
            stream.write(torch.cat(columns, 1).numpy().astype("<f4", copy=False).tobytes())
