"""Fit the strength and the tint of the sun under a clear sky to the true lights of rendered outdoor scenes.

    python benchmarks/fit_sky.py SCENES [SCENES ...]

SCENES are folders of scenes that `splatgraft paper exam` rendered. The ratio of the sun's irradiance on level ground to
that of all other light is taken as proportional to the sine of the sun's height: the direct light is about constant,
and so is the sky's. Scenes with a ratio below `_HAZY` have clouds and are only listed.
"""

import argparse
import math
import statistics
from pathlib import Path

import torch

from splatgraft.core.images import LUMINANCE
from splatgraft.relighting.light.light import light_from_json
from splatgraft_paper.benchmark.true_light import TRUE_LIGHT_FILE
from splatgraft_paper.synthesis.places import OUTDOORS

_HAZY = 2.0
_UP = torch.tensor([[0.0, 0.0, 1.0]])


def main() -> None:
    """Fit and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", type=Path, nargs="+")
    constants, tints = [], []
    for folder in parser.parse_args().scenes:
        for path in sorted(folder.glob(f"*/{TRUE_LIGHT_FILE}")):
            if not set(OUTDOORS) & set(path.parent.name.split("_")):
                continue
            light = light_from_json(path.read_text(encoding="utf-8"), name=str(path))
            sun = max(light.sources, key=lambda one: one.luminance)
            sine = sun.direction[2]
            direct = torch.tensor(sun.irradiance) * max(sine, 0.0)
            ratio = direct / (light.irradiance(_UP)[0] - direct)
            gray = float((direct @ LUMINANCE) / ((light.irradiance(_UP)[0] - direct) @ LUMINANCE))
            height = math.degrees(math.asin(sine))
            print(f"{path.parent.name:16s} height {height:4.1f}   ratio {gray:5.2f}   over sine {gray / sine:5.2f}")
            if gray > _HAZY:
                constants.append(math.log(gray / sine))
                tints.append(ratio / gray)
    tint = torch.stack(tints).mean(0).tolist()
    print(f"{len(constants)} clear skies: ratio {math.exp(statistics.mean(constants)):.1f} times the sine", end=", ")
    print(f"standard deviation of its logarithm {statistics.stdev(constants):.2f}, tint {[round(x, 2) for x in tint]}")


if __name__ == "__main__":
    main()
