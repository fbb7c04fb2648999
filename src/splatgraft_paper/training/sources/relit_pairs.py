"""The source of pairs made of relit images: generated ones and photographs (paper, Sec. 5.2).

manifest.jsonl                 one line per sample: folder, group, relit (number of lights), provenance
NAME/target.png  background.png  mask.png  relit_0.png ..  record.json
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from splatgraft.core.images import write_image
from splatgraft.runtime.atomic_file import atomic_write
from splatgraft.runtime.atomic_folder import atomic_folder
from splatgraft_paper.training.sources.pair_files import read_pair
from splatgraft_paper.training.sources.pair_source import Role, TrainingPair
from splatgraft_paper.training.sources.rendered_pairs import file_fingerprint

MANIFEST_FILE = "manifest.jsonl"
RECORD_FILE = "record.json"


@dataclass(frozen=True)
class RelitSample:
    """One target with its background and relit images."""

    target: Float[Tensor, "h w 3"]
    background: Float[Tensor, "h w 3"]
    mask: Float[Tensor, "h w"]
    relit: Sequence[Float[Tensor, "h w 3"]]
    """The whole target under other lights, one image per light."""


def write_sample(folder: Path, sample: RelitSample, record: Mapping[str, Any]) -> None:
    """Write one sample atomically; `record` holds group, licence and provenance of each image."""
    with atomic_folder(folder) as new:
        write_image(new / "target.png", sample.target)
        write_image(new / "background.png", sample.background)
        write_image(new / "mask.png", sample.mask)
        for i, picture in enumerate(sample.relit):
            write_image(new / f"relit_{i}.png", picture)
        (new / RECORD_FILE).write_text(json.dumps({**record, "relit": len(sample.relit)}, indent=1) + "\n")


def write_manifest(out: Path) -> int:
    """Write one line for each complete sample; returns their number."""
    lines = []
    for path in sorted(out.glob(f"*/{RECORD_FILE}")):
        lines.append(json.dumps({"folder": path.parent.name, **json.loads(path.read_text())}))
    with atomic_write(out / MANIFEST_FILE) as stream:
        stream.write("".join(f"{line}\n" for line in lines).encode())
    return len(lines)


class RelitPairs:
    """The samples of one folder; one pair per sample and light."""

    def __init__(self, folder: Path) -> None:
        """Read the manifest.

        Raises:
            ValueError: it is missing or broken.
        """
        self.name = str(folder)
        self._pairs: list[tuple[Path, str, int]] = []
        path = folder / MANIFEST_FILE
        if not path.is_file():
            raise ValueError(
                f"{path}: expected the manifest of generated pairs, found none (splatgraft synth generated)"
            )
        for number, line in enumerate(path.read_text().splitlines(), 1):
            try:
                entry = json.loads(line)
                for light in range(int(entry["relit"])):
                    self._pairs.append((folder / entry["folder"], str(entry["group"]), light))
            except (ValueError, KeyError, TypeError) as error:
                raise ValueError(
                    f"{path}, line {number}: expected folder, group and relit, found {line[:80]}"
                ) from error

    def __len__(self) -> int:
        return len(self._pairs)

    def group(self, index: int) -> str:
        """The photograph's scene, or the prompt's object."""
        return self._pairs[index][1]

    def key(self, index: int, role: Role) -> str:
        """Identify the file of a role by path, size and time."""
        folder, _, light = self._pairs[index]
        return file_fingerprint(folder / (f"relit_{light}.png" if role == "composite" else f"{role}.png")) + f"|{role}"

    def location(self, index: int) -> str:
        """The picture of the relit object."""
        return str(self.files(index)["relit"])

    def files(self, index: int) -> dict[str, Path]:
        """The four pictures of a pair."""
        folder, _, light = self._pairs[index]
        names = {name: folder / f"{name}.png" for name in ("target", "background", "mask")}
        return {**names, "relit": folder / f"relit_{light}.png"}

    def read(self, index: int) -> TrainingPair:
        """Read a pair.

        Raises:
            ValueError: a file is missing or broken.
        """
        return read_pair(self.files(index))
