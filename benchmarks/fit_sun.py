"""Count over rendered scenes with known light how often shadows show the right sun, for each candidate bar.

    python benchmarks/fit_sun.py SCENES [SCENES ...] --work FOLDER [FOLDER ...]

SCENES are folders of scenes that `splatgraft paper exam` rendered; both places of each count. A sun is right if it lies
within 5 degrees of the disc of a true source. The source must give a fifth of the irradiance on the surface or more.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from exam_scenes import scene_arguments, scenes_in

from splatgraft.core.bounds import BoundingSphere, bounding_sphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.images import LUMINANCE
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.light.estimate import region_around
from splatgraft.relighting.light.light import Light
from splatgraft.relighting.light.sun import Sun, find_sun
from splatgraft_paper.exam.scenes import ExamScene

_BARS = (15.0, 20.0, 30.0, 40.0, 50.0, 60.0, 80.0)
_NEAR_DEG = 5.0
_STRONG = 0.2


@dataclass(frozen=True)
class Judged:
    """Comparison of a sun found from shadows with the true light."""

    sun: Sun
    off_deg: float
    """Distance to the disc of the nearest strong source, degrees; infinite without one."""
    true_ratio: float
    """Irradiance of all sources within 20 degrees of the sun over that of the rest of the light."""

    @property
    def is_right(self) -> bool:
        """Whether a strong source is near."""
        return self.off_deg < _NEAR_DEG

    @property
    def ratio(self) -> float:
        """Strength that the shadows show."""
        assert self.sun.ratio is not None
        return float(self.sun.ratio @ LUMINANCE)


def judge(sun: Sun, truth: Light) -> Judged:
    """Compare a sun with the true light at its place."""
    whole, off, near = float(truth.irradiance(sun.normal[None])[0] @ LUMINANCE), math.inf, 0.0
    for source in truth.sources:
        direction = torch.tensor(source.direction)
        share = max(0.0, float(direction @ sun.normal)) * source.luminance / whole
        angle = math.degrees(math.acos(max(-1.0, min(1.0, float(direction @ sun.direction)))))
        if share > _STRONG:
            off = min(off, max(0.0, angle - source.angular_radius_deg))
        if angle < 20:
            near += share
    return Judged(sun, off, near / (1 - near))


def places_of(scene: ExamScene) -> Iterator[tuple[str, Gaussians, Cameras, BoundingSphere, Light]]:
    """Yield for both places: suffix of the name, all occluders, the cameras, the place, the true light."""
    placed, source = scene.composite.objects[0], scene.source
    yield "", scene.composite.target, scene.cameras, bounding_sphere(placed.in_target()), scene.new_light
    whole = concatenate([source.gaussians, placed.gaussians])
    yield ", old place", whole, source.cameras, bounding_sphere(placed.gaussians), scene.old_light


def main() -> None:
    """Judge and print."""
    found: list[Judged] = []
    places = 0
    for name, read in scenes_in(scene_arguments(__doc__).parse_args()):
        for suffix, whole, cameras, place, truth in places_of(read()):
            places += 1
            sun = find_sun(CapturedScene(whole, cameras), region_around(place, cameras), decisive=min(_BARS))
            if sun is None:
                continue
            one = judge(sun, truth)
            found.append(one)
            where = f"{name + suffix:28s} evidence {sun.evidence:4.0f}   off {one.off_deg:5.1f} degrees"
            print(f"{where}   strength {one.ratio:.2f} (true {one.true_ratio:.2f})", flush=True)
    print(f"{places} places")
    for bar in _BARS:
        over = [one for one in found if one.sun.evidence >= bar]
        logs = sorted(abs(math.log(one.ratio / one.true_ratio)) for one in over if one.is_right)
        error = f", median error of the strength a factor of {math.exp(logs[len(logs) // 2]):.2f}" if logs else ""
        print(f"bar {bar:3.0f}: {sum(one.is_right for one in over)} right of {len(over)}{error}")


if __name__ == "__main__":
    main()
