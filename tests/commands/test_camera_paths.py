"""Options that name cameras take a capture's folder or its file, with the same inputs."""

from dataclasses import fields
from pathlib import Path

import pytest
from tiny_project import photograph, plane

from splatgraft.core.similarity import Similarity
from splatgraft.folders.capture_files import camera_files
from splatgraft.project.placement import ObjectPlacement, Placement, write_placement
from splatgraft.project.record import input_entries
from splatgraft.project.step import Step
from splatgraft.project.step_table import STEPS
from splatgraft.steps.compose import Compose
from splatgraft.steps.evaluate import Evaluate
from splatgraft.steps.relight import Relight
from splatgraft.steps.render import Render


def steps(root: Path, cameras: Path) -> list[Step]:
    """Return all steps with an option that names cameras, each with these cameras."""
    scene = root / "scene.ply"
    placement = root / "placement.json"
    return [
        Compose(scene, scene, cameras=cameras, object_cameras=cameras),
        Relight(scene, placement, cameras, object_cameras=cameras),
        Render(scene, cameras),
        Evaluate(scene, root / "composite", cameras),
    ]


def test_cameras_are_a_folder_or_a_file_in_every_step(tmp_path: Path) -> None:
    photograph(tmp_path / "c", plane((0.5, 0.5, 0.5)), None)
    placed = ObjectPlacement(Similarity.identity(), object_path=tmp_path / "scene.ply")
    write_placement(tmp_path / "placement.json", Placement(objects=(placed,)))
    by_folder, by_file = (steps(tmp_path, path) for path in (tmp_path / "c", tmp_path / "c" / "transforms.json"))
    for folder_step, file_step in zip(by_folder, by_file, strict=True):
        assert folder_step.inputs() == file_step.inputs()
        named = [path for files in folder_step.inputs().values() for path in files if path.parent == tmp_path / "c"]
        assert input_entries(named, ())
    kinds = {row.load() for row in STEPS for field in fields(row.load()) if field.name.endswith("cameras")}
    assert kinds == {type(step) for step in by_folder}


def test_a_folder_without_cameras_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"expected transforms\.json, or a COLMAP model in sparse/0, found neither"):
        camera_files(tmp_path)
    # a file that does not exist yet is reported by the step that opens it
    assert camera_files(tmp_path / "none.json") == (tmp_path / "none.json",)
