"""Frames of exported scenes: upright and in metres where the format asks for it, as captured where it does not."""

import pytest
import torch
from small_transfer import parts, write_transfer

from splatgraft.cli import main
from splatgraft.exports.export_source import ExportSource
from splatgraft.exports.scene_frame import upright
from splatgraft.formats import SceneMetadata, read_gaussians, read_scene


@pytest.fixture
def project(tmp_path):
    return write_transfer(tmp_path)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (0, -1, 0), (1, 0, 0), (0.6, 0, -0.8), (-0.48, 0.6, 0.64)])
def test_up_becomes_minus_y_by_a_rotation(up):
    metadata = SceneMetadata(up=tuple(map(float, up)), metres_per_unit=0.3)
    move, found, said = upright(ExportSource(parts()["place"], "a", metadata=metadata))
    torch.testing.assert_close(move.rotation @ torch.tensor(metadata.up), torch.tensor([0, -1.0, 0]), atol=1e-5, rtol=0)
    torch.testing.assert_close(move.rotation @ move.rotation.T, torch.eye(3), atol=1e-5, rtol=0)
    assert float(torch.linalg.det(move.rotation)) == pytest.approx(1, abs=1e-5)
    assert (move.scale, found.metres_per_unit) == (0.3, 1.0)
    assert "one unit is a metre; one of the capture was 0.3 m" in said


def test_a_glb_is_upright_and_in_metres(project, tmp_path, capsys):
    assert main(["export", str(project), "--to", str(tmp_path / "a.glb"), "--layer", "object"]) == 0
    assert "turned upright" in capsys.readouterr().err
    g = read_gaussians(tmp_path / "a.glb")  # back in the axes of a .ply: up is -y
    ball = parts()["relit"]
    # the middle of the ball, 0.3 units above the plane, of 0.5 m each
    assert float(g.means[:, 1].mean()) == pytest.approx(-0.5 * float(ball.means[:, 2].mean()), abs=1e-3)
    torch.testing.assert_close(g.scales, 0.5 * ball.scales, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("suffix", [".ply", ".spz", ".sog", ".compressed.ply"])
def test_others_stay_in_the_frame_of_the_capture(project, tmp_path, suffix):
    assert main(["export", str(project), "--to", str(tmp_path / f"a{suffix}"), "--layer", "scene"]) == 0
    found, place = read_gaussians(tmp_path / f"a{suffix}"), parts()["place"]
    # 11 bits of 2 units
    torch.testing.assert_close(found.means.mean(0), place.means.mean(0), atol=1e-3, rtol=0)
    torch.testing.assert_close(found.means.std(0), place.means.std(0), atol=1e-3, rtol=0)


def test_the_frame_may_be_chosen(project, tmp_path):
    for frame, suffix in (("world", ".ply"), ("capture", ".glb")):
        out = tmp_path / f"{frame}{suffix}"
        assert main(["export", str(project), "--to", str(out), "--layer", "scene", "--frame", frame]) == 0
    assert read_scene(tmp_path / "world.ply").up == pytest.approx((0, -1, 0))
    assert read_scene(tmp_path / "world.ply").metres_per_unit == 1
    assert read_gaussians(tmp_path / "world.ply").means[:, 1].std() < 1e-3  # the plane is level
    captured = read_gaussians(tmp_path / "capture.glb")
    torch.testing.assert_close(captured.means, parts()["place"].means, atol=1e-5, rtol=0)


def test_an_unknown_size_is_said(tmp_path, capsys):
    project = write_transfer(tmp_path, metres_per_unit=None)
    assert main(["export", str(project), "--to", str(tmp_path / "a.glb")]) == 0
    assert "its size is not known: a unit of the capture is written as a metre" in capsys.readouterr().err


@pytest.mark.parametrize("suffix", [".ply", ".sog", ".spz", ".glb"])
def test_a_lower_degree(project, tmp_path, suffix):
    assert main(["export", str(project), "--to", str(tmp_path / f"a{suffix}"), "--sh-degree", "0"]) == 0
    assert read_gaussians(tmp_path / f"a{suffix}").sh_degree == 0


def test_no_such_degree(project, tmp_path, capsys):
    assert main(["export", str(project), "--to", str(tmp_path / "a.sog"), "--sh-degree", "4"]) == 2
    assert "--sh-degree: expected 0 to 3, found 4" in capsys.readouterr().err


def test_older_versions_of_spz(project, tmp_path):
    for version in ("2", "3", "4"):
        out = tmp_path / f"v{version}.spz"
        assert main(["export", str(project), "--to", str(out), "--spz-version", version]) == 0
        head = out.read_bytes()[:2]
        assert head == (b"NG" if version == "4" else b"\x1f\x8b")
