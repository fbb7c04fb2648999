"""FLIP against values of the authors' own program for the same pictures, its bounds and its symmetry."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from splatgraft.core.flip import flip, flip_map

RECORDED = json.loads((Path(__file__).with_name("flip_evaluator_1_7.json")).read_text())


def picture_pair(kind):
    """Return a smooth coloured pattern and a changed copy, 90 x 60 pixels in steps of 1/255."""
    rows, columns = np.mgrid[0:60, 0:90]
    waves = (np.sin(columns / 7 + rows / 11), np.sin(columns / 5 - rows / 9), np.cos((columns + rows) / 13))
    first = 0.5 + 0.4 * np.stack(waves, -1)
    second = first.copy()
    if kind == "noise":
        second = np.clip(first + 0.1 * np.random.default_rng(3).standard_normal(first.shape), 0, 1)
    elif kind == "shift":
        second = np.roll(first, 3, 1)
    elif kind == "square":
        second[15:30, 22:45] *= 0.5
    elif kind == "green and blue":
        first, second = np.zeros_like(first), np.zeros_like(first)
        first[..., 1], second[..., 2] = 1, 1
    return tuple(torch.from_numpy(np.round(x * 255) / 255).float() for x in (first, second))


@pytest.mark.parametrize("kind", ["noise", "shift", "square", "green and blue", "same"])
def test_values_are_those_of_the_authors_program(kind):
    first, second = picture_pair(kind)
    found = flip_map(second, first)
    # the program computes in float32 and takes powers of .7 and of up to one: 1e-7 of a colour difference near 0
    # becomes (1e-7)^.7 = 1e-5, times the steepest part of the map from difference to error, 3
    tolerance = 4e-5
    assert float(found.mean()) == pytest.approx(RECORDED[kind]["mean"], abs=tolerance)
    for (row, column), value in zip(RECORDED["pixels"], RECORDED[kind]["values"], strict=True):
        assert float(found[row, column]) == pytest.approx(value, abs=tolerance)


def test_it_lies_between_zero_and_one_is_symmetric_and_a_region_is_the_mean_of_its_pixels():
    first, second = picture_pair("shift")
    found = flip_map(first, second)
    assert float(found.min()) >= 0
    assert float(found.max()) <= 1
    # the same additions in another order, in float64
    assert torch.allclose(found, flip_map(second, first), atol=1e-6)
    first, second = picture_pair("square")
    region = torch.zeros(60, 90, dtype=torch.bool)
    region[15:30, 22:45] = True
    assert float(flip(second, first, region)) == pytest.approx(float(flip_map(second, first)[region].mean()))
    assert float(flip(second, first, region)) > 5 * float(flip(second, first))
    assert torch.isnan(flip(second, first, torch.zeros(60, 90, dtype=torch.bool)))
