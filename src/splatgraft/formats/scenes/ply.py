"""The PLY container (header, elements, properties; binary of both byte orders and ascii), and point clouds in it.

Element counts are checked against the size of the file before memory is allocated.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core import spherical_harmonics
from splatgraft.formats.parsing import parsing
from splatgraft.formats.scenes.scene_file import SceneMetadata, stated_metadata
from splatgraft.runtime.files import atomic_write

_MAX_HEADER_BYTES = 1 << 20
_ROWS_AT_ONCE = 1 << 12
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"},
}
_FORMATS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_POSITION = ("x", "y", "z")
_COLOR_NAMES = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_NUMBER = r"([+-]?[0-9]{1,12}(?:\.[0-9]{1,12})?(?:e[+-]?[0-9]{1,2})?)"
_UP = re.compile(rf"up: {_NUMBER} {_NUMBER} {_NUMBER}")
_METRES = re.compile(rf"metres_per_unit: {_NUMBER}")


@dataclass(frozen=True)
class Element:
    """A table of a PLY file."""

    name: str
    count: int
    """Number of rows."""
    types: Mapping[str, str]
    """numpy's type codes without byte order, such as f4, by property in the file's order."""
    has_lists: bool = False
    """Whether a property is a list; such an element is not read."""


@dataclass(frozen=True)
class PlyHeader:
    """The header of a PLY file."""

    path: Path
    order: str
    """Byte order, < or >; empty for ascii."""
    elements: tuple[Element, ...]
    data_start: int
    """Offset of the first byte after the header."""
    metadata: SceneMetadata
    """Up direction and size, from comments that splatgraft writes."""

    def element(self, name: str) -> Element | None:
        """Find the element called `name`."""
        return next((e for e in self.elements if e.name == name), None)

    def required(self, name: str) -> Element:
        """Return the element called `name`, or raise ValueError."""
        found = self.element(name)
        if found is None:
            raise ValueError(f"expected an element '{name}', found {[e.name for e in self.elements]}")
        return found


def read_header(path: Path) -> PlyHeader:
    """Read the header, and check its counts against the length of the file."""
    with path.open("rb") as stream:
        head = stream.read(_MAX_HEADER_BYTES)
    found = re.match(rb"ply[ \t]*\r?\n(.*?\n)end_header[ \t]*\r?\n", head, re.DOTALL)
    if found is None:
        raise ValueError(f"expected a PLY header from 'ply' to 'end_header', found {head[:8]!r} and so on")
    lines = found[1].decode("utf-8", "replace").splitlines()
    order, elements = _parse(lines)
    comments = [line[8:].strip() for line in lines if line.startswith("comment ")]
    header = PlyHeader(path, order, elements, found.end(), _metadata(comments))
    _check_size(header)
    return header


def _metadata(comments: list[str]) -> SceneMetadata:
    up = metres = None
    for comment in comments:
        if found := _UP.fullmatch(comment):
            up = [float(number) for number in found.groups()]
        elif found := _METRES.fullmatch(comment):
            metres = float(found[1])
    return stated_metadata(up, metres)


def _parse(lines: list[str]) -> tuple[str, tuple[Element, ...]]:
    order: str | None = None
    elements: list[Element] = []
    for line in lines:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", name, "1.0"] if name in _FORMATS and order is None:
                order = _FORMATS[name]
            case ["element", name, count] if re.fullmatch(r"[0-9]{1,15}", count):
                elements.append(Element(name, int(count), {}))
            case ["property", kind, name] if kind in _TYPES and elements and name not in elements[-1].types:
                elements[-1] = replace(elements[-1], types={**elements[-1].types, name: _TYPES[kind]})
            case ["property", "list", length, _, name] if length in _TYPES and elements:
                types = {**elements[-1].types, name: _TYPES[length]}
                elements[-1] = replace(elements[-1], types=types, has_lists=True)
            case _:
                raise ValueError(f"expected a PLY header line, found {line[:60]!r}")
    if order is None:
        raise ValueError("expected a 'format' line in the PLY header, found none")
    return order, tuple(elements)


def _check_size(header: PlyHeader) -> None:
    """Check the counts; a list takes at least its length field, an ascii value a digit and a separator."""
    available, ascii_ = header.path.stat().st_size - header.data_start, header.order == ""
    needed = sum(
        e.count * sum(2 if ascii_ else np.dtype(kind).itemsize for kind in e.types.values()) for e in header.elements
    )
    open_ended = ascii_ or any(e.has_lists for e in header.elements)
    # the last line may lack its line end
    if available + ascii_ < needed or (available > needed and not open_ended):
        counts = ", ".join(f"{e.count} {e.name}" for e in header.elements)
        bound = "at least " if open_ended else ""
        raise ValueError(f"expected {bound}{needed} bytes of data after the header ({counts}), found {available}")


def read_into(header: PlyHeader, element: Element, columns: Sequence[tuple[str, np.ndarray]]) -> None:
    """Fill one array per named property, a few rows at a time, which needs little memory besides the arrays."""
    before = header.elements[: header.elements.index(element)]
    if lists := [e.name for e in (*before, element) if e.has_lists]:
        raise ValueError(f"expected single values before and in '{element.name}', found lists {lists}")
    rows = (_ascii_rows if header.order == "" else _binary_rows)(header, element, before)
    with np.errstate(over="ignore"):  # a double beyond float32 becomes infinite, and is culled
        for start in range(0, element.count, _ROWS_AT_ONCE):
            part = rows[start : start + _ROWS_AT_ONCE]
            for name, column in columns:
                column[start : start + len(part)] = part[name]


def read_columns(header: PlyHeader, element: Element, names: tuple[str, ...]) -> np.ndarray:
    """Read the properties `names` as float32, (count, len(names))."""
    out = np.empty((element.count, len(names)), np.float32)
    read_into(header, element, [(name, out[:, i]) for i, name in enumerate(names)])
    return out


def _binary_rows(header: PlyHeader, element: Element, before: Sequence[Element]) -> np.ndarray:
    def row(e: Element) -> np.dtype:
        return np.dtype([(name, header.order + kind) for name, kind in e.types.items()])

    start = header.data_start + sum(e.count * row(e).itemsize for e in before)
    if not element.count or not element.types:
        return np.empty(0, row(element))
    return np.memmap(header.path, row(element), "r", start, (element.count,))


def _ascii_rows(header: PlyHeader, element: Element, before: Sequence[Element]) -> np.ndarray:
    lines = header.path.read_bytes()[header.data_start :].splitlines()
    start, width = sum(e.count for e in before), len(element.types)
    words = b" ".join(lines[start : start + element.count]).split()
    values = np.array(words, np.float64).reshape(element.count, width)
    return np.ascontiguousarray(values).view([(name, "f8") for name in element.types])[:, 0]


def write_header(
    stream: BinaryIO,
    *elements: tuple[str, int, Sequence[tuple[str, str]]],
    metadata: SceneMetadata = SceneMetadata(),
) -> None:
    """Write the header of a little-endian file; elements are (name, number of rows, properties as (PLY type, name))."""
    lines = ["ply", "format binary_little_endian 1.0"]
    if metadata.up is not None:
        lines.append(f"comment up: {' '.join(f'{value:.6g}' for value in metadata.up)}")
    if metadata.metres_per_unit is not None:
        lines.append(f"comment metres_per_unit: {metadata.metres_per_unit:.9g}")
    for name, count, properties in elements:
        lines += [f"element {name} {count}", *(f"property {kind} {prop}" for kind, prop in properties)]
    stream.write(("\n".join([*lines, "end_header"]) + "\n").encode("ascii"))


def read_points(path: Path) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    """Read a coloured point cloud, or Gaussians as points with their mean colour.

    Returns:
        Positions, and sRGB in [0, 1]; mid grey if the file has no colours.
    """
    with parsing(path):
        return _points(read_header(path))


def _points(header: PlyHeader) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    vertex = header.required("vertex")
    if not set(_POSITION) <= set(vertex.types):
        raise ValueError(f"expected the properties x, y, z, found {', '.join(vertex.types)[:80]}")
    names = next((trio for trio in (*_COLOR_NAMES, _DC) if set(trio) <= set(vertex.types)), ())
    table = torch.from_numpy(read_columns(header, vertex, (*_POSITION, *names)))
    points, colors = table[:, :3].contiguous(), table[:, 3:].contiguous()
    if not names:
        colors = torch.full_like(points, 0.5)
    elif names == _DC:
        colors = spherical_harmonics.rgb_from_dc(colors).clamp(0, 1)
    elif (kind := vertex.types[names[0]])[0] != "f":
        colors = colors / np.iinfo(kind).max
    if not bool(torch.isfinite(points).all()):
        bad = int((~torch.isfinite(points).all(1)).sum())
        raise ValueError(f"expected finite positions, found {bad} of {len(points)} points without")
    if not bool(((colors >= 0) & (colors <= 1)).all()):
        raise ValueError("expected colours as bytes, or as floats in [0, 1], found others")
    return points, colors


def write_points(path: Path, points: Float[Tensor, "m 3"], colors: Float[Tensor, "m 3"]) -> None:
    """Write float32 positions and 8-bit colours, atomically."""
    rows = np.empty(len(points), np.dtype([("position", "<f4", 3), ("color", "u1", 3)]))
    rows["position"] = points.detach().cpu().numpy()
    rows["color"] = (colors.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    with atomic_write(path) as stream:
        properties = [("float", name) for name in _POSITION] + [("uchar", name) for name in _COLOR_NAMES[0]]
        write_header(stream, ("vertex", len(rows), properties))
        stream.write(rows.tobytes())
