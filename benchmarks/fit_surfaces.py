"""Compares weights of the losses on surfaces (`fitting/surface_loss.py`) over rendered training scenes.

    python benchmarks/fit_surfaces.py FOLDER [FOLDER ...] [--bare FOLDER] [--names PART ...]

FOLDER and --bare as in benchmarks/geometry.py. Each row is the mean over scenes of reconstructions at `standard` with
one choice of weights: the present one, with each term left out, and with each number halved and doubled.
"""

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest import mock

from geometry import Row, bare_scenes, exam_scenes, measure

from splatgraft.fitting.surface_loss import SurfaceLoss
from splatgraft.reconstruction import ReconstructOptions

_PRESENT = SurfaceLoss(unit=1.0)
_CHOICES = {
    "neither": replace(_PRESENT, spread=0.0, bend=0.0),
    "bend alone": replace(_PRESENT, spread=0.0),
    "spread alone": replace(_PRESENT, bend=0.0),
    "present": _PRESENT,
    "spread halved": replace(_PRESENT, spread=_PRESENT.spread / 2),
    "spread doubled": replace(_PRESENT, spread=2 * _PRESENT.spread),
    "bend halved": replace(_PRESENT, bend=_PRESENT.bend / 2),
    "bend doubled": replace(_PRESENT, bend=2 * _PRESENT.bend),
    "spread from the start": replace(_PRESENT, spread_from=0.1),
    "spread later": replace(_PRESENT, spread_from=0.7),
}
_COLUMNS = ("near_off", "near_error", "all_off", "near_normal_deg", "psnr_held_out", "psnr_fitted", "cpu_seconds")


def _mean(rows: list[Row]) -> str:
    return " | ".join(f"{sum(getattr(row, name) for row in rows) / len(rows):.4g}" for name in _COLUMNS)


def main() -> None:
    """Print a table, a row per choice as soon as it is measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="*", help="folders of scenes/ and renders/ of an exam")
    parser.add_argument("--bare", type=Path, help="folder of rendered bare tables")
    parser.add_argument("--names", nargs="+", default=[""], help="parts of names; only such scenes are measured")
    parser.add_argument("--choices", nargs="+", default=list(_CHOICES), choices=list(_CHOICES), help="rows to measure")
    options = parser.parse_args()
    cases = [case for folder in options.scenes for case in exam_scenes(folder)]
    cases += bare_scenes(options.bare) if options.bare else []
    cases = [case for case in cases if any(part in case.name for part in options.names)]
    how = ReconstructOptions(iterations=1000, budget=20_000)
    print("| choice | " + " | ".join(_COLUMNS) + " |\n" + "| --- |" + " ---: |" * len(_COLUMNS))
    for name in options.choices:
        chosen = partial(replace, _CHOICES[name])
        with mock.patch("splatgraft.reconstruction.training.SurfaceLoss", chosen):
            print(f"| {name} | {_mean([measure(case, how)[0] for case in cases])} |", flush=True)


if __name__ == "__main__":
    main()
