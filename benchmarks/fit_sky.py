"""Fit the sun under a clear sky to the true lights of rendered outdoor scenes: strength, tint, error of its height.

    python benchmarks/fit_sky.py SCENES [SCENES ...] --work FOLDER [FOLDER ...]

SCENES are folders of scenes that `splatgraft paper exam` rendered. The ratio of the sun's irradiance on level ground to
that of all other light is taken as proportional to the sine of the sun's height: the direct light is about constant,
and so is the sky's. Scenes with a ratio below `_HAZY` have clouds and are only listed.

The error of the height is the one with which the true suns are likeliest by the skies that the views show: the log
density of the true sun over an even one, mean over the skies that count as clear.
"""

import math
import statistics
from unittest import mock

import torch
from exam_scenes import is_outdoors, scene_arguments, scenes_in
from torch import Tensor

from splatgraft.core.images import LUMINANCE
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.light.light import Light
from splatgraft.relighting.light.sky import SkyEvidence, suns_above

_HAZY = 2.0
_UP = torch.tensor([[0.0, 0.0, 1.0]])
_ERRORS_DEG = (0.1, 5.0, 10.0, 12.0, 15.0, 18.0, 25.0)


def strength_and_tint(name: str, light: Light) -> tuple[float, Tensor] | None:
    """Print a light's ratio of sun to sky on level ground; return ratio / sine and tint, None if it is hazy."""
    sun = max(light.sources, key=lambda one: one.luminance)
    sine = sun.direction[2]
    direct = torch.tensor(sun.irradiance) * max(sine, 0.0)
    ratio = direct / (light.irradiance(_UP)[0] - direct)
    gray = float((direct @ LUMINANCE) / ((light.irradiance(_UP)[0] - direct) @ LUMINANCE))
    height = math.degrees(math.asin(sine))
    print(f"{name:16s} height {height:4.1f}   ratio {gray:5.2f}   over sine {gray / sine:5.2f}")
    return (gray / sine, ratio / gray) if gray > _HAZY else None


def log_score(sky: SkyEvidence, sun: Tensor, error_deg: float) -> float:
    """Return the log density of the sun's true direction, over that of an even one, with an error of its height."""
    suns = suns_above(sky.up)
    with mock.patch("splatgraft.relighting.light.sky._HEIGHT_SD_DEG", error_deg):
        log_density = sky.log_density(suns).log_softmax(0) + math.log(len(suns))
    return float(log_density[(suns @ sun).argmax()])


def main() -> None:
    """Fit and print."""
    constants, tints, scores = [], [], []
    for name, read in scenes_in(scene_arguments(__doc__).parse_args()):
        if not is_outdoors(name):
            continue
        scene = read()
        found = strength_and_tint(name, scene.new_light)
        if found is not None:
            constants.append(math.log(found[0]))
            tints.append(found[1])
        sky = SkyEvidence.of(CapturedScene(scene.composite.target, scene.cameras))
        if sky.is_clear:
            sun = torch.tensor(max(scene.new_light.sources, key=lambda one: one.luminance).direction)
            scores.append([log_score(sky, sun, error) for error in _ERRORS_DEG])
    tint = torch.stack(tints).mean(0).tolist()
    print(f"{len(constants)} clear skies: ratio {math.exp(statistics.mean(constants)):.1f} times the sine", end=", ")
    print(f"standard deviation of its logarithm {statistics.stdev(constants):.2f}, tint {[round(x, 2) for x in tint]}")
    print(f"log density of the true sun, mean of {len(scores)} skies seen as clear, by the height's error in degrees:")
    means = map(statistics.mean, zip(*scores, strict=True))
    print(", ".join(f"{error:g}: {mean:.2f}" for error, mean in zip(_ERRORS_DEG, means, strict=True)))


if __name__ == "__main__":
    main()
