"""Compare weights of the loss on surfaces (`fitting/surface_loss.py`) over rendered training scenes.

    python benchmarks/fit_surfaces.py FOLDER [FOLDER ...] [--bare FOLDER] [--names PART ...]

FOLDER and --bare as in benchmarks/geometry.py. Each row is the mean over scenes of reconstructions at `standard` with
one weight: none, and half, once and twice the present one.
"""

import argparse
from functools import partial
from pathlib import Path
from unittest import mock

from geometry import Row, bare_scenes, exam_scenes, measure

from splatgraft.fitting.surface_loss import SurfaceLoss
from splatgraft.reconstruction import ReconstructOptions

_CHOICES = {"none": 0.0, "half": 0.5, "present": 1.0, "double": 2.0}  # factors on the present weight
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
        chosen = partial(SurfaceLoss, weight=_CHOICES[name] * SurfaceLoss(unit=1.0).weight)
        with mock.patch("splatgraft.reconstruction.training.SurfaceLoss", chosen):
            print(f"| {name} | {_mean([measure(case, how)[0] for case in cases])} |", flush=True)


if __name__ == "__main__":
    main()
