"""The step `render`: the confidence of the prior comes only from the given light file."""

import json
from pathlib import Path

import pytest
import torch
from tiny_project import ball, photograph, plane

from splatgraft.core.gaussians import concatenate
from splatgraft.formats import write_gaussians
from splatgraft.project.gaussian_flags import write_flags
from splatgraft.project.step import job_of, perform
from splatgraft.relighting import Light, LightSource, light_to_json
from splatgraft.relighting.light.light import light_confidence
from splatgraft.runtime.console import Console
from splatgraft.steps.render import Render

LIGHT = Light((LightSource((0.0, 0.0, 1.0), (2.0, 2.0, 2.0), confidence=0.5),), torch.full((9, 3), 0.1), coverage=0.8)


@pytest.fixture
def step(tmp_path: Path) -> Render:
    """Write a composite and, in another folder, a prior."""
    scene = concatenate([plane((0.5, 0.5, 0.5)), ball()])
    photograph(tmp_path / "target", plane((0.5, 0.5, 0.5)), None)
    (tmp_path / "relit").mkdir()
    for name in ("scene.ply", "relit/scene.ply"):
        write_gaussians(tmp_path / name, scene)
    write_flags(tmp_path / "is_object.npy", torch.arange(scene.count) >= scene.count - ball().count)
    names = {"is_object": "is_object.npy", "prior": "relit/scene.ply", "light": "relit/light.json"}
    paths = {field: tmp_path / name for field, name in names.items()}
    return Render(tmp_path / "scene.ply", tmp_path / "target", tmp_path / "views", **paths, device="cpu")


def confidence(step: Render) -> float:
    return json.loads((perform(step, Console()) / "prior.json").read_text())["trust"]


def test_the_confidence_is_that_of_the_light_which_is_handed_over(step: Render) -> None:
    assert step.light is not None
    step.light.write_text(light_to_json(LIGHT))
    # prior.json has four decimals
    assert confidence(step) == round(light_confidence(LIGHT), 4) > 0
    assert job_of(step).inputs["light"] == (step.light,)
    # a light.json beside the prior is not read unless it is given
    assert confidence(Render(**{**vars(step), "light": None})) == 0


def test_a_light_file_is_missed_unless_the_transfer_found_no_light(step: Render) -> None:
    with pytest.raises(ValueError, match=r"light.json: expected the light.json that relight wrote, found no such file"):
        perform(step, Console())
    assert step.light is not None
    step.light.with_name("light.txt").write_text("No object is placed: nothing to light.\n")
    assert confidence(step) == 0
    assert "light" not in job_of(step).inputs
