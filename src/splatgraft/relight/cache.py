"""Keeps what a transfer needs again when only the object has moved. Knows nothing about what it keeps."""

from splatgraft.kept import Kept


class RelightCache(Kept):
    """Results by name, each valid for the very inputs it was made from."""
