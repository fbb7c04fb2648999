"""A mesh as the object of a project: no masks, its own size, beside others, and the exports for its renderer."""

import json
import tomllib
from pathlib import Path

import pytest
import torch
from mesh_files import cube, glb
from tiny_project import photograph, plane

from splatgraft.cli import main
from splatgraft.core.gaussians import KnownSurface
from splatgraft.formats import read_cameras, read_gaussians
from splatgraft.project.placement import read_placement


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a project of a cube of 30 cm and a plane, up to relight."""
    root = tmp_path_factory.mktemp("mesh")
    vertices, faces = cube(0.15)
    (root / "cube.glb").write_bytes(glb({"POSITION": vertices}, faces))
    photograph(root / "room", plane((0.5, 0.45, 0.6)), None)
    folder = root / "project"
    assert main(["init", str(folder), "--source", str(root / "cube.glb"), "--target", str(root / "room")]) == 0
    file = folder / "project.toml"
    text = file.read_text()
    assert "segment" not in tomllib.loads(text)
    text = text.replace("[target]", "views = 8\npicture_width = 48\n\n[target]", 1)
    file.write_text(text + "\n[reconstruct]\niterations = 60\nbudget = 400\nsh_degree = 1\n")
    (folder / "target").mkdir()
    (folder / "target" / "scale.json").write_text('{"metres_per_unit": 0.5, "source": "a test"}')
    assert main(["run", str(folder), "--to", "relight"]) == 0
    return folder


@pytest.mark.long
def test_the_whole_mesh_is_the_object_and_has_its_own_size(project: Path):
    object_ = read_gaussians(project / "object" / "object.ply")
    assert isinstance(object_, KnownSurface)
    assert object_.count == read_gaussians(project / "source" / "scene" / "scene.ply").count
    move = read_placement(project / "composite" / "placement.json").objects[0].target_from_object
    assert move.scale == pytest.approx(2)  # a metre is two units of the room
    # upright: y of the file is up in the room
    assert float((move.rotation @ torch.tensor([0.0, -1.0, 0.0]))[2]) > 0.95
    text = (project / "relit" / "light.txt").read_text()
    assert "Object 1 is a mesh" in text
    assert "standard error" in text
    assert "unknown" not in text


@pytest.mark.long
def test_a_placement_names_meshes_beside_the_own_object(project: Path, tmp_path: Path):
    file = json.loads((project / "composite" / "placement.json").read_text())
    own = file["objects"][0]
    own["object"] = str(project / "object" / "object.ply")
    mesh = {"object": str(project.parent / "cube.glb"), "scale": 1.0, "rotation": own["rotation"]}
    placement = tmp_path / "placement.json"
    placement.write_text(json.dumps({"objects": [own, mesh | {"translation": [0.6, 0.6, 0.2]}]}))
    target, cameras = project / "target" / "scene" / "scene.ply", project / "target" / "capture"
    arguments = ["--target", str(target), "--placement", str(placement), "--cameras", str(cameras)]
    assert main(["relight", *arguments, "--out", str(tmp_path / "relit")]) == 0
    text = (tmp_path / "relit" / "light.txt").read_text()
    assert "Object 1 is a mesh" in text
    assert "Object 2 is a mesh" in text


@pytest.mark.long
def test_the_scene_with_the_shadow_is_exported_with_its_light(project: Path, tmp_path: Path):
    out = tmp_path / "ground.ply"
    assert main(["export", str(project), "--to", str(out), "--layer", "scene-with-shadow"]) == 0
    whole = read_gaussians(project / "relit" / "scene.ply")
    ground = read_gaussians(out)
    count = read_gaussians(project / "object" / "object.ply").count
    assert ground.count == whole.count - count
    assert torch.equal(ground.sh, whole.sh[: ground.count])
    assert (tmp_path / "ground_light.hdr").is_file()
    assert json.loads((tmp_path / "ground_light.json").read_text())["sources"] is not None


def test_a_mesh_does_not_receive_objects(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    vertices, faces = cube()
    (tmp_path / "cube.glb").write_bytes(glb({"POSITION": vertices}, faces))
    mesh = str(tmp_path / "cube.glb")
    assert main(["init", str(tmp_path / "p"), "--source", mesh, "--target", mesh]) == 2
    assert "found a mesh" in capsys.readouterr().err


@pytest.mark.long
def test_the_cameras_of_a_mesh_look_at_it_from_above(project: Path):
    eyes = read_cameras(project / "source" / "capture").centers
    assert float(eyes[:, 1].max()) < 0
