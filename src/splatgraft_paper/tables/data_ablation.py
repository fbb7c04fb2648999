"""The paper's Table 3: measures trained harmonisers on the test split of each source of training pairs.

The test split is the one that the trainings held out, which is stored with their weights. Each model's pictures of each
source are a step, and their metrics another one, so a killed run continues with the next picture.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch

from splatgraft.harmonization import FluxOptions, HarmonizerInputs, NoneOptions
from splatgraft.project.layout import METRICS_FILE
from splatgraft.project.step import Device
from splatgraft.runtime.console import Console
from splatgraft_paper.benchmark.scene import perform_if_stale
from splatgraft_paper.synthesis.jobs import parse_image_size
from splatgraft_paper.tables.harmonize_pictures import HarmonizePictures
from splatgraft_paper.tables.measure_pictures import MeasurePictures, MetricOptions, pooled_distances
from splatgraft_paper.training.pairs import (
    SPLIT_FILE,
    DataOptions,
    PairFiles,
    Role,
    Split,
    crop_pair_to_size,
    held_out_groups,
    open_source,
    read_split,
)

SOURCES = {"pairs": "Blender", "generated": "FLUX", "orida": "ORIDa"}
"""The paper's name of each source, by the source's option."""
_METRICS = ("psnr", "ssim", "lpips", "fid")
_PRIORS: tuple[Role, Role] = ("target", "composite")  # `NoneOptions` returns the prior


@dataclass(frozen=True)
class DataAblation:
    """Models, sources and metrics of Table 3."""

    models: Mapping[str, Path]
    """Folders that `paper train flux` wrote, by the paper's name of the row."""
    data: DataOptions
    """Sources; `held_out` is the share of their scenes to test on if no model has a record of its own."""
    out: Path
    """Folder of all results."""
    metrics: MetricOptions
    device: Device = "auto"


@dataclass(frozen=True)
class MeasuredModels:
    """Table 3."""

    values: Mapping[str, Mapping[str, float]]
    """Metrics by model: `psnr Blender`, .., `fid ORIDa`, and means over the sources, `psnr Average`, ..."""
    notes: tuple[str, ...] = ()
    """Models whose training is not known, one sentence each."""


@dataclass(frozen=True)
class _PairPicture:
    """A pair whose prior is one of its images."""

    files_of: PairFiles
    size: tuple[int, int]
    """Width and height of the trainings, pixels."""
    prior: Role = "composite"

    @property
    def files(self) -> tuple[Path, ...]:
        """Files of the pair."""
        return self.files_of.files("composite")

    def read(self) -> HarmonizerInputs:
        """Read the pair at the size of the trainings."""
        pair = crop_pair_to_size(self.files_of.read(), *self.size)
        nothing = torch.zeros_like(pair.mask)
        return HarmonizerInputs(pair.composite, pair.background, pair.mask, nothing, pair.picture(self.prior))


def measure_models(run: DataAblation, console: Console) -> MeasuredModels:
    """Measure each model on each source; results of earlier runs are kept.

    Raises:
        ValueError: Models held out different scenes, a source lacks them, or a model cannot be loaded.
    """
    splits = {name: read_split(folder) for name, folder in run.models.items()}
    size = parse_image_size(run.data.size, multiple_of=16)
    given = {option: folders for option in SOURCES if (folders := getattr(run.data, option))}
    tests = {option: _test_pairs(option, folders, splits, run.data) for option, folders in given.items()}
    if not tests:
        raise ValueError("--models: expected test pairs by --pairs, --generated or --orida, found none")
    found: dict[str, dict[str, float]] = {}
    for model, folder in run.models.items():
        values: dict[str, float] = {}
        for option, pairs in tests.items():
            at = run.out / model.replace("/", "-")
            names = tuple(f"{index:05d}" for index in range(len(pairs)))
            targets, inputs = (tuple(_PairPicture(pair, size, prior) for pair in pairs) for prior in _PRIORS)
            truth = HarmonizePictures(targets, names, NoneOptions(), run.out / "targets" / option, run.device)
            made = HarmonizePictures(inputs, names, FluxOptions(weights=str(folder)), at / option, run.device)
            folders = (made.out / "images", truth.out / "images")
            measure = MeasurePictures(*folders, at / f"{option}_metrics", run.metrics, all_views=True)
            for step in (truth, made, measure):
                perform_if_stale(step, console)
            read = json.loads((measure.out / METRICS_FILE).read_text(encoding="utf-8"))["values"]
            read |= pooled_distances({option: [measure]}).get(option, {})
            values |= {f"{name} {SOURCES[option]}": read[name] for name in _METRICS if name in read}
            console.say(f"{model}, {SOURCES[option]}: {read['psnr']:.2f} dB on {len(pairs)} pairs")
        for metric in _METRICS:
            over = [values[key] for option in tests if (key := f"{metric} {SOURCES[option]}") in values]
            values |= {f"{metric} Average": sum(over) / len(over)} if over else {}
        found[model] = values
    unknown = [
        f"{name}: {run.models[name]} has no {SPLIT_FILE}, so it may have been trained on the test pairs."
        for name, split in splits.items()
        if split is None
    ]
    return MeasuredModels(found, tuple(unknown))


def _test_pairs(
    option: str, given: tuple[str, ...], splits: Mapping[str, Split | None], data: DataOptions
) -> tuple[PairFiles, ...]:
    """List the pairs of the scenes that the models held out of one source."""
    folders = open_source(option, given)
    recorded = {name: split[option] for name, split in splits.items() if split is not None and option in split}
    if not recorded:
        groups = [held_out_groups(folder, data.held_out) for folder in folders]
        if not any(groups):
            raise ValueError(f"--{option}: expected at least two scenes, one of which is held out, found one")
    else:
        (first, one), *others = recorded.items()
        if differing := next((name for name, other in others if other != one), None):
            raise ValueError(
                f"--models: expected models that held out the same scenes of --{option}, found {first} and {differing} "
                f"with others ({SPLIT_FILE})"
            )
        if len(one) != len(folders):
            raise ValueError(f"--{option}: expected {len(one)} folders as {first} was trained on, found {len(folders)}")
        groups = [frozenset(part["held_out"]) for part in one]
        for folder, wanted in zip(folders, groups, strict=True):
            if missing := sorted(wanted - folder.groups):
                raise ValueError(
                    f"--{option} {folder.name}: expected the scenes that {first} held out, found no {missing[0]} "
                    f"({len(missing)} of {len(wanted)} are missing)"
                )
    chosen = zip(folders, groups, strict=True)
    pairs = tuple(pair for folder, wanted in chosen for pair in folder.pairs if pair.group in wanted)
    if not pairs:
        raise ValueError(f"--{option}: expected held-out scenes, found none (--held-out 0 in training)")
    return pairs
