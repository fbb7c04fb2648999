"""Fit the numbers of the object's shading over rendered scenes, and cross-validate them.

`python benchmarks/fit_shading.py SCENES [SCENES ...] --work FOLDER [FOLDER ...]`. `splatgraft paper exam` renders the
scenes. The objective is the mean gain of the object's PSNR over pasting on the held-out views. Every combination of a
grid is tried. The numbers are also chosen with each scene left out in turn, and the gain of that scene is reported.
Gloss is not fitted. Choose the shares of level and tint on scenes that benchmarks/fit_light.py did not see, because on
its own scenes the light is better than elsewhere.
"""

import itertools
from dataclasses import replace

import torch
from exam_scenes import scene_arguments, scenes_in

from splatgraft.relighting import relight
from splatgraft.relighting.shading import ShadeSettings, shade_ratio
from splatgraft_paper.exam.measure import make_row, measure_row
from splatgraft_paper.exam.scenes import ExamScene

FLOORS = (0.02, 0.08, 0.2)
LEVEL_SHARES = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
TINT_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)


def gains(scene: ExamScene, choices: list[ShadeSettings]) -> list[float]:
    """Return the gain of the object's PSNR over pasting, dB, for each choice."""
    pasted = measure_row(make_row("paste", scene)[0], scene.views)["object"]
    relit = relight(scene.composite, scene.cameras, sources=[scene.source])
    source = relit.prepared[0].source_lighting if relit.prepared else None
    assert pasted is not None
    if source is None:
        return [0.0] * len(choices)
    found = []
    for choice in choices:
        shade = relit.shade.clone()
        opacities = relit.gaussians.opacities[relit.is_object]
        shade[relit.is_object] = shade_ratio(relit.received[0], source.irradiance, opacities, settings=choice)
        value = measure_row(replace(relit, shade=shade).bake()[0], scene.views)["object"]
        assert value is not None
        found.append(value - pasted)
    return found


def main() -> None:
    """Fit and print."""
    options = scene_arguments(__doc__).parse_args()
    grid = itertools.product(FLOORS, LEVEL_SHARES, TINT_SHARES)
    choices = [ShadeSettings(*chosen) for chosen in grid]
    names, rows = [], []
    for name, read in scenes_in(options):
        rows.append(gains(read(), choices))
        names.append(name)
        print(f"{name}: best {max(rows[-1]):+.2f} dB", flush=True)
    table = torch.tensor(rows)
    best = int(table.mean(0).argmax())
    print(f"fitted: {table.mean(0)[best]:+.2f} dB, {choices[best]}")
    left_out = []
    for i in range(len(names)):
        rest = torch.cat([table[:i], table[i + 1 :]]).mean(0)
        left_out.append(float(table[i, rest.argmax()]))
    print(
        f"each scene by the numbers of the others: {sum(left_out) / len(left_out):+.2f} dB, worst {min(left_out):+.2f}"
    )
    today = ShadeSettings()
    for name in ("floor", "level_share", "tint_share"):
        for value in sorted({getattr(choice, name) for choice in choices}):
            alike = [j for j, c in enumerate(choices) if c == replace(choices[best], **{name: value})]
            print(f"{name} {value}: {table.mean(0)[alike[0]]:+.2f} dB (today {getattr(today, name)})")


if __name__ == "__main__":
    main()
