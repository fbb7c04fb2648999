"""3DGS scenes as .ply, which stores the raw fields exactly.

Layout of the original code (Kerbl et al. 2023): x y z, nx ny nz (zeros), f_dc_0..2, f_rest (channel-major), opacity,
scale_0..2, rot_0..3 (wxyz), all float32. The reader accepts any order, extra properties, and no normals or f_rest.
Non-finite values are kept, so that reading and writing copies a file exactly; renderers cull them. Up direction and
size are comments, `up: X Y Z` and `metres_per_unit: M`.

A `KnownSurface` has its normals in nx ny nz, and after all others the properties metallic, roughness, emission_0..2.
"""

import re
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.core.gaussians import Gaussians, KnownSurface
from splatgraft.formats.scenes import ply
from splatgraft.formats.scenes.compressed_ply import is_compressed, read_compressed_ply
from splatgraft.formats.scenes.scene_file import SceneFile, SceneMetadata
from splatgraft.runtime.files import atomic_write

_MEANS = ("x", "y", "z")
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALES = ("scale_0", "scale_1", "scale_2")
_QUATERNION = ("rot_0", "rot_1", "rot_2", "rot_3")
_NORMALS = ("nx", "ny", "nz")
SURFACE = ("metallic", "roughness", "emission_0", "emission_1", "emission_2")
"""Properties of a known surface beside its normals."""
_REST_COUNTS = tuple(3 * (spherical_harmonics.coefficient_count(d) - 1) for d in range(4))
_ROWS_PER_WRITE = 1 << 14  # bounds the memory of a write
_KNOWN = re.compile(
    r"x|y|z|n[xyz]|f_dc_[0-2]|f_rest_[0-9]+|opacity|scale_[0-2]|rot_[0-3]|metallic|roughness|emission_[0-2]|red|green|blue|alpha"
)
"""Properties that are read, normals, which are zeros, and colours for viewers."""
_MAX_NAMED = 6  # properties that a note names


def read_gaussian_ply(path: Path) -> SceneFile:
    """Read a 3DGS .ply, or SuperSplat's compressed form of one; other number types become float32."""
    header = ply.read_header(path)
    vertex = header.required("vertex")
    if is_compressed(vertex):
        return SceneFile(read_compressed_ply(header), metadata=header.metadata)
    rest = _require_gaussians(vertex)
    n, bands = vertex.count, len(rest) // 3
    means, log_scales, quaternions = (np.empty((n, width), np.float32) for width in (3, 3, 4))
    logits, sh = np.empty(n, np.float32), np.empty((n, 1 + bands, 3), np.float32)
    columns = [
        *((name, means[:, i]) for i, name in enumerate(_MEANS)),
        *((name, log_scales[:, i]) for i, name in enumerate(_SCALES)),
        *((name, quaternions[:, i]) for i, name in enumerate(_QUATERNION)),
        ("opacity", logits),
        *((name, sh[:, 0, i]) for i, name in enumerate(_DC)),
        *((name, sh[:, 1 + i % bands, i // bands]) for i, name in enumerate(rest)),
    ]
    ply.read_into(header, vertex, columns)
    gaussians = Gaussians(*map(torch.from_numpy, (means, log_scales, quaternions, logits, sh)))
    if {*_NORMALS, *SURFACE} <= set(vertex.types):
        gaussians = _with_surface(gaussians, torch.from_numpy(ply.read_columns(header, vertex, (*_NORMALS, *SURFACE))))
    return SceneFile(gaussians, metadata=header.metadata, notes=_unused(vertex))


def _with_surface(g: Gaussians, columns: Float[Tensor, "n 8"]) -> KnownSurface:
    normals, material = torch.nn.functional.normalize(columns[:, :3], dim=1), columns[:, 3:5]
    if not bool((normals.norm(dim=1) > 0.5).all() and ((material >= 0) & (material <= 1)).all()):
        raise ValueError("expected normals with a length, and metallic and roughness in [0, 1], found others")
    emission = columns[:, 5:].contiguous()
    if not bool(((emission >= 0) & emission.isfinite()).all()):
        raise ValueError("expected a finite emission of 0 or more, found others")
    return KnownSurface(
        **vars(g), normals=normals, metallic=material[:, 0], roughness=material[:, 1], emission=emission
    )


def _require_gaussians(vertex: ply.Element) -> tuple[str, ...]:
    """Check the properties, and return the names f_rest_0 .. in the order of their numbers."""
    missing = [n for n in (*_MEANS, *_DC, "opacity", *_SCALES, *_QUATERNION) if n not in vertex.types]
    if missing and not {*_MEANS, "opacity", *_SCALES, *_QUATERNION} & set(vertex.types) - set(_MEANS):
        raise ValueError(
            "expected 3D Gaussians (opacity, scale_0.., rot_0.., f_dc_0..), "
            f"found a plain point cloud with {', '.join(vertex.types)[:80]}"
        )
    if missing:
        raise ValueError(f"expected the properties of 3D Gaussians, found none called {', '.join(missing)}")
    count = sum(bool(re.fullmatch(r"f_rest_[0-9]+", name)) for name in vertex.types)
    names = tuple(f"f_rest_{i}" for i in range(count))
    if count not in _REST_COUNTS or not set(names) <= set(vertex.types):
        raise ValueError(f"expected 0, 9, 24 or 45 properties f_rest_0 .. (SH degree 0 to 3), found {count}")
    return names


def _unused(vertex: ply.Element) -> tuple[str, ...]:
    unused = [name for name in vertex.types if not _KNOWN.fullmatch(name)]
    more = f" and {len(unused) - _MAX_NAMED} more" if len(unused) > _MAX_NAMED else ""
    return (f"not used: the properties {', '.join(unused[:_MAX_NAMED])}{more}",) if unused else ()


def write_gaussian_ply(path: Path, gaussians: Gaussians, metadata: SceneMetadata = SceneMetadata()) -> None:
    """Write the layout of the original code, byte for byte, atomically; metadata become comments."""
    n, k = gaussians.sh.shape[:2]
    rest = [f"f_rest_{i}" for i in range(3 * (k - 1))]
    surface = SURFACE if isinstance(gaussians, KnownSurface) else ()
    names = [*_MEANS, *_NORMALS, *_DC, *rest, "opacity", *_SCALES, *_QUATERNION, *surface]
    with atomic_write(path) as stream:
        ply.write_header(stream, ("vertex", n, [("float", name) for name in names]), metadata=metadata)
        for start in range(0, n, _ROWS_PER_WRITE):
            part = gaussians.map(lambda t, i=start: t[i : i + _ROWS_PER_WRITE].detach().cpu().float())
            columns = [
                part.means,
                part.normals if isinstance(part, KnownSurface) else torch.zeros_like(part.means),
                part.sh[:, 0],
                part.sh[:, 1:].transpose(1, 2).flatten(1),
                part.opacity_logits[:, None],
                part.log_scales,
                part.quaternions,
            ]
            if isinstance(part, KnownSurface):
                columns += [part.metallic[:, None], part.roughness[:, None], part.emission]
            stream.write(torch.cat(columns, 1).numpy().astype("<f4", copy=False).tobytes())
