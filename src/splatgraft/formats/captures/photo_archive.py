"""Photos that come in a .zip file, as phones and cloud services hand them out."""

import shutil
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from splatgraft.core.images import IMAGE_SUFFIXES

_MAX_FILES = 20_000
_MAX_BYTES = 32 << 30  # of all photos together
_MAX_RATIO = 20  # unpacked over packed bytes; photos are compressed already, and masks are small
_SMALL = 256 << 20  # bytes up to which the ratio does not matter
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Of the others zipfile unpacks each part that it reads whole, which may be thousands of times as large."""


def is_archive(path: Path) -> bool:
    """Whether a path is a .zip file."""
    return path.suffix.lower() == ".zip" and path.is_file()


def count_archived_photos(archive: Path) -> int:
    """How many photos and masks are in a .zip file, which is not unpacked."""
    with _opened(archive) as (_, members):
        return len(members)


def unpack_photos(archive: Path, folder: Path) -> Path:
    """Write the photos and masks in a .zip file to `folder`, in the folders that they have there.

    Args:
        archive: A .zip file; what is no picture in it is left out.
        folder: Made by this function; it has all photos, or does not exist.

    Returns:
        `folder`.

    Raises:
        ValueError: It is damaged, encrypted or without photos, or it names files outside of its folder, or is larger
            than any capture.
    """
    partial = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        with _opened(archive) as (opened, members):
            for member, name in members:
                target = partial / name
                target.parent.mkdir(parents=True, exist_ok=True)
                with opened.open(member) as packed, target.open("wb") as out:
                    # zipfile reads no more than the size that was checked
                    shutil.copyfileobj(packed, out)
        partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return folder


@contextmanager
def _opened(archive: Path) -> Iterator[tuple[zipfile.ZipFile, list[tuple[zipfile.ZipInfo, PurePosixPath]]]]:
    """An archive and the members that are pictures, checked."""
    expected = f"{archive}: expected a .zip of photos, found"
    try:
        with zipfile.ZipFile(archive) as opened:
            members = [(one, PurePosixPath(one.filename)) for one in opened.infolist()]
            members = [(one, name) for one, name in members if not one.is_dir() and _is_picture(name)]
            for _, name in members:
                if name.is_absolute() or ".." in name.parts:
                    raise ValueError(f"{expected} one that writes outside of its folder, to {name}")
            size = sum(one.file_size for one, _ in members)
            if len(members) > _MAX_FILES or size > max(_SMALL, min(_MAX_BYTES, _MAX_RATIO * archive.stat().st_size)):
                raise ValueError(f"{expected} one that unpacks to {len(members)} files of {size / 1e9:.1f} GB")
            if any(one.compress_type not in _METHODS for one, _ in members):
                raise ValueError(f"{expected} one that is not deflated or stored")
            if not members:
                raise ValueError(f"{expected} no photo in it")
            yield opened, members
    except (zipfile.BadZipFile, RuntimeError, NotImplementedError, EOFError, zlib.error) as error:
        # RuntimeError is what zipfile raises for a password
        raise ValueError(f"{expected} one that cannot be read ({error})") from None


def _is_picture(name: PurePosixPath) -> bool:
    hidden = any(part.startswith((".", "__MACOSX")) and part != ".." for part in name.parts)
    return name.suffix.lower() in IMAGE_SUFFIXES and not hidden
