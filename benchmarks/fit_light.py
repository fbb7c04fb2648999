"""Fit the parameters of the light estimate over rendered scenes with known light, and cross-validate them.

    python benchmarks/fit_light.py SCENES [SCENES ...] --work FOLDER [FOLDER ...] --evidence FOLDER

SCENES are folders of scenes as `splatgraft paper exam` renders them. The objective, in stops, has two terms. The first
is the RMS over 200 normals of log2(estimated / true irradiance), averaged over the places. The second is half of the
same RMS for the ratio of both places.

1. Estimate the evidence at both places of each scene, and keep it in files (`--evidence`) for later runs.
2. Change one to three parameters by random factors; keep the change if the objective falls.
3. With `--folds N`, repeat this N times without one part of the scenes, and print the objective of that part.
4. Print the error of the level, which is `shading.LEVEL_ERROR_STOPS`, and whether a regression would reduce it.
"""

import json
import math
import multiprocessing
import random
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TypeAlias

import torch
from exam_scenes import scene_arguments, scenes_in
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.bounds import bounding_sphere
from splatgraft.core.directions import even_directions
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.light.estimate import EstimatedLight, estimate_light
from splatgraft.relighting.light.light import Light
from splatgraft.relighting.light.panorama import NoLight
from splatgraft.relighting.light.radiance_model import LightEvidence, RadianceSettings, radiance_problem
from splatgraft.relighting.light.radiance_search import irradiance_of, search_radiance
from splatgraft_paper.exam.scenes import ExamScene

NORMALS = even_directions(200)
FACTORS = {
    "albedo": 1.3,
    "albedo_outdoors": 1.3,
    "albedo_sd": 1.4,
    "materials": 1.7,
    "residual": 1.3,
    "effective": 1.6,
    "near": 1.4,
    "highlights": 1.6,
    "sky_sd": 1.4,
    "unseen_sd": 1.4,
    "unseen_nu": 1.3,
    "source": 1.6,
    "source_sd": 1.4,
    "surface": 1.8,
    "surface_sd": 1.4,
    "within_patch_sd": 1.6,
    "temperature": 1.6,
}
"""Standard deviation of each parameter's random factor."""
SHIFTS = {"sky_bias": 0.3}
"""Standard deviation of the random shift of a parameter that may be negative."""


@dataclass(frozen=True)
class TrainingPlace:
    """Evidence and true irradiance at one of a scene's two places."""

    evidence: LightEvidence
    truth: Float[Tensor, "200"]
    """Gray irradiance on `NORMALS`."""


Pair: TypeAlias = tuple[TrainingPlace, TrainingPlace]
"""The new and the old place of a scene."""


def places_of(scene: ExamScene) -> Pair:
    """Collect the evidence at the new and the old place from the reconstructions alone."""
    placed, source = scene.composite.objects[0], scene.source
    there, thing = bounding_sphere(placed.gaussians), placed.gaussians
    new = estimate_light(CapturedScene(scene.composite.target, scene.cameras), bounding_sphere(placed.in_target()))
    old = estimate_light(CapturedScene(source.gaussians, source.cameras), there, object_gaussians=thing)
    return _place(new, scene.new_light), _place(old, scene.old_light)


def _place(found: EstimatedLight | NoLight, truth: Light) -> TrainingPlace:
    if isinstance(found, NoLight):
        raise ValueError(f"expected light at both places, found none: {found.reason}")
    return TrainingPlace(found.evidence, truth.irradiance(NORMALS).mean(1))


def log_irradiance(place: TrainingPlace, numbers: dict[str, float]) -> Float[Tensor, "200"]:
    """Estimate the binary logarithm of gray irradiance on `NORMALS`."""
    problem = radiance_problem(place.evidence, settings=RadianceSettings(**numbers))
    radiance = search_radiance(problem).radiance(place.evidence)
    return irradiance_of(radiance.mean(1), NORMALS).clamp_min(1e-6).log2()


def scene_errors(pair: Pair, numbers: dict[str, float]) -> list[float]:
    """Compute the RMS errors, stops, at the new place, at the old one, and of their ratio."""
    away = [log_irradiance(place, numbers) - place.truth.log2() for place in pair]
    return [float(e.pow(2).mean().sqrt()) for e in (*away, away[0] - away[1])]


def levels(pair: Pair, numbers: dict[str, float]) -> list[list[float]]:
    """Compute estimated and true level at both places: mean of log2(irradiance) over `NORMALS`, stops."""
    found = [(log_irradiance(place, numbers), place.truth.log2()) for place in pair]
    return [[float(values.mean()) for values in both] for both in found]


def level_line(values: Float[Tensor, "s 2 2"]) -> str:
    """Describe the error of the level, and that of scenes left out from a regression of true on estimated levels."""
    estimated, true = values.unbind(2)

    def line(kept: Tensor) -> Tensor:
        columns = torch.stack([estimated[kept].flatten(), torch.ones(2 * len(kept))], 1)
        return torch.linalg.lstsq(columns, true[kept].flatten()[:, None]).solution[:, 0]

    everything = torch.arange(len(values))
    share = float(line(everything)[0])
    left_out = []
    for i in range(len(values)):
        slope, shift = line(everything[everything != i])
        left_out.append(slope * estimated[i] + shift - true[i])
    before, after = (float(e.pow(2).mean().sqrt()) for e in (estimated - true, torch.stack(left_out)))
    return f"level: error {before:.2f} stops, {after:.2f} by a regression on the other scenes (share {share:.2f})"


class Scenes:
    """Scenes whose errors several processes compute; these inherit the evidence."""

    def __init__(self, pairs: dict[str, Pair], jobs: int) -> None:
        """Start `jobs` processes."""
        self.names = list(pairs)
        self._pairs = list(pairs.values())
        self._pool = multiprocessing.get_context("fork").Pool(jobs, _start, (self._pairs,))

    def levels(self, numbers: dict[str, float]) -> Float[Tensor, "s 2 2"]:
        """Compute `levels` of all scenes."""
        return torch.tensor(self._pool.starmap(_levels_of, [(i, numbers) for i in range(len(self.names))], chunksize=1))

    def errors(self, numbers: dict[str, float], which: Sequence[int] | None = None) -> Float[Tensor, "s 3"]:
        """Compute `scene_errors` of some scenes, or of all."""
        which = range(len(self.names)) if which is None else which
        return torch.tensor(self._pool.starmap(_errors_of, [(i, numbers) for i in which], chunksize=1))


_INHERITED: list[Pair] = []


def _start(pairs: list[Pair]) -> None:
    torch.set_num_threads(1)
    _INHERITED[:] = pairs


def _errors_of(index: int, numbers: dict[str, float]) -> list[float]:
    return scene_errors(_INHERITED[index], numbers)


def _levels_of(index: int, numbers: dict[str, float]) -> list[list[float]]:
    return levels(_INHERITED[index], numbers)


def objective(found: Float[Tensor, "s 3"]) -> float:
    """Compute the objective over some scenes' errors, stops."""
    return float(0.5 * found[:, :2].sum(1).mean() + 0.5 * found[:, 2].mean())


def fit(
    scenes: Scenes, which: Sequence[int], numbers: dict[str, float], names: Sequence[str], *, minutes: float, seed: int
) -> dict[str, float]:
    """Search the best values of the parameters `names` for some scenes at random, for `minutes`.

    A change that is worse on half of the scenes is not tried on the others.
    """
    rng, end = random.Random(seed), time.monotonic() + 60 * minutes
    first, rest = list(which[::2]), list(which[1::2])
    known = [scenes.errors(numbers, part) for part in (first, rest)]
    best = objective(torch.cat(known))
    print(f"start {best:.3f}", flush=True)
    while time.monotonic() < end:
        changed = dict(numbers)
        for name in rng.sample(names, min(rng.choice([1, 1, 2, 3]), len(names))):
            if name in SHIFTS:
                changed[name] = round(numbers[name] + rng.gauss(0, SHIFTS[name]), 3)
            else:
                changed[name] = float(f"{numbers[name] * math.exp(rng.gauss(0, math.log(FACTORS[name]))):.3g}")
        found = [scenes.errors(changed, first)]
        if objective(found[0]) > objective(known[0]) + 0.01:  # stops
            continue
        found.append(scenes.errors(changed, rest))
        value = objective(torch.cat(found))
        if value < best:
            moved = {name: v for name, v in changed.items() if v != numbers[name]}
            best, numbers, known = value, changed, found
            print(f"{best:.4f} {moved}", flush=True)
    return numbers


def main() -> None:
    """Fit and print."""
    parser = scene_arguments(__doc__)
    parser.add_argument("--evidence", type=Path, required=True, help="folder for the evidence of each scene")
    parser.add_argument("--jobs", type=int, default=2, help="number of processes")
    parser.add_argument("--minutes", type=float, default=10.0, help="time of each fit; 0 measures today's parameters")
    parser.add_argument("--folds", type=int, default=0, help="number of parts of the cross-validation; 0: none")
    parser.add_argument("--out", type=Path, help="file that receives the parameters as JSON")
    parser.add_argument("--seed", type=int, default=0)
    names = [*FACTORS, *SHIFTS]
    parser.add_argument("--names", nargs="+", choices=names, default=names, help="parameters that are fitted")
    parser.add_argument("--start", type=Path, help="parameters to start from, a file of --out")
    options = parser.parse_args()
    pairs = {}
    for name, read in scenes_in(options):
        kept = options.evidence / f"{name}.pt"
        if not kept.is_file():
            kept.parent.mkdir(parents=True, exist_ok=True)
            torch.save(places_of(read()), kept)
        pairs[name] = torch.load(kept, weights_only=False)
    scenes = Scenes(pairs, options.jobs)
    everything = range(len(pairs))
    numbers = {name: value for name, value in asdict(RadianceSettings()).items() if name in (*FACTORS, *SHIFTS)}
    if options.start is not None:
        numbers |= json.loads(options.start.read_text(encoding="utf-8"))
    for fold in range(options.folds):
        inside = [i for i in everything if i % options.folds != fold]
        outside = [i for i in everything if i % options.folds == fold]
        found = fit(scenes, inside, numbers, options.names, minutes=options.minutes, seed=options.seed + fold)
        print(f"fold {fold}: fitted {objective(scenes.errors(found, inside)):.3f}", end=" ")
        left = [objective(scenes.errors(one, outside)) for one in (found, numbers)]
        print(f"left out {left[0]:.3f} (before {left[1]:.3f}) {json.dumps(found)}", flush=True)
    found = fit(scenes, everything, numbers, options.names, minutes=options.minutes, seed=options.seed)
    rows = scenes.errors(found)
    for name, row in zip(scenes.names, rows, strict=True):
        print(f"{name:20s} new {row[0]:.2f} old {row[1]:.2f} ratio {row[2]:.2f}")
    print(f"objective {objective(rows):.3f}, means {[round(v, 3) for v in rows.mean(0).tolist()]}")
    print(level_line(scenes.levels(found)))
    print(json.dumps(found))
    if options.out is not None:
        options.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
