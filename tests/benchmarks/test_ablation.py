"""Rows of benchmarks/ablation.py: what they replace exists and changes the transfer, and their table is correct."""

from dataclasses import replace
from pkgutil import resolve_name

import ablation
import pytest
import torch
from ablation import FULL, ROWS, STAGES, Baseline, Measured, Row
from shapes import UP, ring, surfels

from splatgraft.compositing.composite import Composite, PlacedObject
from splatgraft.core.directions import even_directions
from splatgraft.core.gaussians import concatenate
from splatgraft.core.similarity import Similarity
from splatgraft.evaluation import Truth
from splatgraft.relighting import Light, SourceScene
from splatgraft.relighting.light.light import fit_ambient
from splatgraft.rendering import render
from splatgraft_paper.exam.scenes import ExamScene, TrueView


@pytest.mark.parametrize("name", ROWS)
def test_what_a_row_replaces_exists_and_is_made_by_the_stage_that_it_changes(name):
    row = ROWS[name]
    for target, replacement in row.patches.items():
        assert callable(resolve_name(f"splatgraft.{target}")) == callable(replacement)
    with ablation.patched(row.patches):
        assert all(resolve_name(f"splatgraft.{target}") is not None for target in row.patches)
    assert not set(row.patches) & set(STAGES[row.stage])


def test_a_name_that_does_not_exist_is_an_error():
    with pytest.raises(AttributeError), ablation.patched({"relighting.cast_shadows.NO_SUCH_POWER": 1.0}):
        pass


@pytest.fixture(scope="module")
def scene() -> ExamScene:
    """Return a ball on a floor in a dome that is bright on one side; it was captured in a dome of the other side."""
    x, y = torch.meshgrid(torch.linspace(-1.2, 1.2, 41), torch.linspace(-1.2, 1.2, 41), indexing="ij")
    points = torch.stack([x.flatten(), y.flatten(), torch.zeros(x.numel())], 1)
    around = even_directions(300)
    floor = surfels(points, UP.repeat(len(points), 1), width=0.05, srgb=0.5)
    dome = even_directions(2000)

    def place(side: float):
        gray = 0.5 + 0.4 * side * dome[:, :1].repeat(1, 3)
        return concatenate([floor, surfels(6 * dome, -dome, width=0.3, srgb=gray)])

    thing = surfels(0.2 * around + 0.2 * UP, around, width=0.03, srgb=0.5)
    cameras, target = ring(12), place(1.0)
    even = Light((), fit_ambient(torch.full((3,), 0.5)))
    composite = Composite(
        target,
        (PlacedObject(thing, Similarity(1.0, torch.eye(3), torch.zeros(3))),),
        torch.zeros(target.count, dtype=torch.bool),
    )
    is_thing = (torch.arange(target.count + thing.count) >= target.count).float()[:, None]
    camera, whole = cameras[:1], concatenate([target, thing])
    background = render(target, camera).color[0].clamp(0, 1)
    drawn = render(whole, camera, features=is_thing)
    truth = Truth(drawn.color[0].clamp(0, 1), background, drawn.features[0, ..., 0])
    return ExamScene(
        name="dome",
        composite=composite,
        cameras=cameras,
        source=SourceScene(place(-1.0), cameras),
        views=(TrueView(camera, truth, background),),
        fitted_views=(),
        new_light=even,
        old_light=even,
        normals=None,
    )


@pytest.mark.long
def test_a_row_that_changes_nothing_is_told_from_one_that_does(scene):
    baseline = Baseline(scene)
    full = ablation.measure_full(baseline)
    assert ablation.measure(ROWS["bounce"], baseline, full).changed
    unused = Row("layers", "a call of a stage that is not run again", ROWS["bounce"].patches)
    assert not ablation.measure(unused, baseline, full).changed
    # reusing what does not depend on the stage gives what the whole transfer gives
    for name in ("level-share", "albedo"):
        alone, reused = (
            ablation.measure(row, baseline, full) for row in (replace(ROWS[name], stage="scene"), ROWS[name])
        )
        assert alone.values == reused.values
        assert alone.changed
    with pytest.raises(ValueError, match="expected a stage that calls"):
        ablation.measure(replace(ROWS["sun"], stage="evidence"), baseline, full)


def measured(value: float, changed: bool = True) -> Measured:
    return Measured({"object": value, "shadow": value, "whole": None}, changed, 2.0, 0.5)


def test_a_smaller_shadow_error_is_better_and_equal_bits_have_no_number(tmp_path):
    results = {
        "a": {FULL: measured(1.0), "bounce": measured(1.5), "power": measured(1.0, False)},
        "b": {FULL: measured(2.0), "bounce": measured(1.5), "power": measured(2.0, False)},
        "c": {FULL: measured(3.0), "bounce": measured(4.0)},
    }
    ablation.write_results(tmp_path / "results.json", results)
    lines = ablation.table(ablation.read_results(tmp_path / "results.json"), ["bounce", "power"]).splitlines()
    full, bounce, power = ([cell.strip() for cell in line.split("|")[2:-1]] for line in lines[2:])
    assert full[1:] == ["2.00", "2.0000", "-", "3", "2.0"]
    # differences 0.5, -0.5 and 1: their mean is 1/3, their deviation sqrt(7/12)
    assert bounce[1:] == ["+0.33 ± 0.44 (2 / 1)", "+0.3333 ± 0.4410 (1 / 2)", "-", "3 of 3", "+0.5"]
    assert power[1:] == ["no effect", "no effect", "no effect", "0 of 2", "+0.5"]
