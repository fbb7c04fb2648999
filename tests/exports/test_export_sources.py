"""What `export` finds in a scene, a folder and a project, and what it refuses."""

import json
import zipfile

import pytest
import torch
from format_files import random_gaussians
from small_transfer import parts, write_transfer

from splatgraft.cli import main
from splatgraft.core.gaussians import Gaussians
from splatgraft.exports.export import ExportOptions, export_scene, layer_of
from splatgraft.exports.export_source import ExportSource
from splatgraft.exports.first_view import first_view
from splatgraft.folders.export_source import read_export_source
from splatgraft.formats import read_gaussians, write_gaussians


@pytest.fixture
def project(tmp_path):
    return write_transfer(tmp_path)


def same(a: Gaussians, b: Gaussians) -> bool:
    return torch.equal(a.means, b.means) and torch.equal(a.sh, b.sh)


def test_a_project_knows_its_layers_its_frame_and_its_name(project):
    source = read_export_source(project)
    p = parts()
    assert same(layer_of(source, "object")[0], p["relit"])
    assert same(layer_of(source, "scene")[0], p["place"])
    assert source.pasted is not None
    assert source.pasted.count == source.scene.count == p["place"].count + p["object"].count
    assert source.title == "A ball on a plane"
    assert source.metadata.metres_per_unit == 0.5
    torch.testing.assert_close(torch.tensor(source.metadata.up), torch.tensor([0.0, 0, 1]), atol=1e-3, rtol=0)


def test_its_folders_and_its_project_file_lead_to_the_project(project):
    (project / "project.toml").write_text("")
    for path in (project / "project.toml", project / "relit", project / "result"):
        assert read_export_source(path).is_object is not None
    # the composite and the target are scenes by themselves
    assert same(read_export_source(project / "target/scene").scene, parts()["place"])
    assert read_export_source(project / "target/scene").cameras is not None
    assert read_export_source(project / "composite").is_object is None


def test_erased_gaussians_are_not_in_the_place(project):
    import numpy as np

    erased = np.zeros(parts()["place"].count, bool)
    erased[:10] = True
    np.save(project / "composite/erased.npy", erased)
    placement = {"objects": [], "erased": "erased.npy"}
    (project / "composite/placement.json").write_text(json.dumps(placement))
    assert layer_of(read_export_source(project), "scene")[0].count == len(erased) - 10


def test_the_first_view_is_a_captured_one_of_the_object(project):
    source = read_export_source(project)
    view, said = first_view(source)
    assert said == ()
    assert source.cameras is not None
    nearest = (source.cameras.centers - torch.tensor(view.center)).norm(dim=1).argmin()
    torch.testing.assert_close(torch.tensor(view.eye), source.cameras.centers[nearest])
    # the median of 80 points on a sphere of radius 0.25 around (0, 0, 0.3)
    assert (torch.tensor(view.center) - torch.tensor([0, 0, 0.3])).norm() < 0.1


def test_a_scene_without_cameras_says_what_it_assumes(tmp_path, capsys):
    write_gaussians(tmp_path / "vase.ply", random_gaussians(300, 1))
    assert main(["export", str(tmp_path / "vase.ply"), "--to", str(tmp_path / "vase.html")]) == 0
    assert "up is not known and taken to be -y" in capsys.readouterr().err
    assert "<title>Vase</title>" in (tmp_path / "vase.html").read_text()


@pytest.mark.parametrize("name", ["none", "none.ply", "empty"])
def test_what_is_no_scene_is_one_line(tmp_path, capsys, name):
    (tmp_path / "empty").mkdir()
    assert main(["export", str(tmp_path / name), "--to", str(tmp_path / "a.html")]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1
    assert str(tmp_path / name) in said[0]
    assert not (tmp_path / "a.html").exists()


def test_another_suffix_is_refused_with_the_list(tmp_path):
    source = ExportSource(random_gaussians(3), "a")
    with pytest.raises(ValueError, match=r"a\.obj: expected a file that ends in \.html, .*found '\.obj'"):
        export_scene(source, tmp_path / "a.obj")


@pytest.mark.parametrize("layer", ["object", "scene"])
def test_a_scene_alone_has_no_layers(tmp_path, layer):
    with pytest.raises(ValueError, match=f"--layer {layer}: expected the folder of a project"):
        export_scene(ExportSource(random_gaussians(3), "a"), tmp_path / "a.sog", ExportOptions(layer=layer))


def test_gaussians_that_are_not_finite_are_left_out_and_said(tmp_path):
    g = random_gaussians(30)
    g.means[4, 1] = float("nan")
    said = export_scene(ExportSource(g, "a"), tmp_path / "a.sog")
    assert said == ("1 Gaussians that are not finite are left out",)
    assert read_gaussians(tmp_path / "a.sog").count == 29


def test_a_stale_result_is_said(project, capsys):
    (project / "project.toml").write_text('[source]\ncapture = "photos"\n[target]\ncapture = "photos"\n')
    assert main(["export", str(project), "--to", str(project / "a.sog")]) == 0
    assert "out of date" in capsys.readouterr().err


def test_up_and_size_stand_in_the_sog(project, tmp_path):
    assert main(["export", str(project), "--to", str(tmp_path / "a.sog")]) == 0
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        meta = json.loads(archive.read("meta.json"))
    assert meta["splatgraft"]["metres_per_unit"] == 0.5
    assert meta["splatgraft"]["up"] == pytest.approx([0, 0, 1], abs=1e-3)
