"""The container of SOG: a .sog (a zip) or a folder, with meta.json and pictures that hold one byte per channel.

Sizes of zip entries and pictures are compared with the bytes that are there before they are decoded.
"""

import io
import json
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from PIL import Image, UnidentifiedImageError

META_FILE = "meta.json"
_MOST_META_BYTES = 1 << 24
_MOST_EXPANSION = 20
"""Bytes of a zip entry over compressed ones: pictures hardly shrink, meta.json some 3 times."""
_MOST_PIXELS_PER_BYTE = 100
"""Of a picture: random bytes have 0.3, a scene of few different Gaussians 50."""
_FREE_BYTES = 1 << 20
"""Entries and pictures below this size may expand further."""

Load = Callable[[str], bytes]


def files_of(path: Path) -> tuple[Path, ...]:
    """The .sog itself, or all files of a folder with meta.json."""
    if path.is_file() and path.name.lower() != META_FILE:
        return (path,)
    folder = path if path.is_dir() else path.parent
    return tuple(sorted(entry for entry in folder.iterdir() if entry.suffix.lower() in (".json", ".webp", ".png")))


def is_sog_folder(path: Path) -> bool:
    """Whether `path` is a folder of SOG pictures, or its meta.json."""
    meta = path / META_FILE if path.is_dir() else path
    if meta.name.lower() != META_FILE or not meta.is_file() or meta.stat().st_size > _MOST_META_BYTES:
        return False
    try:
        content = json.loads(meta.read_bytes())
    except (ValueError, RecursionError, OSError):
        return False
    return isinstance(content, dict) and {"means", "scales", "quats"} <= set(content)


def open_sog(path: Path) -> tuple[dict[str, Any], Load]:
    """meta.json, and a function that gives the bytes of a file that it names.

    Raises: ValueError where there is no SOG at `path`, or its zip is damaged; so does the function.
    """
    load = _folder(path) if path.is_dir() or path.name.lower() == META_FILE else _archive(path)
    try:
        meta = json.loads(load(META_FILE))
    except (ValueError, RecursionError) as error:
        if str(path) in str(error):
            raise
        raise ValueError(f"{path}: expected JSON in {META_FILE}, found {str(error)[:120]}") from None
    if not isinstance(meta, dict):
        raise ValueError(f"{path}: expected an object in {META_FILE}, found a {type(meta).__name__}")
    return meta, load


def _folder(path: Path) -> Load:
    folder = path if path.is_dir() else path.parent

    def load(name: str) -> bytes:
        file = folder / _plain(path, name)
        if not file.is_file():
            raise ValueError(f"{file}: expected a file of the SOG scene, found none")
        if name == META_FILE and file.stat().st_size > _MOST_META_BYTES:
            raise ValueError(f"{file}: expected at most {_MOST_META_BYTES} bytes, found {file.stat().st_size}")
        return file.read_bytes()

    return load


def _archive(path: Path) -> Load:
    if not path.is_file():
        raise ValueError(f"{path}: expected a .sog file, found none")
    data = path.read_bytes()

    def load(name: str) -> bytes:
        # whatever a damaged archive makes zipfile raise
        try:
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                entries = {entry.filename: entry for entry in archive.infolist()}
                # some tools put all files into one folder of the archive
                names = [n for n in entries if n == name or PurePosixPath(n).name == name]
                if not names:
                    raise ValueError(f"{path}: expected {name} in the archive, found {sorted(entries)[:6]}")
                entry = entries[min(names, key=len)]
                most = max(_FREE_BYTES, _MOST_EXPANSION * min(entry.compress_size, len(data)))
                with archive.open(entry) as stream:
                    out = stream.read(most + 1)
        except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError, OSError) as error:
            raise ValueError(f"{path}: expected a whole zip archive, found {str(error)[:120]}") from None
        except (ValueError, IndexError, KeyError, OverflowError, MemoryError) as error:
            if str(path) in str(error):
                raise
            raise ValueError(f"{path}: expected a whole zip archive, found {str(error)[:120]}") from None
        if len(out) > most:
            raise ValueError(f"{path}: expected {name} to unpack to at most {most} bytes, found more")
        return out

    return load


def _plain(path: Path, name: str) -> str:
    if PurePosixPath(name).name != name or "\\" in name or not name.isprintable():
        raise ValueError(f"{path}: expected plain file names in {META_FILE}, found {name[:60]!r}")
    return name


def read_picture(path: Path, name: str, data: bytes) -> np.ndarray:
    """The pixels of a lossless picture, RGBA bytes (h, w, 4).

    Raises: ValueError where it is no picture, or has more pixels than its bytes can hold.
    """
    # Pillow raises its own kinds of errors on damaged files, even SyntaxError
    try:
        with Image.open(io.BytesIO(data), formats=("WEBP", "PNG")) as picture:
            width, height = picture.size
            most = max(_FREE_BYTES, _MOST_PIXELS_PER_BYTE * len(data))
            if width * height > most:
                raise ValueError(f"{path}: expected {name} with at most {most} pixels, found {width} x {height}")
            return np.asarray(picture.convert("RGBA"))
    except UnidentifiedImageError:
        raise ValueError(f"{path}: expected {name} as WebP or PNG, found another file") from None
    except (OSError, SyntaxError, EOFError, RuntimeError, Image.DecompressionBombError) as error:
        raise ValueError(f"{path}: expected a whole picture {name}, found {str(error)[:120]}") from None
