"""Makes samples of relit pictures: what is done is kept, what is unfit is noted. Knows no particular model."""

import json
import random
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.images import resize, write_image
from splatgraft.runtime.atomic_file import atomic_write
from splatgraft.runtime.progress import Progress, silent
from splatgraft.training.sources.relighters import Relighter, RelightingInput
from splatgraft.training.sources.relit_pairs import RECORD_FILE, RelitPairs, RelitSample, write_manifest, write_sample

SHEET_FILE = "sheet.png"
_REJECTED = "rejected"
_SMALLEST, _LARGEST = 0.01, 0.6
"""Share of the picture that an object may cover."""


@dataclass(frozen=True)
class UnrelitSample:
    """A target with its mask and background, before it is relit."""

    target: Float[Tensor, "h w 3"]
    background: Float[Tensor, "h w 3"]
    mask: Float[Tensor, "h w"]


@dataclass(frozen=True)
class SamplePlan:
    """One sample that is to be made."""

    name: str
    """Of its folder."""
    group: str
    """What is held out together."""
    make: Callable[[], UnrelitSample]
    record: Mapping[str, Any]
    """How it is made: prompt, seed, models, licence."""


@dataclass(frozen=True)
class Lighting:
    """How samples are relit."""

    relighter: Relighter
    maps: Sequence[Path]
    """Environment maps to choose from."""
    each: int
    """Lights per sample."""
    seed: int

    def choose(self, name: str) -> list[Path]:
        """The maps of a sample, determined by its name and the seed."""
        return random.Random(f"lights-{self.seed}-{name}").sample(list(self.maps), min(self.each, len(self.maps)))


def generate(
    out: Path, wanted: Iterable[SamplePlan], lighting: Lighting, *, total: int, progress: Progress = silent
) -> int:
    """Make what is missing, up to `total` samples; manifest and sheet at the end; returns how many are there.

    A sample whose object is too small, too large or not found is noted in rejected/ and not tried again.

    Raises: ValueError where a model fails; what is done is kept.
    """
    (out / _REJECTED).mkdir(parents=True, exist_ok=True)
    done = 0
    try:
        for item in wanted:
            if done >= total:
                break
            if (out / item.name / RECORD_FILE).is_file():
                done += 1
            elif not (out / _REJECTED / f"{item.name}.json").is_file():
                done += _make(out, item, lighting)
            progress(done, total, item.name)
    finally:
        count = write_manifest(out)
    if count:
        write_image(out / SHEET_FILE, contact_sheet(RelitPairs(out)))
    return count


def contact_sheet(pairs: RelitPairs, *, rows: int = 24, width: int = 240) -> Float[Tensor, "h w 3"]:
    """To look at: per row a target, its background and one composite; evenly chosen."""
    chosen = [round(i * (len(pairs) - 1) / max(rows - 1, 1)) for i in range(min(rows, len(pairs)))]
    lines = []
    for index in chosen:
        pair = pairs.read(index)
        height = round(width * pair.target.shape[0] / pair.target.shape[1])
        pictures = (pair.target, pair.background, pair.composite)
        lines.append(torch.cat([resize(picture, width, height) for picture in pictures], 1))
    tallest = max(line.shape[0] for line in lines)
    return torch.cat([torch.cat([line, torch.ones(tallest - line.shape[0], *line.shape[1:])]) for line in lines])


def _make(out: Path, item: SamplePlan, lighting: Lighting) -> int:
    made = item.make()
    covered = float((made.mask > 0.5).float().mean())
    if not _SMALLEST <= covered <= _LARGEST:
        note = {**item.record, "reason": f"object covers {covered:.1%} of the picture"}
        with atomic_write(out / _REJECTED / f"{item.name}.json") as stream:
            stream.write((json.dumps(note) + "\n").encode())
        return 0
    maps = lighting.choose(item.name)
    relit = lighting.relighter.relight(RelightingInput(item.name, made.target, made.mask), maps)
    record = {
        **item.record,
        "group": item.group,
        "relighter": lighting.relighter.name,
        "relighter_licence": lighting.relighter.licence,
        "lights": [path.name for path in maps],
    }
    write_sample(out / item.name, RelitSample(made.target, made.background, made.mask, relit), record)
    return 1
