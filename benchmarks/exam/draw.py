"""The scenes of an exam, drawn from its number alone."""

import random

from splatgraft_paper.synthesis.benchmark import BenchmarkScene, BenchmarkSize, draw_scene
from splatgraft_paper.synthesis.jobs import RenderSize
from splatgraft_paper.synthesis.pairs import KINDS

TRAINING_NUMBER = 0
"""Its scenes are for development; every other number is used for one exam only."""
SIZE = BenchmarkSize(RenderSize(width=288, height=204, samples=8), views=18)
_SEEDS = (2**31, 2**32)
"""Range of the seeds of scenes and objects. The benchmark's scenes have 9000001 and up, its objects 11 and up, the
development scenes 9100 to 9999; training pairs have 100003 x set + scene, and objects below 2**31."""


def draw_scenes(number: int, count: int) -> tuple[BenchmarkScene, ...]:
    """Draw the scenes of an exam: all kinds in turn, in an order drawn too, each with a seed and an object's seed.

    Seeds whose scene has no room for the cameras are drawn again. The first scenes do not depend on `count`.
    """
    rng = random.Random(f"exam-{number}")
    kinds = rng.sample(KINDS, len(KINDS))
    order = [kinds[i % len(kinds)] for i in range(count)]
    return tuple(draw_scene(rng, f"{i:02d}_{kind}", kind, _SEEDS, SIZE) for i, kind in enumerate(order))
