"""The PLY container: header, elements, properties; binary of both byte orders and ascii.

Element counts of a header are checked against the size of the file before anything is allocated.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

_MAX_HEADER_BYTES = 1 << 20
_ROWS_PER_CHUNK = 1 << 12
_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
_FORMATS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}


@dataclass(frozen=True)
class Property:
    """One column of an element."""

    name: str
    type: str
    """numpy type code without byte order, such as f4."""
    length_type: str | None = None
    """Type of the length in front of each row's list; None for a single value."""


@dataclass(frozen=True)
class Element:
    """A table of the file."""

    name: str
    count: int
    properties: tuple[Property, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Property names, in order."""
        return tuple(p.name for p in self.properties)

    @property
    def has_lists(self) -> bool:
        """Whether rows differ in length."""
        return any(p.length_type for p in self.properties)

    def dtype(self, order: str) -> np.dtype:
        """The packed row."""
        return np.dtype([(p.name, order + p.type) for p in self.properties])


@dataclass(frozen=True)
class PlyHeader:
    """The header of a PLY file."""

    path: Path
    order: str
    """Byte order, < or >; empty for ascii."""
    elements: tuple[Element, ...]
    data_start: int
    """Offset of the first byte after the header."""
    comments: tuple[str, ...] = ()
    """Texts of the comment lines, in order."""

    def element(self, name: str) -> Element | None:
        """The element called `name`, or None."""
        return next((e for e in self.elements if e.name == name), None)


def read_header(path: Path) -> PlyHeader:
    """The header, with counts checked against the length of the file.

    Raises: ValueError where the file is no PLY, or shorter or longer than the header requires.
    """
    if not path.is_file():
        raise ValueError(f"{path}: expected a .ply file, found none")
    with path.open("rb") as stream:
        head = stream.read(_MAX_HEADER_BYTES)
    if not re.match(rb"ply[ \t]*\r?\n", head):
        raise ValueError(f"{path}: expected a PLY file that starts with 'ply', found {head[:8]!r}")
    end = re.search(rb"\nend_header[ \t]*\r?\n", head)
    if end is None:
        raise ValueError(f"{path}: expected 'end_header' within the first {len(head)} bytes, found none")
    lines = head[: end.start()].decode("utf-8", "replace").splitlines()[1:]
    order, elements = _parse(path, lines)
    comments = tuple(line[8:].strip() for line in lines if line.startswith("comment "))
    header = PlyHeader(path=path, order=order, elements=elements, data_start=end.end(), comments=comments)
    _check_size(header)
    return header


def _parse(path: Path, lines: list[str]) -> tuple[str, tuple[Element, ...]]:
    order: str | None = None
    elements: list[Element] = []
    for line in lines:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", name, "1.0"] if name in _FORMATS and order is None:
                order = _FORMATS[name]
            case ["element", name, count] if re.fullmatch(r"[0-9]{1,15}", count):
                elements.append(Element(name=name, count=int(count), properties=()))
            case ["property", kind, name] if kind in _TYPES and elements:
                elements[-1] = _with_property(path, elements[-1], Property(name, _TYPES[kind]))
            case ["property", "list", length, kind, name] if length in _TYPES and kind in _TYPES and elements:
                added = Property(name, _TYPES[kind], _TYPES[length])
                elements[-1] = _with_property(path, elements[-1], added)
            case _:
                raise ValueError(f"{path}: expected a PLY header line, found {line[:60]!r}")
    if order is None:
        raise ValueError(f"{path}: expected a 'format' line in the PLY header, found none")
    names = [e.name for e in elements]
    if len(set(names)) < len(names):
        raise ValueError(f"{path}: expected PLY elements of different names, found {names[:20]}")
    return order, tuple(elements)


def _with_property(path: Path, element: Element, added: Property) -> Element:
    if added.name in element.names:
        raise ValueError(f"{path}: expected each property of '{element.name}' once, found '{added.name}' twice")
    if len(element.properties) >= 4096:
        raise ValueError(f"{path}: expected at most 4096 properties of '{element.name}', found more")
    return Element(element.name, element.count, (*element.properties, added))


def _check_size(header: PlyHeader) -> None:
    """Each row of a list takes at least its length field; each ascii value a digit and a separator."""
    available = header.path.stat().st_size - header.data_start
    needed = 0
    for element in header.elements:
        if header.order == "":
            row = 2 * len(element.properties)
        else:
            row = sum(np.dtype(p.length_type or p.type).itemsize for p in element.properties)
        needed += element.count * row
    open_ended = header.order == "" or any(e.has_lists for e in header.elements)
    slack = 1 if header.order == "" else 0  # the last line may lack its line end
    if available + slack < needed or (available > needed and not open_ended):
        counts = ", ".join(f"{e.count} {e.name}" for e in header.elements)
        bound = "at least " if open_ended else ""
        raise ValueError(
            f"{header.path}: expected {bound}{needed} bytes of data after the header ({counts}), found {available}"
        )


def read_chunks(header: PlyHeader, element: Element) -> Iterator[tuple[int, np.ndarray]]:
    """Row offset and a structured array, chunk by chunk, so that memory stays near what the caller keeps.

    Raises: ValueError where the element has list properties, or its data ends early or is no number.
    """
    if element.has_lists:
        lists = [p.name for p in element.properties if p.length_type]
        raise ValueError(f"{header.path}: expected single values in element '{element.name}', found lists {lists}")
    before = header.elements[: header.elements.index(element)]
    with header.path.open("rb") as stream:
        stream.seek(header.data_start)
        for other in before:
            _skip(stream, header, other)
        for start in range(0, element.count, _ROWS_PER_CHUNK):
            count = min(_ROWS_PER_CHUNK, element.count - start)
            read = _read_ascii if header.order == "" else _read_binary
            yield start, read(stream, header, element, count)


def read_columns(header: PlyHeader, element: Element, names: tuple[str, ...]) -> np.ndarray:
    """The properties `names` as float32, (count, len(names))."""
    out = np.empty((element.count, len(names)), np.float32)
    for start, rows in read_chunks(header, element):
        for column, name in enumerate(names):
            with np.errstate(over="ignore"):  # a double beyond float32 is infinite, as its reader would find it
                out[start : start + len(rows), column] = rows[name]
    return out


def _read_binary(stream: BinaryIO, header: PlyHeader, element: Element, count: int) -> np.ndarray:
    dtype = element.dtype(header.order)
    data = stream.read(count * dtype.itemsize)
    if len(data) < count * dtype.itemsize:
        raise ValueError(
            f"{header.path}: expected {count * dtype.itemsize} more bytes of '{element.name}', found {len(data)}"
        )
    return np.frombuffer(data, dtype, count)


def _read_ascii(stream: BinaryIO, header: PlyHeader, element: Element, count: int) -> np.ndarray:
    width = len(element.properties)
    words = [word for _ in range(count) for word in stream.readline(_MAX_HEADER_BYTES).split()]
    if len(words) != count * width:
        raise ValueError(
            f"{header.path}: expected {width} values in each line of '{element.name}', "
            f"found {len(words)} in {count} lines"
        )
    try:
        values = np.array(words, np.float64).reshape(count, width)
    except ValueError as error:
        raise ValueError(f"{header.path}: expected numbers in element '{element.name}', found {error}") from None
    return values.view([(name, "f8") for name in element.names])[:, 0]


def _skip(stream: BinaryIO, header: PlyHeader, element: Element) -> None:
    if header.order == "":
        for _ in range(element.count):
            if not stream.readline(_MAX_HEADER_BYTES):
                break
        return
    if not element.has_lists:
        stream.seek(element.count * element.dtype(header.order).itemsize, 1)
        return
    size = header.path.stat().st_size
    for _ in range(element.count):
        for prop in element.properties:
            item = np.dtype(prop.type).itemsize
            length = 1
            if prop.length_type is not None:
                kind = np.dtype(header.order + prop.length_type)
                data = stream.read(kind.itemsize)
                found = np.frombuffer(data, kind)[0] if len(data) == kind.itemsize else -1
                length = int(found) if np.isfinite(found) else -1
            if length < 0 or stream.tell() + length * item > size:
                raise ValueError(f"{header.path}: expected whole lists in element '{element.name}', found a cut one")
            stream.seek(length * item, 1)


def write_header(
    stream: BinaryIO, *elements: tuple[str, int, Sequence[tuple[str, str]]], comments: Sequence[str] = ()
) -> None:
    """The header of a little-endian file of elements (name, number of rows, properties as (PLY type, name))."""
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {comment}" for comment in comments)]
    for name, count, properties in elements:
        lines += [f"element {name} {count}", *(f"property {kind} {prop}" for kind, prop in properties)]
    stream.write(("\n".join([*lines, "end_header"]) + "\n").encode("ascii"))
