"""Samples of relit images, painted by FLUX.1-schnell or chosen from ORIDa's photos (paper, Sec. 5.2 and 5.3).

Finished samples are kept, unsuitable ones are recorded. Untested with FLUX's real weights and ORIDa's archive.
"""

import csv
import json
import random
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.images import resize, write_image
from splatgraft.harmonization.flux.loading import diffusers_library
from splatgraft.harmonization.flux.tensor_file import one_line
from splatgraft.runtime.files import atomic_write
from splatgraft.runtime.hub import hub_id
from splatgraft.runtime.progress import Progress, silent
from splatgraft_paper.training.pairs import (
    RECORD_FILE,
    PairFolder,
    RelitSample,
    open_relit,
    write_relit_manifest,
    write_sample,
)
from splatgraft_paper.training.relighters import DiffusionRenderer, StandInRelighter

SHEET_FILE = "sheet.png"
_REJECTED = "rejected"
_MIN_COVERED, _MAX_COVERED = 0.01, 0.6  # limits of the share of the image that an object covers, set by hand


@dataclass(frozen=True)
class SamplePlan:
    """One sample to generate."""

    name: str
    """Name of the sample's folder."""
    group: str
    """Group of samples that are held out together."""
    make: Callable[[], RelitSample]
    """Function that returns the sample before relighting."""
    record: Mapping[str, Any]
    """Provenance: prompt, seed, models, licence."""


@dataclass(frozen=True)
class Lighting:
    """Relighter and environment maps of the samples."""

    relighter: DiffusionRenderer | StandInRelighter
    maps: Sequence[Path]
    """Environment maps to choose from."""
    each: int
    """Number of lights per sample."""
    seed: int

    def choose(self, name: str) -> list[Path]:
        """Choose the maps of a sample; its name and the seed determine them."""
        return random.Random(f"lights-{self.seed}-{name}").sample(list(self.maps), min(self.each, len(self.maps)))


def generate(
    out: Path, plans: Iterable[SamplePlan], lighting: Lighting, *, total: int, progress: Progress = silent
) -> int:
    """Generate samples up to `total`, write the manifest and a contact sheet, and return the number of samples.

    A sample is recorded in rejected/ and not tried again if its object is too small, too large or not found.
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
        count = write_relit_manifest(out)
    if count:
        write_image(out / SHEET_FILE, contact_sheet(open_relit(out)))
    return count


def contact_sheet(folder: PairFolder, *, rows: int = 24, width: int = 240) -> Float[Tensor, "h w 3"]:
    """Make a sheet of evenly chosen pairs, one per row: target, background, composite."""
    count = len(folder.pairs)
    chosen = [round(i * (count - 1) / max(rows - 1, 1)) for i in range(min(rows, count))]
    lines = []
    for index in chosen:
        pair = folder.pairs[index].read()
        height = round(width * pair.target.shape[0] / pair.target.shape[1])
        pictures = (pair.target, pair.background, pair.composite)
        lines.append(torch.cat([resize(picture, width, height) for picture in pictures], 1))
    tallest = max(line.shape[0] for line in lines)
    return torch.cat([torch.cat([line, torch.ones(tallest - line.shape[0], *line.shape[1:])]) for line in lines])


def _generate_one(out: Path, plan: SamplePlan, lighting: Lighting) -> int:
    """Generate a sample; return 1 if it was written, 0 if it was rejected."""
    unrelit = plan.make()
    covered = float((unrelit.mask > 0.5).float().mean())
    if not _MIN_COVERED <= covered <= _MAX_COVERED:
        note = {**plan.record, "reason": f"object covers {covered:.1%} of the picture"}
        with atomic_write(out / _REJECTED / f"{plan.name}.json") as stream:
            stream.write((json.dumps(note) + "\n").encode())
        return 0
    maps = lighting.choose(plan.name)
    relit = lighting.relighter.relight(unrelit.target, unrelit.mask, maps)
    record = {
        **plan.record,
        "group": plan.group,
        "relighter": lighting.relighter.name,
        "relighter_licence": lighting.relighter.licence,
        "lights": [path.name for path in maps],
    }
    write_sample(out / plan.name, replace(unrelit, relit=relit), record)
    return 1


@dataclass(frozen=True)
class RelightingOptions:
    """Relighter and environment maps."""

    lights: Path = Path("lights")
    """Folder with .hdr environment maps."""
    each: int = 4
    """Number of lights per image."""
    relighter: Literal["diffusion-renderer", "stand-in"] = "diffusion-renderer"
    """Relighter: the paper's DiffusionRenderer in your own installation, or a stand-in without a learned model."""
    renderer: Path | None = None
    """Folder of DiffusionRenderer's code."""
    renderer_python: Path | None = None
    """Python that runs DiffusionRenderer; default: the current one."""

    def open(self, seed: int) -> Lighting:
        """Prepare the relighter and list the maps; `seed` determines which maps a sample gets."""
        maps = sorted(self.lights.glob("*.hdr")) if self.lights.is_dir() else []
        if not maps:
            raise ValueError(f"{self.lights}: expected a folder with .hdr environment maps (--lights), found none")
        if self.relighter == "stand-in":
            return Lighting(StandInRelighter(), maps, self.each, seed)
        if self.renderer is None:
            raise ValueError(
                "--renderer: expected the folder of DiffusionRenderer's code, found none; or --relighter stand-in"
            )
        renderer = DiffusionRenderer(self.renderer, self.renderer_python or Path(sys.executable))
        return Lighting(renderer, maps, self.each, seed)


_PIPELINE_BYTES = 36 << 30  # estimated GPU memory of bf16 FLUX with both text encoders and activations


def text_to_image_pipeline(base: str) -> Any:
    """Load the stock FLUX pipeline with its text encoders in bfloat16; needs transformers."""
    try:
        return diffusers_library().FluxPipeline.from_pretrained(hub_id(base), torch_dtype=torch.bfloat16)
    except OSError as error:
        raise ValueError(f"{base}: expected a FLUX pipeline with its text encoders, found {one_line(error)}") from error


def load_painter(
    base: str, device: torch.device, size: tuple[int, int], say: Callable[[str], None]
) -> Callable[[str, int], Float[Tensor, "h w 3"]]:
    """Load FLUX and return a function that paints a prompt with a seed, sRGB in [0, 1]; `size` is width and height.

    If GPU memory does not suffice, parts of the pipeline move to the GPU in turn.
    """
    pipeline = text_to_image_pipeline(base)
    if device.type == "cuda" and torch.cuda.mem_get_info(device)[0] < _PIPELINE_BYTES:
        say("text to image: GPU memory is too small for all parts, so they move to the GPU in turn, which is slower")
        pipeline.enable_model_cpu_offload()
    else:
        pipeline.to(device)

    def paint(prompt: str, seed: int) -> Float[Tensor, "h w 3"]:
        image = pipeline(
            prompt,
            width=size[0],
            height=size[1],
            num_inference_steps=4,
            guidance_scale=1.0,
            generator=torch.Generator().manual_seed(seed),
        ).images[0]
        return torch.from_numpy(np.array(image.convert("RGB"))).float() / 255

    return paint


INDEX_FILE = "index.csv"
COLUMNS = ("image", "mask", "background", "object", "scene")
LICENCE = "ORIDa, see its own terms"


@dataclass(frozen=True)
class Photograph:
    """One photo of an object in a scene."""

    image: Path
    mask: Path
    background: Path
    """The scene without the object."""
    object: str
    scene: str

    @property
    def name(self) -> str:
        """Unique name of a folder."""
        return f"{self.object}_{self.scene}_{self.image.stem}".replace("/", "-")


def read_orida(root: Path) -> list[Photograph]:
    """List all photos of an index.csv with the columns image, mask, background (files), object and scene."""
    path, found = root / INDEX_FILE, []
    if not path.is_file():
        raise ValueError(f"{path}: expected a table with the columns {', '.join(COLUMNS)}, found no file")
    with path.open(newline="", encoding="utf-8") as stream:
        reader = csv.DictReader(stream)
        if missing := [name for name in COLUMNS if name not in (reader.fieldnames or ())]:
            raise ValueError(f"{path}: expected the columns {', '.join(COLUMNS)}, found no {missing[0]}")
        for number, row in enumerate(reader, 2):
            files = [path.parent / (row[name] or "?") for name in COLUMNS[:3]]
            if absent := next((file for file in files if not file.is_file()), None):
                raise ValueError(f"{path}, line {number}: expected existing files, found no {absent}")
            image, mask, background = files
            found.append(Photograph(image, mask, background, row["object"], row["scene"]))
    return sorted(found, key=lambda photograph: photograph.name)


def choose_balanced(photographs: list[Photograph], count: int, seed: int) -> list[Photograph]:
    """Choose at most `count` photos, balanced by object and scene."""
    queues: dict[tuple[str, str], list[Photograph]] = defaultdict(list)
    for photograph in photographs:
        queues[photograph.object, photograph.scene].append(photograph)
    for key, queue in queues.items():
        random.Random(f"orida-{seed}-{key}").shuffle(queue)
    chosen: list[Photograph] = []
    objects: dict[str, int] = defaultdict(int)
    scenes: dict[str, int] = defaultdict(int)
    number = 0
    while len(chosen) < count and any(queues.values()):
        keys = sorted(key for key, queue in queues.items() if queue)
        random.Random(f"orida-{seed}-round-{number}").shuffle(keys)
        number += 1
        while keys and len(chosen) < count:
            key = min(keys, key=lambda pair: (objects[pair[0]], scenes[pair[1]]))
            keys.remove(key)
            chosen.append(queues[key].pop())
            objects[key[0]] += 1
            scenes[key[1]] += 1
    return chosen
