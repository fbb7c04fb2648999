"""Scenes as .usdz, read back by OpenUSD itself, and compared with NVIDIA's converter on the same .ply."""

import sys

import numpy as np
import pytest
import torch
from format_files import TOOLS, random_gaussians

from splatgraft import formats
from splatgraft.cli import main
from splatgraft.core.gaussians import empty
from splatgraft.core.rotations import rotation_from_quaternion
from splatgraft.formats.scenes.axes import change_axes, rdf_from

WRITTEN = TOOLS.parent / "written"


def read(path):
    """Return the attributes of the Gaussians in a stage, by OpenUSD."""
    usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom, UsdVol

    stage = usd.Stage.Open(str(path))
    (prim,) = [prim for prim in stage.Traverse() if prim.GetTypeName() == "ParticleField3DGaussianSplat"]
    g = UsdVol.ParticleField3DGaussianSplat(prim)
    q = g.GetOrientationsAttr().Get()
    found = {
        "positions": np.array(g.GetPositionsAttr().Get()),
        "scales": np.array(g.GetScalesAttr().Get()),
        "wxyz": np.array([[one.GetReal(), *one.GetImaginary()] for one in q]),
        "opacities": np.array(g.GetOpacitiesAttr().Get()),
        "sh": np.array(g.GetRadianceSphericalHarmonicsCoefficientsAttr().Get()),
        "degree": g.GetRadianceSphericalHarmonicsDegreeAttr().Get(),
        "element_size": g.GetRadianceSphericalHarmonicsCoefficientsAttr().GetMetadata("elementSize"),
    }
    return found | {"up": UsdGeom.GetStageUpAxis(stage), "metres": UsdGeom.GetStageMetersPerUnit(stage)}


def rotations(wxyz: np.ndarray) -> np.ndarray:
    return rotation_from_quaternion(torch.from_numpy(wxyz).float()).numpy()


def test_usd_finds_the_scene_with_y_up(tmp_path):
    pytest.importorskip("pxr.UsdVol")
    g = formats.read_gaussians(TOOLS / "scene.ply")
    formats.write_gaussians(tmp_path / "a.usdz", g, metadata=formats.SceneMetadata(metres_per_unit=0.25))
    found = read(tmp_path / "a.usdz")
    turn = np.diag([1.0, -1, -1])
    assert np.allclose(found["positions"], g.means.numpy() @ turn, atol=1e-6)
    assert np.allclose(found["scales"], g.scales.numpy(), rtol=1e-5)
    assert np.allclose(found["opacities"], g.opacities.numpy(), atol=1e-6)
    # the same ellipsoids: R S in the turned axes, up to the sign of an own axis
    axes = turn @ g.rotations.numpy()
    assert np.allclose(np.abs(np.einsum("nij,nij->nj", axes, rotations(found["wxyz"]))), 1, atol=1e-4)
    assert found["sh"].shape == (40 * 16, 3)
    assert (found["degree"], found["element_size"], found["up"], found["metres"]) == (3, 16, "Y", 0.25)


def test_values_are_those_of_another_converter(tmp_path):
    """usd-convert-gsplat 0.1.15 (NVIDIA, Apache-2.0) keeps the .ply's axes; our writer turns by half a turn about x."""
    pytest.importorskip("pxr.UsdVol")
    theirs = read(WRITTEN / "scene.usd-convert-gsplat.usdc")
    g = formats.read_gaussians(TOOLS / "scene.ply")
    # turned beforehand, so that the writer turns it back
    formats.write_gaussians(tmp_path / "a.usdz", change_axes(g, rdf_from("RUB")))
    ours = read(tmp_path / "a.usdz")
    for name in ("positions", "scales", "opacities", "sh"):
        assert np.allclose(ours[name], theirs[name], atol=2e-5), name
    assert np.allclose(rotations(ours["wxyz"]), rotations(theirs["wxyz"]), atol=1e-4)
    assert (ours["degree"], ours["element_size"]) == (theirs["degree"], theirs["element_size"])


def test_what_cannot_be_written(tmp_path):
    pytest.importorskip("pxr.UsdVol")
    with pytest.raises(ValueError, match=r"a\.usdz: expected at least one Gaussian for a \.usdz file, found none"):
        formats.write_gaussians(tmp_path / "a.usdz", empty())
    with pytest.raises(ValueError, match=r"expected an existing folder to write into"):
        formats.write_gaussians(tmp_path / "none" / "a.usdz", random_gaussians(3))
    assert list(tmp_path.iterdir()) == []


def test_without_usd_the_extra_is_named(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    formats.write_gaussians(tmp_path / "a.ply", random_gaussians(3))
    assert main(["export", str(tmp_path / "a.ply"), "--to", str(tmp_path / "a.usdz")]) == 2
    assert "pip install 'splatgraft[usd]'" in capsys.readouterr().err
