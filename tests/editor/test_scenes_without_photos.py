"""Transfers between scenes without photographs and cameras, through the steps."""

from pathlib import Path

import numpy as np
import pytest
import torch
from editor_pages import scene_project
from tiny_project import ball

from splatgraft.cli import main
from splatgraft.core.capture_orientation import estimate_up
from splatgraft.editor.project import Project
from splatgraft.editor.session import Session
from splatgraft.formats import read_cameras, read_gaussians
from splatgraft.project.placement import read_placement
from splatgraft.project.record import read_record
from splatgraft.project.toml_edit import with_keys
from splatgraft.runtime.settings import read_toml


def test_a_transfer_between_two_scene_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    project = scene_project(tmp_path, mask_source="grabcut", threshold=0.5)
    assert main(["run", str(project), "--to", "consolidate"]) == 0
    said = capsys.readouterr().err
    assert "the scene has no photographs: 8 pictures" in said
    assert "the up direction is (0.00, 0.00, 1.00)" in said
    root = project.parent
    # guesses are shown
    (guess,) = [note for note in read_record(root / "target" / "capture").warnings if note.in_doubt]
    assert guess.picture is not None
    assert (root / "target" / "capture" / guess.picture).is_file()
    assert "upside down" in guess.remedy
    assert (root / "source/scene/scene.ply").read_bytes() == (tmp_path / "source.ply").read_bytes()
    # the masks of the rendered images separate the red ball from the plane
    object_ = read_gaussians(root / "object" / "object.ply")
    assert 40 < int(np.load(root / "object" / "selection.npy").sum()) <= ball().count
    assert bool((object_.sh[:, 0, 0] > object_.sh[:, 0, 1]).all())
    placed = read_placement(root / "composite" / "placement.json").objects[0].target_from_object
    # the box cuts the ball 0.03 above its lowest point: of its height 0.65 it may stand half a blob lower or higher
    assert abs(float(placed.points(object_.means)[:, 2].median()) - 0.8 * 0.3) < 0.1
    assert (root / "result" / "scene.ply").is_file()


def test_a_box_alone_segments_and_the_whole_scene_may_be_the_object(tmp_path: Path) -> None:
    project = scene_project(tmp_path, suffix=".spz")
    assert main(["run", str(project), "--to", "segment"]) == 0
    assert read_gaussians(project.parent / "object" / "object.ply").count == ball().count
    everything = [-9.0, -9.0, -9.0, 9.0, 9.0, 9.0]
    project.write_text(with_keys(project.read_text(), "segment", {"box": everything}))
    # no surroundings are left to estimate the source's light or support: the transfer works without
    assert main(["run", str(project), "--to", "relight"]) == 0
    scene = read_gaussians(tmp_path / "source.spz")
    assert read_gaussians(project.parent / "object" / "object.ply").count == scene.count
    assert read_gaussians(project.parent / "object" / "surroundings.ply").count == 0
    session = Session(Project(project))
    assert not session.files.has_photos("source")
    assert not session.files.has_photos("target")
    assert session.placeable_object(0).base.stands_on == "extent"
    # reading .spz rotates the axes, and the cameras rotate with them
    up = estimate_up(read_cameras(project.parent / "target" / "capture"))
    assert torch.allclose(
        up, torch.tensor([0.0, 0.0, 1.0]), atol=0.02
    )  # of a plane whose centres are rounded to 1/4096


def test_up_can_be_set_and_is_no_undo_step(tmp_path: Path) -> None:
    project = scene_project(tmp_path)
    session = Session(Project(project))
    session.set_view("target", up=(0.0, 0.0, -1.0))
    assert not session.reload()
    assert not session.step(-1)
    assert main(["run", str(project), "--to", "reconstruct"]) == 0
    cameras = read_cameras(project.parent / "target" / "capture")
    assert torch.allclose(estimate_up(cameras), torch.tensor([0.0, 0.0, -1.0]), atol=0.02)  # two rings of eight cameras
    assert bool((cameras.centers[:, 2] < 0).all())
    session.set_view("target", up=None, look="within")
    assert read_toml(project)["target"] == {
        "scene": "../target.ply",
        "views": 8,
        "picture_width": 160,
        "look": "within",
    }
    assert main(["run", str(project), "--to", "target/reconstruct"]) == 0


def test_wrong_inputs_are_reported_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    project = scene_project(tmp_path)
    text = project.read_text()
    for wrong, message in (
        (text.replace('scene = "../source.ply"', 'capture = "../source.ply"'), "write scene = instead"),
        (text.replace('scene = "../source.ply"', ""), "expected the key capture (or scene)"),
        (text + "[source.reconstruct]\niterations = 3\n", "beside a trained scene"),
        (text.replace("../source.ply", "../nowhere.ply"), "nowhere.ply"),
    ):
        project.write_text(wrong)
        assert main(["run", str(project), "--to", "reconstruct"]) == 2
        assert message in capsys.readouterr().err
