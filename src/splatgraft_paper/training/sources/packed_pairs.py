"""Training pairs packed into tar files, on a disk or in object storage (fsspec).

    index.jsonl          one line per pair: each of its pictures as [shard, offset, bytes], group, name
    pairs-00000.tar ..   NUMBER/FOLDER/FOLDER/NAME.png: the files of the sources, each stored once

A pair is read by the places of its pictures: any pair at any time, as resuming needs it, at one request per picture.
"""

import io
import json
import tarfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from splatgraft.runtime.progress import Progress, silent
from splatgraft_paper.training.sources.pair_files import PICTURES, FilePairs, read_pair
from splatgraft_paper.training.sources.pair_source import Role, TrainingPair

INDEX_FILE = "index.jsonl"


@dataclass(frozen=True)
class _Place:
    """Bytes of a shard."""

    shard: str
    offset: int
    length: int


def pack_pairs(sources: Sequence[FilePairs], out: Path, *, shard_bytes: int, progress: Progress = silent) -> int:
    """Pack all pairs of some sources.

    Args:
        sources: pairs whose pictures are files.
        out: an empty or new folder.
        shard_bytes: a shard is closed when it is larger.
        progress: called after every pair.

    Returns:
        The number of pairs.

    Raises:
        ValueError: `out` holds an index, or a picture is missing.
    """
    index = out / INDEX_FILE
    if index.exists():
        raise ValueError(f"{index}: expected no packed pairs, found some; name another folder")
    out.mkdir(parents=True, exist_ok=True)
    writer, lines = _ShardWriter(out, shard_bytes), []
    total, done = sum(map(len, sources)), 0
    for number, source in enumerate(sources):
        for i in range(len(source)):
            files = source.files(i)
            places = {name: writer.add(files[name], str(number)) for name in PICTURES}
            shown = {name: [place.shard, place.offset, place.length] for name, place in places.items()}
            lines.append({**shown, "group": f"{number}/{source.group(i)}", "name": source.location(i)})
            done += 1
            progress(done, total, writer.name)
    writer.close()
    # last: a folder with an index is whole
    index.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return done


class PackedPairs:
    """The pairs of one folder of tar files."""

    def __init__(self, address: str) -> None:
        """Read the index.

        Args:
            address: a folder, or an address that fsspec understands, such as s3://bucket/pairs.

        Raises:
            ValueError: there is no index, or it is broken.
        """
        import fsspec

        self.name = address
        path = f"{address.rstrip('/')}/{INDEX_FILE}"
        try:
            self._files, self._root = fsspec.core.url_to_fs(address)
            text = self._files.cat_file(f"{self._root}/{INDEX_FILE}").decode()
        except (OSError, ValueError, ImportError) as error:
            raise ValueError(f"{path}: expected the index of packed pairs, found {_one_line(error)}") from error
        self._pairs: list[dict[str, Any]] = []
        for number, line in enumerate(text.splitlines(), 1):
            try:
                entry = json.loads(line)
                places = {name: _Place(*entry[name]) for name in PICTURES}
                self._pairs.append({**places, "group": str(entry["group"]), "name": str(entry["name"])})
            except (ValueError, KeyError, TypeError) as error:
                raise ValueError(f"{path}, line {number}: expected a packed pair, found {line[:80]}") from error

    def __len__(self) -> int:
        return len(self._pairs)

    def group(self, index: int) -> str:
        """Number of the packed source, and the group there."""
        return self._pairs[index]["group"]

    def location(self, index: int) -> str:
        """The picture of the relit object in the folder that was packed."""
        return self._pairs[index]["name"]

    def key(self, index: int, role: Role) -> str:
        """Identify the picture of a role by its place; shards are never changed."""
        place = self._pairs[index]["relit" if role == "composite" else role]
        return f"{self.name}|{place.shard}|{place.offset}|{place.length}|{role}"

    def read(self, index: int) -> TrainingPair:
        """Read a pair.

        Raises:
            ValueError: a shard is missing, or holds no picture at that place.
        """
        entry = self._pairs[index]
        with TemporaryDirectory() as folder:
            files = {name: Path(folder) / f"{name}.png" for name in PICTURES}
            for name, file in files.items():
                file.write_bytes(self._bytes(entry[name]))
            try:
                return read_pair(files)
            except ValueError as error:
                wrong = " ".join(str(error).split()).replace(f"{folder}/", "")
                shard = f"{self._root}/{entry['relit'].shard}"
                raise ValueError(f"{shard}: expected the pictures of {entry['name']}, found {wrong}") from error

    def _bytes(self, place: _Place) -> bytes:
        path = f"{self._root}/{place.shard}"
        try:
            return self._files.cat_file(path, start=place.offset, end=place.offset + place.length)
        except OSError as error:
            raise ValueError(f"{path}: expected a shard of packed pairs, found {_one_line(error)}") from error


class _ShardWriter:
    """Writes files into tar files, each file once."""

    def __init__(self, out: Path, shard_bytes: int) -> None:
        self._out, self._limit = out, shard_bytes
        self._known: dict[Path, _Place] = {}
        self._tar: tarfile.TarFile | None = None
        self._count, self.name = 0, ""

    def add(self, path: Path, source: str) -> _Place:
        """Append a file unless it is there already."""
        if path in self._known:
            return self._known[path]
        try:
            content = path.read_bytes()
        except OSError as error:
            raise ValueError(f"{path}: expected a picture of a pair, found {error.strerror}") from error
        if self._tar is None or self._tar.offset > self._limit:
            self._open()
        assert self._tar is not None
        entry = tarfile.TarInfo("/".join([source, *path.parent.parts[-2:], path.name]))
        entry.size = len(content)
        offset = self._tar.offset + tarfile.BLOCKSIZE
        self._tar.addfile(entry, io.BytesIO(content))
        self._known[path] = _Place(self.name, offset, len(content))
        return self._known[path]

    def close(self) -> None:
        """Finish the open shard."""
        if self._tar is not None:
            self._tar.close()

    def _open(self) -> None:
        self.close()
        self.name = f"pairs-{self._count:05d}.tar"
        self._count += 1
        path = self._out / self.name
        self._tar = tarfile.open(path, "w", format=tarfile.USTAR_FORMAT)  # noqa: SIM115 (closed by close)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
