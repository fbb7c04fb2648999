"""Noise schedules and the iterative dataset update."""

from itertools import pairwise

import pytest
import torch

from splatgraft.consolidation import ConsolidateOptions, geometric_schedule, iterative_update, linear_schedule
from splatgraft.core.image_metrics import psnr
from splatgraft.rendering import render


def test_schedules_run_from_full_noise_to_a_tenth():
    assert linear_schedule() == pytest.approx((1.0, 0.775, 0.55, 0.325, 0.1))
    geometric = geometric_schedule()
    assert geometric[0] == 1.0
    assert geometric[-1] == pytest.approx(0.1)
    ratios = [b / a for a, b in pairwise(geometric)]
    assert ratios == pytest.approx([0.1**0.25] * 4)
    assert linear_schedule(1) == geometric_schedule(1) == (1.0,)


def test_each_update_harmonises_renders_of_the_one_before(relit):
    seen = []

    def harmonize_at(scene, strength):
        seen.append((scene, strength))
        return relit.images

    options = ConsolidateOptions(view_error=None, polish_passes=1)
    out = iterative_update(relit.composite, relit.cameras, harmonize_at, (1.0, 0.5), options)
    assert [strength for _, strength in seen] == [1.0, 0.5]
    assert seen[0][0] is relit.composite
    wanted = torch.stack(relit.images)
    scores = [float(psnr(render(scene, relit.cameras).color, wanted)) for scene in (relit.composite, seen[1][0], out)]
    assert scores[1] > scores[0]
    assert scores[2] == scores[1]  # the same images give the same scene


def test_strengths_outside_the_range_are_refused(relit):
    with pytest.raises(ValueError, match=r"strengths in \(0, 1\]"):
        iterative_update(relit.composite, relit.cameras, lambda scene, strength: relit.images, (1.0, 0.0))
