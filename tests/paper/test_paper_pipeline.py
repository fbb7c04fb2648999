"""The paper's pipeline up to the composite (its Sec. 4), by the one switch: nothing of ours touches the object."""

import json
from pathlib import Path

import pytest
import torch

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

from tiny_project import ball, photograph, plane
from toy_reproduce import write_birefnet

from splatgraft.core.gaussians import concatenate
from splatgraft.core.images import read_rgb
from splatgraft.core.similarity import Similarity
from splatgraft.formats import read_cameras, read_gaussians
from splatgraft.project.placement import ObjectPlacement, Placement, write_placement
from splatgraft.reconstruction import ReconstructOptions
from splatgraft.rendering import render
from splatgraft.runtime.console import Console
from splatgraft.segmentation import LiftOptions
from splatgraft_paper.benchmark.methods import Method, MethodSettings, run_method
from splatgraft_paper.benchmark.scene import CompositionOptions, GroundTruthScene, compose_scene
from splatgraft_paper.peers.deferred_reflection import FitOptions


@pytest.fixture(scope="module")
def composed(tmp_path_factory):
    """Compose a ball on a plane by the paper's pipeline."""
    tmp_path = tmp_path_factory.mktemp("paper")
    photograph(tmp_path / "source", plane((0.3, 0.5, 0.3)), ball())
    photograph(tmp_path / "target", plane((0.5, 0.45, 0.6)), None, views=10)
    move = Similarity(0.5, torch.eye(3), torch.tensor([0.2, 0.1, 0.0]))
    write_placement(tmp_path / "placement.json", Placement((ObjectPlacement(move),)))
    files = [tmp_path / name for name in ("source", "target", "target", "placement.json")]
    options = CompositionOptions(
        ReconstructOptions(quality="draft", iterations=40, budget=500, device="cpu"),
        "cpu",
        write_birefnet(tmp_path / "birefnet.onnx", bright=0),
        Method.parse("paper").pipeline,
        LiftOptions("bce", iterations=20),
    )
    return compose_scene(GroundTruthScene("yard", *files), tmp_path / "work", options, Console()), move


def test_the_object_is_cut_out_by_birefnet_and_cross_entropy_and_pasted(composed):
    made, move = composed
    work = made.work
    assert json.loads((work / "source/scene/step.json").read_text())["options"]["quality"] == "full"
    assert len(list((work / "masks/masks").glob("*.png"))) == 8
    segmented = json.loads((work / "object/step.json").read_text())
    assert (
        segmented["options"] | {"method": "bce", "solidify": 0, "keep_open": True, "keep": "all"}
        == segmented["options"]
    )
    assert {Path(entry[0]).suffix for entry in segmented["inputs"]["masks"]} == {".png"}
    # the paper's 40 seconds are those of the features alone
    assert {"mask", "segment"} <= set(made.seconds)
    # the object has Gaussians of the scene as they were fitted, and the composite has both parts as they are
    scene, taken = read_gaussians(work / "source/scene/scene.ply"), read_gaussians(work / "object/object.ply")
    assert 0 < taken.count < scene.count
    assert {tuple(row) for row in taken.means.tolist()} <= {tuple(row) for row in scene.means.tolist()}
    pasted = read_gaussians(made.composite / "scene.ply")
    both = concatenate([read_gaussians(made.target), move.gaussians(taken)])
    assert torch.allclose(pasted.means, both.means, atol=1e-6)  # float32 of numbers around 1
    assert torch.allclose(pasted.log_scales, both.log_scales, atol=1e-6)


@pytest.mark.long
def test_3dgs_dr_pictures_the_object_in_the_target_s_held_out_views(composed):
    made, _ = composed
    settings = MethodSettings(device="cpu", reflections=FitOptions(steps=16, panorama=(8, 16)))
    folder, seconds = run_method(Method.parse("3dgs-dr"), made, settings, Console())
    assert seconds["reflect"] > 0
    # every 8th of ten
    names = read_cameras(made.views).names
    assert [path.name for path in sorted(folder.glob("*.png"))] == [f"{Path(names[i]).stem}.png" for i in (0, 8)]
    picture = read_rgb(folder / f"{Path(names[0]).stem}.png")
    pasted = render(read_gaussians(made.composite / "scene.ply"), read_cameras(made.views)[0]).color[0].clamp(0, 1)
    # the red ball is where it is in the composite: pixels that are red there are redder than the others
    red = pasted[..., 0] - pasted[..., 2] > 0.3
    assert red.sum() > 5
    warmth = picture[..., 0] - picture[..., 2]
    assert warmth[red].mean() > warmth[~red].mean() + 0.2
    with pytest.raises(ValueError, match="expected no harmonizer after 3dgs-dr"):
        Method.parse("3dgs-dr+flux")


def test_the_switch_chooses_the_whole_pipeline_and_its_parts_can_be_replaced():
    whole = Method.parse("paper")
    assert (whole.harmonizer, whole.loss, whole.schedule, whole.pipeline) == ("flux", "paper", "once", "paper")
    other = Method.parse("paper/paper-l1-dssim@linear")
    assert (other.harmonizer, other.loss, other.schedule, other.pipeline) == (
        *("flux", "paper-l1-dssim", "linear", "paper"),
    )
    assert Method.parse("off+flux/paper").pipeline == "ours"
