"""The command `synth orida`: training pairs from ORIDa's photographs (paper, Sec. 5.2)."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from splatgraft.core.images import read_mask, read_rgb
from splatgraft.project.folder_lock import locked
from splatgraft.project.step import Positional
from splatgraft.runtime.console import Console
from splatgraft.workflow.image_size import parse_image_size
from splatgraft_paper.training.sources.generate import SamplePlan, UnrelitSample, generate
from splatgraft_paper.training.sources.orida import LICENCE, Photograph, choose_balanced, read_orida
from splatgraft_paper.training.sources.pair_source import crop_to_size
from splatgraft_paper.training.sources.relighting_options import RelightingOptions


@dataclass(frozen=True)
class OridaPairs:
    """Choose photographs of ORIDa, balanced by object and scene, and relight them; a killed run is continued."""

    out: Positional
    """Folder for one folder per photograph, manifest.jsonl and sheet.png with all samples."""
    orida: Path
    """A folder with index.csv (image, mask, background, object, scene), or OBJECT/SCENE/images, masks, background.*."""
    relighting: RelightingOptions = field(default_factory=RelightingOptions)
    number: int = 2000
    """Number of photographs."""
    size: str = "704x496"
    """Pixels, WIDTHxHEIGHT; photographs of another shape are cropped to the centre."""
    seed: int = 0
    """Of the choice and the lights."""

    def execute(self, console: Console) -> int:
        """Make the missing samples."""
        width, height = parse_image_size(self.size)
        there = read_orida(self.orida)
        chosen = choose_balanced(there, self.number, self.seed)
        objects, scenes = len({p.object for p in chosen}), len({p.scene for p in chosen})
        console.say(f"{len(chosen)} of {len(there)} photographs, {objects} objects in {scenes} scenes")
        lighting = self.relighting.open(self.seed)
        with locked(self.out), console.bar("orida") as progress:
            wanted = _wanted(chosen, width, height, self.seed)
            made = generate(self.out, wanted, lighting, total=len(chosen), progress=progress)
        console.say(f"{made} samples; look at sheet.png")
        console.result(self.out / "manifest.jsonl")
        return 0


def _wanted(chosen: list[Photograph], width: int, height: int, seed: int) -> Iterator[SamplePlan]:
    for photograph in chosen:
        record = {"image": photograph.image.name, "object": photograph.object, "scene": photograph.scene}
        record |= {"licence": LICENCE, "chosen_by": f"balanced, seed {seed}"}
        yield SamplePlan(photograph.name, photograph.scene, partial(_read, photograph, width, height), record)


def _read(photograph: Photograph, width: int, height: int) -> UnrelitSample:
    target, background = read_rgb(photograph.image), read_rgb(photograph.background)
    mask = read_mask(photograph.mask)
    for path, picture in ((photograph.background, background), (photograph.mask, mask)):
        if picture.shape[:2] != target.shape[:2]:
            wanted, found = (f"{size[1]}x{size[0]}" for size in (target.shape, picture.shape))
            raise ValueError(f"{path}: expected {wanted} pixels as {photograph.image.name}, found {found}")
    images = (crop_to_size(image, width, height).clamp(0, 1) for image in (target, background, mask))
    return UnrelitSample(*images)


COMMAND = OridaPairs
