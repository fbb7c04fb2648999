"""The command `paper check-release`: the released weights on the released composites, against the authors' pictures.

It is the one test of the image model that needs no 3D scene. The authors' pictures are renders of consolidated scenes,
so they differ from the model's own pictures by the reconstruction; the composites are what both begin with.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.image_metrics import psnr
from splatgraft.core.images import read_mask, read_rgb, write_image
from splatgraft.evaluation import side_by_side
from splatgraft.harmonization import FluxOptions, HarmonizerInputs
from splatgraft.project.step import Device, locked
from splatgraft.runtime.console import Console
from splatgraft_paper.benchmark.scene import perform_if_stale
from splatgraft_paper.benchmark.table import Table
from splatgraft_paper.tables.harmonize_pictures import HarmonizePictures
from splatgraft_paper.tables.layout import PaperScene, find_scenes, match_views, named_folders, pictures
from splatgraft_paper.tables.report import stacked

_THEIRS = "Ours"  # the paper's name of its method


@dataclass(frozen=True)
class ReleasedPicture:
    """One composite of the data set."""

    composite: Path
    mask: Path
    background: Path | None = None

    @property
    def files(self) -> tuple[Path, ...]:
        """Files of the picture."""
        return (self.composite, self.mask, *(() if self.background is None else (self.background,)))

    def read(self) -> HarmonizerInputs:
        """Read the images; without a background the variant `image-background` cannot be checked."""
        composite, mask = read_rgb(self.composite), read_mask(self.mask)
        if mask.shape != composite.shape[:2]:
            wanted, found = (f"{size[1]}x{size[0]}" for size in (composite.shape, mask.shape))
            raise ValueError(f"{self.mask}: expected {wanted} pixels as {self.composite}, found {found}")
        background = composite if self.background is None else read_rgb(self.background)
        return HarmonizerInputs(composite, background, mask, torch.zeros_like(mask), composite)


@dataclass(frozen=True)
class CheckRelease:
    """Harmonise the authors' composites with their weights and compare with their pictures; return 1 if not nearer."""

    data: Path
    """Folder of the published data set."""
    out: Path = Path("release")
    """Folder for release.md, release.json, sheet.png and the pictures."""
    weights: str = "dot3d"
    """Weights, as `harmonize flux --weights` takes them."""
    views: int = 4
    """Views of each scene, spread evenly."""
    only: tuple[str, ...] = ()
    """Names of scenes; default: all with composite/, masks/ and the authors' pictures."""
    names: tuple[str, ...] = ()
    """ROLE=NAME of what has another name below a scene, as for `paper tables`."""
    device: Device = "auto"

    def execute(self, console: Console) -> int:
        """Harmonise the missing views, and write the comparison."""
        if self.views < 1:
            raise ValueError(f"--views: expected at least 1, found {self.views}")
        scenes = [
            scene
            for scene in find_scenes(self.data, named_folders(self.names))
            if {"composite", "masks"} <= set(scene.folders) and _THEIRS in scene.results
        ]
        scenes = [scene for scene in scenes if not self.only or scene.name in self.only]
        if not scenes:
            raise ValueError(
                f"{self.data}: expected scenes with composite/, masks/ and the authors' pictures, found none"
            )
        rows, sheet = {}, []
        with locked(self.out):
            for scene in scenes:
                values, strips = self._compared(scene, console)
                rows[scene.name], sheet = values, [*sheet, strips[len(strips) // 2]]
                console.say(
                    f"{scene.name}: object {values['object']:.2f} dB, composite {values['object_composite']:.2f} dB"
                )
            self._write(rows, sheet)
        console.result(self.out / "release.md")
        gain = sum(row["object"] - row["object_composite"] for row in rows.values()) / len(rows)
        if gain <= 0:
            console.say(
                f"the harmonised objects are {-gain:.2f} dB further from the authors' pictures than the composites: "
                f"look at {self.out / 'sheet.png'}; variant, order of the inputs, mask and prompt decide"
            )
        return 0 if gain > 0 else 1

    def _compared(self, scene: PaperScene, console: Console) -> tuple[dict[str, float], list[Tensor]]:
        """Measure a scene's pictures against the authors', and return the values and a strip of pictures per view."""
        given = {role: pictures(folder) for role, folder in scene.folders.items()}
        theirs, how = match_views(list(given["composite"]), pictures(scene.results[_THEIRS]))
        stems = [stem for stem in given["composite"] if stem in theirs and stem in given["masks"]]
        if not stems:
            raise ValueError(f"{scene.results[_THEIRS]}: expected pictures of the composites, found {how}")
        places = torch.linspace(0, len(stems) - 1, min(self.views, len(stems))).round().int().tolist()
        chosen = [stems[index] for index in places]
        inputs = tuple(
            ReleasedPicture(given["composite"][stem], given["masks"][stem], given.get("background", {}).get(stem))
            for stem in chosen
        )
        out = self.out / "scenes" / scene.name
        method = FluxOptions(weights=self.weights)
        perform_if_stale(HarmonizePictures(inputs, tuple(chosen), method, out, self.device), console)
        rows, strips = [], []
        for stem, one in zip(chosen, inputs, strict=True):
            view, made, wanted = one.read(), read_rgb(out / "images" / f"{stem}.png"), read_rgb(theirs[stem])
            if wanted.shape != made.shape:
                sizes = (f"{size[1]}x{size[0]}" for size in (made.shape, wanted.shape))
                raise ValueError(f"{theirs[stem]}: expected {next(sizes)} pixels, found {next(sizes)}")
            inside = view.mask > 0.5
            rows.append({
                "whole": float(psnr(made, wanted)),
                "whole_composite": float(psnr(view.composite, wanted)),
                "object": float(psnr(made, wanted, inside)),
                "object_composite": float(psnr(view.composite, wanted, inside)),
                "change": _cosine((made - view.composite)[inside], (wanted - view.composite)[inside]),
            })  # fmt: skip
            shown = [view.composite, made, wanted, (made - wanted).abs()]
            strips.append(side_by_side(shown, [f"{scene.name}: composite", "here", "the authors'", "difference"]))
        return {name: sum(row[name] for row in rows) / len(rows) for name in rows[0]}, strips

    def _write(self, rows: dict[str, dict[str, float]], sheet: Sequence[Tensor]) -> None:
        """Write the table, the values and the sheet."""
        names = (
            "PSNR",
            "PSNR of the composite",
            "object PSNR",
            "object PSNR of the composite",
            "cosine of the changes",
        )
        cells = tuple((name, *(f"{value:.2f}" for value in row.values())) for name, row in rows.items())
        note = f"Weights {self.weights}; against the authors' pictures, which are renders of consolidated scenes."
        self.out.mkdir(parents=True, exist_ok=True)
        (self.out / "release.md").write_text(
            Table("The release's weights on its composites", ("scene", *names), cells, note).markdown() + "\n",
            encoding="utf-8",
        )
        finite = {n: {key: v if math.isfinite(v) else None for key, v in row.items()} for n, row in rows.items()}
        (self.out / "release.json").write_text(json.dumps(finite, indent=1, allow_nan=False), encoding="utf-8")
        write_image(self.out / "sheet.png", stacked(sheet))


def _cosine(one: Float[Tensor, "n 3"], other: Float[Tensor, "n 3"]) -> float:
    """Compute the cosine between two changes of pixels; 1 if the model changes them as the authors' pictures show."""
    return float((one * other).sum() / (one.norm() * other.norm()).clamp_min(1e-6))
