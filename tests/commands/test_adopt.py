"""`adopt` of a scene from another tool: its messages, and the effect of --axes and the capture."""

from pathlib import Path

import pytest
import torch
from shapes import blobs

from splatgraft import formats
from splatgraft.cli import main
from splatgraft.core.gaussians import Gaussians
from splatgraft.formats.scenes.axes import change_axes, rdf_from
from splatgraft.steps.adopt import misfit_of
from splatgraft.workflow.flow import read_flow

TOOLS = Path(__file__).parents[1] / "formats" / "golden" / "tools"


def adopted(folder: Path, *options: str) -> Gaussians:
    assert main(["adopt", *options, "--out", str(folder / "scene")]) == 0
    return formats.read_gaussians(folder / "scene" / "scene.ply")


@pytest.mark.parametrize("name", ["scene.sog", "scene.glb", "scene.v4.spz", "scene.level2.ksplat", "scene.gsplat.ply"])
def test_each_format_becomes_a_scene_and_says_its_axes(tmp_path, capsys, name):
    found = adopted(tmp_path, str(TOOLS / name))
    assert torch.equal(found.means, formats.read_gaussians(TOOLS / name).means)
    said = capsys.readouterr().err
    assert "40 Gaussians, SH degree" in said
    assert f"its axes are read as {formats.read_scene(TOOLS / name).axes}" in said


def test_axes_are_named_by_hand(tmp_path):
    turned = adopted(tmp_path, str(TOOLS / "scene.unturned.spz"), "--axes", "RDF")
    original = formats.read_gaussians(TOOLS / "scene.ply")
    assert float(torch.cdist(original.means, turned.means).min(1).values.max()) < 1e-3  # 12 fractional bits


def test_axes_that_are_none_end_in_one_line(tmp_path, capsys):
    assert main(["adopt", str(TOOLS / "scene.ply"), "--axes", "RRR", "--out", str(tmp_path / "scene")]) == 2
    assert "expected directions of x, y and z" in capsys.readouterr().err
    assert not (tmp_path / "scene").exists()


def test_a_project_names_the_axes_once(tmp_path):
    side = '[{}]\nscene = "{}"\naxes = "RDF"\n'
    scene = TOOLS / "scene.unturned.spz"
    (tmp_path / "project.toml").write_text(side.format("source", scene) + side.format("target", scene))
    steps = read_flow(tmp_path).steps
    for name in ("source/capture", "source/reconstruct", "target/reconstruct"):
        assert steps[name].axes == "RDF"


def table(n: int = 3000) -> Gaussians:
    """Return a surface without symmetry: a wide plate and a tower off its middle."""
    g = torch.Generator().manual_seed(0)
    means = torch.rand(n, 3, generator=g) * torch.tensor([4.0, 0.1, 2.0])
    means[: n // 4] = torch.rand(n // 4, 3, generator=g) * torch.tensor([0.3, -2.0, 0.4]) + torch.tensor([0.5, 0, 0.2])
    return blobs(means, 0.02)


def test_a_scene_that_lies_elsewhere_than_its_capture_is_said_to_with_the_axes_in_which_it_would_fit():
    scene = table()
    points = scene.means[::7]
    assert misfit_of(formats.SceneFile(scene), points + 0.005) is None
    for axes in ("RUB", "LUF", "RFU"):
        wrong = change_axes(scene, rdf_from(axes).T)  # read as RDF, although it is `axes`
        assert f'set axes = "{axes}"' in (misfit_of(formats.SceneFile(wrong), points) or "")
    assert "another frame" in (misfit_of(formats.SceneFile(scene), 10 * points + 3) or "")
    # few points decide nothing
    assert misfit_of(formats.SceneFile(scene), torch.randn(5, 3) * 100) is None
