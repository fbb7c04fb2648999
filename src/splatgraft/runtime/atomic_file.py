"""Atomic writing of files: to a partial file in the same folder, renamed when it is complete."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


@contextmanager
def atomic_write(path: Path) -> Iterator[BinaryIO]:
    """A binary stream that replaces `path` when the block succeeds; when it raises, `path` stays as it was.

    Raises: ValueError where the folder does not exist or `path` is a folder.
    """
    if not path.parent.is_dir():
        raise ValueError(f"{path}: expected an existing folder to write into, found no {path.parent}")
    if path.is_dir():
        raise ValueError(f"{path}: expected a file name to write, found a folder")
    partial = path.with_name(f".{path.name}.partial")  # fixed: replaces what a killed write left
    try:
        with partial.open("wb") as stream:
            yield stream
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
