"""Name of `runtime/files.py` before it was joined; goes when nothing imports it."""

from splatgraft.runtime.files import atomic_write

__all__ = ["atomic_write"]
