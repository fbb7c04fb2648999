"""Fit the strength of shadows under an estimated light over rendered scenes, and cross-validate it.

`python benchmarks/fit_shadows.py SCENES [SCENES ...] --work FOLDER [FOLDER ...]`. `splatgraft paper exam` renders the
scenes. A light that is averaged over several possibilities has less contrast than the true one, so its shadows are too
weak.

The objective is the removed share of pasting's error. The error is the RMSE of the ratio of luminance with the object
to luminance without the object, over all pixels beside it. A strong shadow in a wrong place therefore costs. Every
power of a grid is tried. The power is also chosen with each scene left out in turn, and the share of that scene is
reported.
"""

from dataclasses import replace

import torch
from exam_scenes import scene_arguments, scenes_in

from splatgraft.core.gaussians import Gaussians
from splatgraft.evaluation.measure import find_regions, luminance_ratio
from splatgraft.relighting import relight
from splatgraft.relighting.cast_shadows import SHADOW_POWER
from splatgraft.relighting.shadows.scene_ratio import SceneRatio
from splatgraft_paper.exam.measure import make_row, measure_row
from splatgraft_paper.exam.scenes import ExamScene

POWERS = (1.0, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6, 1.8, 2.0)


def ratio_error(result: Gaussians, scene: ExamScene) -> float:
    """Return the RMSE of the luminance ratio over all pixels beside the object, mean over views."""
    errors = []
    for view in scene.views:
        truth = view.truth
        apart = luminance_ratio(view.picture(result), view.background) - luminance_ratio(truth.image, truth.background)
        errors.append(float((apart[~find_regions(truth).object] ** 2).mean().sqrt()))
    return sum(errors) / len(errors)


def shares(scene: ExamScene) -> tuple[list[float], list[float]] | None:
    """Return for each power the removed share of the error: beside the object, and in the band of the true shadow.

    Return None if shadows show the sun, because its shadows stay as computed.
    """
    relit = relight(scene.composite, scene.cameras, sources=[scene.source])
    if relit.estimate is not None and relit.estimate.sun is not None:
        return None
    pasted = make_row("paste", scene)[0]
    before, band_before = ratio_error(pasted, scene), measure_row(pasted, scene.views)["shadow"]
    everywhere, band = [], []
    for power in POWERS:
        # the transfer's layers contain today's power
        factor = power / SHADOW_POWER
        ratio = SceneRatio(relit.shadow, relit.bounce, relit.slope).strengthened(factor)
        result = replace(relit, shadow=ratio.shadow, slope=ratio.slope).bake()[0]
        everywhere.append(1 - ratio_error(result, scene) / before)
        found = measure_row(result, scene.views)["shadow"]
        assert found is not None
        assert band_before is not None
        band.append(1 - found / band_before)
    return everywhere, band


def main() -> None:
    """Fit and print."""
    options = scene_arguments(__doc__).parse_args()
    rows, bands = [], []
    for name, read in scenes_in(options):
        found = shares(read())
        if found is None:
            print(f"{name}: the sun is known", flush=True)
            continue
        everywhere, band = found
        rows.append(everywhere)
        bands.append(band)
        best = POWERS[max(range(len(POWERS)), key=everywhere.__getitem__)]
        print(f"{name}: best {best}; {' '.join(f'{share:.3f}' for share in everywhere)}", flush=True)
    table, in_band = torch.tensor(rows), torch.tensor(bands)
    for i, power in enumerate(POWERS):
        print(f"power {power}: removed {table[:, i].mean():.3f}, in the true shadow {in_band[:, i].mean():.3f}")
    best = int(table.mean(0).argmax())
    left_out = [float(table[i, torch.cat([table[:i], table[i + 1 :]]).mean(0).argmax()]) for i in range(len(table))]
    print(f"fitted: power {POWERS[best]}, removed {table.mean(0)[best]:.3f} (1.0: {table[:, 0].mean():.3f})")
    print(f"each scene by the power of the others: removed {sum(left_out) / len(left_out):.3f}")


if __name__ == "__main__":
    main()
