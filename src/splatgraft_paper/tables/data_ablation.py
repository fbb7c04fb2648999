"""The paper's Table 3: measures trained harmonisers on the test split of each source of training pairs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from splatgraft.fitting.perceptual_losses import lpips_vgg
from splatgraft.harmonization import FluxOptions, HarmonizerContext, HarmonizerInputs, make_harmonizer
from splatgraft.project.step import Device, choose_device
from splatgraft.runtime.console import Console
from splatgraft.runtime.lazy_sequence import LazySequence
from splatgraft_paper.benchmark.image_features import frechet_distance, inception_features
from splatgraft_paper.tables.measure_pictures import measure_picture
from splatgraft_paper.training.pairs import DataOptions, TrainingPair, crop_pair_to_size, open_training_data

SOURCES = {"pairs": "Blender", "generated": "FLUX", "orida": "ORIDa"}
"""The paper's name of each source, by the source's option."""


@dataclass(frozen=True)
class DataAblation:
    """Models, sources and metrics of Table 3."""

    models: Mapping[str, Path]
    """Folders that `paper train flux` wrote, by the paper's name of the row."""
    data: DataOptions
    """Sources; their held-out scenes are the test split."""
    seed: int = 0
    """Seed of the trainings, which determines the held-out scenes."""
    weights: Path | None = None
    """Folder with the weights of LPIPS and Inception."""
    metrics: frozenset[str] = frozenset({"psnr", "ssim", "lpips", "fid"})
    """Metrics to measure; weights of all must exist."""
    device: Device = "auto"


def measure_models(run: DataAblation, console: Console) -> dict[str, dict[str, float]]:
    """Measure each model: `psnr Blender`, .., `fid ORIDa`, and the means over the sources, `psnr Average`, ...

    Raises:
        ValueError: A source has no held-out scene, or a model cannot be loaded.
    """
    tests = {name: _test_split(run, option) for option, name in SOURCES.items() if getattr(run.data, option)}
    if not tests:
        raise ValueError("--models: expected test pairs by --pairs, --generated or --orida, found none")
    perceptual = lpips_vgg(run.weights) if "lpips" in run.metrics else None
    features = inception_features(run.weights) if "fid" in run.metrics else None
    device, found = choose_device(run.device, console), {}
    for model, folder in run.models.items():
        context = HarmonizerContext(device=device, say=console.say, views=sum(map(len, tests.values())))
        harmonizer = make_harmonizer(FluxOptions(weights=str(folder)), context)
        values: dict[str, float] = {}
        for source, pairs in tests.items():
            rows, of_made, of_target = [], [], []
            for pair in pairs:
                made = harmonizer.harmonize(_view_of(pair)).cpu()
                rows.append(measure_picture(made, pair.target, perceptual))
                if features is not None:
                    of_made.append(features([made]))
                    of_target.append(features([pair.target]))
            for metric in run.metrics - {"fid"}:
                values[f"{metric} {source}"] = sum(row[metric] for row in rows) / len(rows)
            if features is not None:
                values[f"fid {source}"] = frechet_distance(np.concatenate(of_made), np.concatenate(of_target))
            console.say(f"{model}, {source}: {values[f'psnr {source}']:.2f} dB on {len(pairs)} pairs")
        for metric in run.metrics:
            values[f"{metric} Average"] = sum(values[f"{metric} {source}"] for source in tests) / len(tests)
        found[model] = values
    return found


def _test_split(run: DataAblation, option: str) -> Sequence[TrainingPair]:
    """List the held-out pairs of one source at the size of the trainings; pairs are read on access."""
    alone = replace(run.data, **{other: () for other in SOURCES if other != option}, weights=())
    opened = open_training_data(alone, run.seed, None)
    if opened.held_out is None:
        raise ValueError(f"--{option}: expected at least two scenes, one of which is held out, found one")
    files, width, height = opened.held_out.all(), opened.width, opened.height
    return LazySequence(len(files), lambda index: crop_pair_to_size(files[index].read(), width, height))


def _view_of(pair: TrainingPair) -> HarmonizerInputs:
    nothing = torch.zeros_like(pair.mask)
    return HarmonizerInputs(pair.composite, pair.background, pair.mask, nothing, pair.composite)
