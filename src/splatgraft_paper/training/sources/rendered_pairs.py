"""The source of pairs rendered by Blender (`splatgraft synth pairs`; paper, Sec. 5.2)."""

from pathlib import Path

from splatgraft_paper.synthesis.pairs import PairSample, read_manifest
from splatgraft_paper.training.sources.pair_files import read_pair
from splatgraft_paper.training.sources.pair_source import Role, TrainingPair


class RenderedPairs:
    """The pairs in the manifest of one folder; composites are computed when they are read."""

    def __init__(self, folder: Path) -> None:
        """Read the manifest.

        Raises:
            ValueError: it is missing or broken.
        """
        self.name = str(folder)
        self._samples = read_manifest(folder)

    def __len__(self) -> int:
        return len(self._samples)

    def group(self, index: int) -> str:
        """Name of the pair's scene."""
        return self._samples[index].folder.name

    def key(self, index: int, role: Role) -> str:
        """Identify the file of a role by path, size and time."""
        return file_fingerprint(_file(self._samples[index], role)) + f"|{role}"

    def location(self, index: int) -> str:
        """The picture of the relit object."""
        return str(_file(self._samples[index], "composite"))

    def files(self, index: int) -> dict[str, Path]:
        """The four pictures of a pair."""
        sample = self._samples[index]
        roles: dict[str, Role] = {"target": "target", "background": "background", "mask": "mask", "relit": "composite"}
        return {name: _file(sample, role) for name, role in roles.items()}

    def read(self, index: int) -> TrainingPair:
        """Read a pair.

        Raises:
            ValueError: a file is missing or broken.
        """
        return read_pair(self.files(index))


def file_fingerprint(path: Path) -> str:
    """Identify a file's content by path, size and time of modification.

    Raises:
        ValueError: it is missing.
    """
    try:
        status = path.stat()
    except OSError as error:
        raise ValueError(f"{path}: expected a picture of a pair, found {error.strerror}") from error
    return f"{path.resolve()}|{status.st_size}|{status.st_mtime_ns}"


def _file(sample: PairSample, role: Role) -> Path:
    if role == "composite":
        return sample.path(f"{sample.object}_{sample.light}")
    if role == "background":
        return sample.path("background")
    return sample.path(sample.object, "mask" if role == "mask" else "")
