"""Generates samples of relit images into a folder; finished samples are kept, unsuitable ones are recorded."""

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
from splatgraft_paper.training.sources.relighters import Relighter, RelightingInput
from splatgraft_paper.training.sources.relit_pairs import (
    RECORD_FILE,
    RelitPairs,
    RelitSample,
    write_manifest,
    write_sample,
)

SHEET_FILE = "sheet.png"
_REJECTED = "rejected"
_MIN_COVERED, _MAX_COVERED = 0.01, 0.6
"""Share of the image that an object may cover; set by hand."""


@dataclass(frozen=True)
class UnrelitSample:
    """A target with its background and mask, before relighting."""

    target: Float[Tensor, "h w 3"]
    background: Float[Tensor, "h w 3"]
    mask: Float[Tensor, "h w"]


@dataclass(frozen=True)
class SamplePlan:
    """One sample to be generated."""

    name: str
    """Of the sample's folder."""
    group: str
    """Samples of one group are held out together."""
    make: Callable[[], UnrelitSample]
    record: Mapping[str, Any]
    """Provenance: prompt, seed, models, licence."""


@dataclass(frozen=True)
class Lighting:
    """The relighter and the environment maps of the samples."""

    relighter: Relighter
    maps: Sequence[Path]
    """Environment maps to choose from."""
    each: int
    """Lights per sample."""
    seed: int

    def choose(self, name: str) -> list[Path]:
        """Choose the maps of a sample, determined by its name and the seed."""
        return random.Random(f"lights-{self.seed}-{name}").sample(list(self.maps), min(self.each, len(self.maps)))


def generate(
    out: Path, plans: Iterable[SamplePlan], lighting: Lighting, *, total: int, progress: Progress = silent
) -> int:
    """Generate missing samples, then write the manifest and a contact sheet.

    A sample whose object is too small, too large or not found is recorded in rejected/ and not tried again.

    Args:
        out: folder of the samples.
        plans: candidates, in order.
        lighting: how they are relit.
        total: number of samples to reach.
        progress: called after each candidate.

    Returns:
        The number of samples in `out`.

    Raises:
        ValueError: a model fails; finished samples are kept.
    """
    (out / _REJECTED).mkdir(parents=True, exist_ok=True)
    done = 0
    try:
        for plan in plans:
            if done >= total:
                break
            if (out / plan.name / RECORD_FILE).is_file():
                done += 1
            elif not (out / _REJECTED / f"{plan.name}.json").is_file():
                done += _generate_one(out, plan, lighting)
            progress(done, total, plan.name)
    finally:
        count = write_manifest(out)
    if count:
        write_image(out / SHEET_FILE, contact_sheet(RelitPairs(out)))
    return count


def contact_sheet(pairs: RelitPairs, *, rows: int = 24, width: int = 240) -> Float[Tensor, "h w 3"]:
    """Show evenly chosen pairs, one per row: target, background, composite."""
    chosen = [round(i * (len(pairs) - 1) / max(rows - 1, 1)) for i in range(min(rows, len(pairs)))]
    lines = []
    for index in chosen:
        pair = pairs.read(index)
        height = round(width * pair.target.shape[0] / pair.target.shape[1])
        pictures = (pair.target, pair.background, pair.composite)
        lines.append(torch.cat([resize(picture, width, height) for picture in pictures], 1))
    tallest = max(line.shape[0] for line in lines)
    return torch.cat([torch.cat([line, torch.ones(tallest - line.shape[0], *line.shape[1:])]) for line in lines])


def _generate_one(out: Path, plan: SamplePlan, lighting: Lighting) -> int:
    """Write the sample; 1 where it was written, 0 where it was rejected."""
    unrelit = plan.make()
    covered = float((unrelit.mask > 0.5).float().mean())
    if not _MIN_COVERED <= covered <= _MAX_COVERED:
        note = {**plan.record, "reason": f"object covers {covered:.1%} of the picture"}
        with atomic_write(out / _REJECTED / f"{plan.name}.json") as stream:
            stream.write((json.dumps(note) + "\n").encode())
        return 0
    maps = lighting.choose(plan.name)
    relit = lighting.relighter.relight(RelightingInput(plan.name, unrelit.target, unrelit.mask), maps)
    record = {
        **plan.record,
        "group": plan.group,
        "relighter": lighting.relighter.name,
        "relighter_licence": lighting.relighter.licence,
        "lights": [path.name for path in maps],
    }
    write_sample(out / plan.name, RelitSample(unrelit.target, unrelit.background, unrelit.mask, relit), record)
    return 1
