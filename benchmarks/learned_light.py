"""What the learned correction of the light is worth in pictures of scenes that it was not trained on.

    python benchmarks/learned_light.py SCENES [SCENES ...] --work FOLDER [FOLDER ...] --examples FOLDER [--more FOLDER]

SCENES are folders of scenes as `python benchmarks/exam` renders them. The scenes are split in parts; for each part,
networks are trained on the other parts and on the examples of `splatgraft synth lights` in --more, and the transfer is
measured with and without them on the part left out. Examples of SCENES are made once and kept in --examples.
"""

import argparse
import math
import operator
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).parent))

from exam.evaluate_scene import measure_row
from exam.rows import make_row
from exam.scene_files import ExamScene, read_probe, true_light_files
from exam.training_scenes import TrainingScene, estimated_lights, scenes_in

from splatgraft.relighting import relight
from splatgraft.relighting.light.estimate import NoLight
from splatgraft.relighting.light.learned.ensemble import LightEnsemble
from splatgraft.training.light_examples import LightExample, light_example, read_examples, write_examples
from splatgraft.training.light_training import LightTrainingOptions, train_light


def examples_of(where: TrainingScene) -> list[LightExample]:
    """The estimate and the truth at the new and the old place; a place without light is left out, and said."""
    files, examples = true_light_files(where.files), []
    for side, found in estimated_lights(where.read()).items():
        if isinstance(found, NoLight):
            print(f"{where.name}/{side}: left out, {found.reason}", flush=True)
        else:
            examples.append(light_example(f"{where.name}/{side}", found, *read_probe(*files[side])))
    return examples


def kept_examples(where: TrainingScene, folder: Path) -> list[LightExample]:
    """`examples_of`, from a file in `folder` where they were made before."""
    path = folder / f"{where.name}.npz"
    if not path.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        write_examples(path, examples_of(where))
    return read_examples(path)


@dataclass(frozen=True)
class Gains:
    """Of one scene without and with networks."""

    object: tuple[float, float]
    """PSNR over that of pasting, dB."""
    shadow: tuple[float, float]
    """Share of pasting's shadow error that is removed; nan where the scene has no shadow."""
    whole: tuple[float, float]
    """PSNR of the whole image over that of pasting, dB."""

    def __str__(self) -> str:
        """One line."""
        values = {"object": self.object, "shadow": self.shadow, "whole": self.whole}
        return "  ".join(f"{name} {a:+.2f} -> {b:+.2f}" for name, (a, b) in values.items())

    @staticmethod
    def of(scene: ExamScene, networks: LightEnsemble) -> "Gains":
        """Measure all three."""
        paste = measure_row(make_row("paste", scene)[0], scene.views)
        found = []
        for light in (None, networks):
            relit = relight(scene.composite, scene.cameras, sources=[replace(scene.source, light=light)], light=light)
            row = measure_row(relit.bake()[0], scene.views)
            of_shadow = 1 - _over(row["shadow"], paste["shadow"], operator.truediv)
            found.append([_over(row[name], paste[name], operator.sub) for name in ("object", "whole")] + [of_shadow])
        (without_object, without_whole, without_shadow), (object_, whole, shadow) = found
        return Gains((without_object, object_), (without_shadow, shadow), (without_whole, whole))


def _over(value: float | None, pasted: float | None, compare: Callable[[float, float], float]) -> float:
    """A value against that of pasting; nan where one is not defined."""
    return math.nan if value is None or pasted is None else compare(value, pasted)


def print_summary(found: Sequence[Gains]) -> None:
    """Means over scenes, without and with networks."""
    for name in ("object", "shadow", "whole"):
        values = torch.tensor([getattr(one, name) for one in found])
        values = values[values.isfinite().all(1)]
        before, after = values.mean(0).tolist()
        better = int((values[:, 1] > values[:, 0]).sum())
        print(f"{name}: {before:.3f} -> {after:.3f}, better on {better} of {len(values)}")
    worse = [sum(one.whole[i] < 0 for one in found) for i in (0, 1)]
    print(f"whole image worse than pasted on {worse[0]} -> {worse[1]} of {len(found)}")


def main() -> None:
    """Train and measure part by part."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", type=Path, nargs="+", help="folders of scenes with known light")
    parser.add_argument("--work", type=Path, nargs="+", required=True, help="their reconstructions, in the same order")
    parser.add_argument("--examples", type=Path, required=True, help="folder of their examples, a file for each scene")
    parser.add_argument("--more", type=Path, help="folder of `splatgraft synth lights`: trained on in all parts")
    parser.add_argument("--parts", type=int, default=5)
    parser.add_argument("--steps", type=int, default=LightTrainingOptions().steps, help="of each network")
    options = parser.parse_args()
    scenes = scenes_in(options.scenes, options.work)
    examples = {one.name: kept_examples(one, options.examples) for one in scenes}
    files = sorted(options.more.glob("*.npz")) if options.more is not None else []
    more = [example for file in files for example in read_examples(file)]
    print(f"{len(scenes)} scenes, {len({one.scene for one in more})} more of synth lights", flush=True)
    found = []
    for part in range(options.parts):
        inside = [e for i, s in enumerate(scenes) if i % options.parts != part for e in examples[s.name]]
        training = LightTrainingOptions(steps=options.steps, seed=part)
        trained = train_light([*inside, *more], training, say=print, progress=lambda *_: None)
        for one in scenes[part :: options.parts]:
            gains = Gains.of(one.read(), trained.ensemble)
            print(f"{one.name:28s} {gains}", flush=True)
            found.append(gains)
    print_summary(found)


if __name__ == "__main__":
    main()
