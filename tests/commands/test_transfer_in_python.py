"""`transfer`: the same as a run of its project, from values too; moving, saving, and a project of somebody else."""

import math
from pathlib import Path

import pytest
import torch
from tiny_project import ball, contents, photograph, plane

import splatgraft as sg
from splatgraft.core.gaussians import concatenate
from splatgraft.project.layout import Layout

SHORT = sg.ReconstructOptions(iterations=60, budget=400, sh_degree=1)
AT = (0.0, 0.0, 0.5)


@pytest.fixture(scope="module")
def moved_ball(tmp_path_factory: pytest.TempPathFactory) -> sg.Transfer:
    """Return the transfer of a ball between two captures, one given as a path and one as a value."""
    root = tmp_path_factory.mktemp("transfer")
    photograph(root / "source", plane((0.3, 0.5, 0.3)), ball())
    photograph(root / "target", plane((0.5, 0.45, 0.6)), None)
    target = sg.read_capture(root / "target")
    return sg.transfer(root / "source", target, at=AT, quality=SHORT, project=root / "project")


@pytest.mark.long
def test_the_result_is_that_of_its_project_and_a_second_call_repeats_nothing(moved_ball: sg.Transfer):
    result = Layout(moved_ball.project).result
    assert torch.equal(moved_ball.scene.means, sg.load(result / "scene.ply").means)
    assert sg.stale_steps(moved_ball.project).keys() == {"evaluate"}
    before = contents(moved_ball.project / "relit"), (result / "step.json").stat().st_mtime_ns
    source, target = (moved_ball.project / "given" / "target", moved_ball.project.parent / "source")[::-1]
    again = sg.transfer(source, sg.read_capture(target), at=AT, quality=SHORT, project=moved_ball.project)
    assert (contents(again.project / "relit"), (result / "step.json").stat().st_mtime_ns) == before


@pytest.mark.long
def test_the_object_moves_and_is_lit_anew(moved_ball: sg.Transfer):
    def middle(one: sg.Transfer) -> torch.Tensor:
        assert one.result.is_object is not None
        return one.scene.means[one.result.is_object].median(0).values

    there = moved_ball.moved((0.5, 0.0, 0.5))
    # the object rests on the plane's reconstruction, whose points lie 0.18 apart
    assert (middle(there) - middle(moved_ball))[:2].tolist() == pytest.approx([0.5, 0.0], abs=0.05)
    assert there.light is not None
    bright = sg.Light((sg.LightSource((0.0, 0.0, 1.0), (9.0, 0.0, 0.0)),), there.light.ambient)
    red = there.moved(light=bright).scene.sh[there.result.is_object, 0].mean(0)
    plain = there.scene.sh[there.result.is_object, 0].mean(0)
    assert float(red[0] - red[2]) > float(plain[0] - plain[2]) + 0.1


@pytest.mark.long
def test_it_is_saved_by_suffix(moved_ball: sg.Transfer, tmp_path: Path):
    moved_ball.save(tmp_path / "scene.ply")
    assert sg.load(tmp_path / "scene.ply").count == moved_ball.scene.count
    with pytest.raises(ValueError, match=r"scene\.xyz: expected a file that ends in"):
        moved_ball.save(tmp_path / "scene.xyz")


def test_a_project_of_somebody_else_is_kept(tmp_path: Path):
    (tmp_path / "project.toml").write_text("# mine\n")
    with pytest.raises(ValueError, match=r"project\.toml: expected no project, or one that transfer wrote"):
        sg.transfer(tmp_path, tmp_path, project=tmp_path)
    assert (tmp_path / "project.toml").read_text() == "# mine\n"
    with pytest.raises(ValueError, match="nowhere: expected photos"):
        sg.transfer(tmp_path / "nowhere", tmp_path, project=tmp_path / "new")
    assert not (tmp_path / "new" / "project.toml").exists()


@pytest.mark.long
def test_two_trained_scenes_need_no_photographs(tmp_path: Path):
    source, target = concatenate([plane((0.3, 0.5, 0.3)), ball()]), plane((0.5, 0.45, 0.6))
    found = sg.transfer(source, target, at=AT, project=tmp_path / "project")
    own = found.composite.objects[0].in_target().means
    # the ball has a radius of 0.25 and stands on the plane z = 0; virtual cameras give its scale
    assert own[:, :2].median(0).values.abs().max() < 0.1
    assert len(found.cameras) >= 8
    assert math.isfinite(float(found.scene.sh.sum()))
