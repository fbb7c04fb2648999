"""Count over rendered scenes with known light how often shadows show the right sun, for each candidate bar.

    python benchmarks/fit_sun.py SCENES [SCENES ...] --work FOLDER [FOLDER ...] [--plot FILE.svg]

SCENES are folders of scenes that `splatgraft paper exam` rendered; both places of each count. A sun is right if it lies
within 5 degrees of the disc of a true source. The source must give a fifth of the irradiance on the surface or more.

Gaussians mix lit and shaded ground, so the edge of a shadow shows shade over lit ground brighter than it was. The error
has an asymmetric Laplace density, whose two means are fitted to the right suns over the bar of `find_sun`.

The plot has one point for each place: the largest log likelihood of a direction within 15 degrees of such a source, and
of any other direction.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from exam_scenes import is_outdoors, scene_arguments, scenes_in
from torch import Tensor

from splatgraft.core.bounds import BoundingSphere, bounding_sphere
from splatgraft.core.cameras import Cameras
from splatgraft.core.gaussians import Gaussians, concatenate
from splatgraft.core.images import LUMINANCE
from splatgraft.relighting.captured_scene import CapturedScene
from splatgraft.relighting.light.estimate import region_around
from splatgraft.relighting.light.light import Light
from splatgraft.relighting.light.sun import _DECISIVE, _DIRECTIONS, Sun, _ShadowEvidence, find_sun
from splatgraft_paper.exam.scenes import ExamScene

_BARS = (15.0, 20.0, 30.0, 40.0, 50.0, 60.0, 80.0)
_NEAR_DEG = 5.0
_STRONG = 0.2
_APART = math.cos(math.radians(15))


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


def mean_errors(suns: Sequence[Judged]) -> tuple[float, float]:
    """Fit the mean errors of shade over lit ground, brighter and darker, of some suns (maximum likelihood)."""
    errors = [1 / (1 + one.ratio) - 1 / (1 + one.true_ratio) for one in suns]
    brighter, darker = (sum(max(sign * error, 0.0) for error in errors) / len(errors) for sign in (1, -1))
    both = math.sqrt(brighter * darker)
    return brighter + both, darker + both


def judge(sun: Sun, truth: Light) -> Judged:
    """Compare a sun with the true light at its place."""
    off, near = math.inf, 0.0
    for source, share in zip(truth.sources, _shares(truth, sun.normal), strict=True):
        direction = torch.tensor(source.direction)
        angle = math.degrees(math.acos(max(-1.0, min(1.0, float(direction @ sun.direction)))))
        if share > _STRONG:
            off = min(off, max(0.0, angle - source.angular_radius_deg))
        if angle < 20:
            near += share
    return Judged(sun, off, near / (1 - near))


def _shares(truth: Light, normal: Tensor) -> list[float]:
    """Return the share of each source in the irradiance on a surface."""
    whole = float(truth.irradiance(normal[None])[0] @ LUMINANCE)
    return [max(0.0, float(torch.tensor(s.direction) @ normal)) * s.luminance / whole for s in truth.sources]


def right_and_wrong(captured: CapturedScene, region: BoundingSphere, truth: Light) -> tuple[float | None, float] | None:
    """Return the largest log likelihoods of directions near a strong source, and of all others.

    The first is None without a strong source. Without a surface, the result is None.
    """
    shown = _ShadowEvidence.of(captured, region)
    if shown is None:
        return None
    directions = shown.above(_DIRECTIONS)
    shares = _shares(truth, shown.surface.plane.normal)
    strong = [s.direction for s, share in zip(truth.sources, shares, strict=True) if share > _STRONG]
    near = (directions @ torch.tensor(strong).reshape(-1, 3).T > _APART).any(1)

    def best(which: Tensor) -> float:
        found = shown.best(directions[which])[1] if bool(which.any()) else 0.0
        return max(found, 0.0)

    return best(near) if strong else None, best(~near)


def plot(points: Sequence[tuple[float | None, float]], path: Path) -> None:
    """Draw the likelihoods of all places as SVG; places without a strong source are crosses on the left."""
    most, size, edge = 10 * math.ceil(max(max(right or 0, wrong) for right, wrong in points) / 10), 300, 50
    scale = size / math.sqrt(most)  # square roots spread small values

    def at(right: float, wrong: float) -> tuple[float, float]:
        return edge + scale * math.sqrt(right), edge + size - scale * math.sqrt(wrong)

    bar_x, bar_y = at(_DECISIVE, _DECISIVE)
    style = 'font-family="sans-serif" font-size="12" fill="#444"'
    marks = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {size + 2 * edge} {size + 2 * edge}">',
        f'<rect width="{size + 2 * edge}" height="{size + 2 * edge}" fill="white"/>',
        f'<path d="M{edge} {edge}v{size}h{size}" fill="none" stroke="#444"/>',
        f'<path d="M{edge} {edge + size}L{edge + size} {edge}" stroke="#bbb"/>',
        f'<path d="M{edge} {bar_y:.1f}h{size}M{bar_x:.1f} {edge}v{size}" stroke="#c33" stroke-dasharray="4 4"/>',
    ]
    for tick in (1, 10, _DECISIVE, *range(100, most + 1, 100)):
        x, y = at(tick, tick)
        marks.append(f'<text x="{x:.1f}" y="{edge + size + 16}" text-anchor="middle" {style}>{tick:.0f}</text>')
        marks.append(f'<text x="{edge - 6}" y="{y + 4:.1f}" text-anchor="end" {style}>{tick:.0f}</text>')
    title = f'<text x="{edge + size / 2}" y="{edge + size + 36}" text-anchor="middle" {style}>'
    marks.append(f"{title}log likelihood near a strong source</text>")
    middle = edge + size / 2
    turned = f'transform="rotate(-90 14 {middle})" text-anchor="middle" {style}'
    marks.append(f'<text x="14" y="{middle}" {turned}>of the best other direction</text>')
    for right, wrong in points:
        x, y = at(right or 0, wrong)
        if right is None:
            marks.append(f'<path d="M{x - 4:.1f} {y - 4:.1f}l8 8m0 -8l-8 8" stroke="#888" stroke-width="1.5"/>')
        else:
            marks.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="#2673b8" fill-opacity="0.7"/>')
    path.write_text("\n".join([*marks, "</svg>"]) + "\n", encoding="utf-8")


def places_of(scene: ExamScene) -> Iterator[tuple[str, Gaussians, Cameras, BoundingSphere, Light]]:
    """Yield for both places: suffix of the name, all occluders, the cameras, the place, the true light."""
    placed, source = scene.composite.objects[0], scene.source
    yield "", scene.composite.target, scene.cameras, bounding_sphere(placed.in_target()), scene.new_light
    whole = concatenate([source.gaussians, placed.gaussians])
    yield ", old place", whole, source.cameras, bounding_sphere(placed.gaussians), scene.old_light


def main() -> None:
    """Judge and print."""
    parser = scene_arguments(__doc__)
    parser.add_argument("--plot", type=Path, help="SVG of the likelihoods of right and wrong directions")
    options = parser.parse_args()
    found, points = {bar: list[Judged]() for bar in _BARS}, list[tuple[float | None, float]]()
    places = 0
    for name, read in scenes_in(options):
        for suffix, whole, cameras, place, truth in places_of(read()):
            places += 1
            captured, region = CapturedScene(whole, cameras), region_around(place, cameras)
            compared = right_and_wrong(captured, region, truth) if options.plot else None
            if compared is not None:
                points.append(compared)
                right = "-" if compared[0] is None else f"{compared[0]:.0f}"
                print(f"{name + suffix:28s} near a strong source {right}, elsewhere {compared[1]:.0f}", flush=True)
            sun, outdoors = None, not suffix and is_outdoors(name)
            for bar in _BARS:
                if sun is None or sun.evidence < bar:  # another surface may have more
                    sun = find_sun(captured, region, outdoors=outdoors, decisive=bar)
                    if sun is None:
                        break
                    one = judge(sun, truth)
                    where = f"{name + suffix:28s} evidence {sun.evidence:4.0f}   off {one.off_deg:5.1f} degrees"
                    print(f"{where}   strength {one.ratio:.2f} (true {one.true_ratio:.2f})", flush=True)
                found[bar].append(judge(sun, truth))
    if points:
        plot(points, options.plot)
    print(f"{places} places")
    for bar in _BARS:
        over = found[bar]
        logs = sorted(abs(math.log(one.ratio / one.true_ratio)) for one in over if one.is_right and one.true_ratio > 0)
        error = f", median error of the strength a factor of {math.exp(logs[len(logs) // 2]):.2f}" if logs else ""
        print(f"bar {bar:3.0f}: {sum(one.is_right for one in over)} right of {len(over)}{error}")
    right = [one for one in found[_DECISIVE] if one.is_right]
    if right:
        brighter, darker = mean_errors(right)
        print(f"mean errors of shade over lit ground: {brighter:.2f} brighter, {darker:.2f} darker")


if __name__ == "__main__":
    main()
