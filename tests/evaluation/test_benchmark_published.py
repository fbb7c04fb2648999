"""Published data sets: scenes are found by the layout, and missing folders are named."""

import huggingface_hub
import pytest
import torch

from splatgraft.core.cameras import Cameras
from splatgraft.core.images import write_image
from splatgraft.core.posed_images import PosedImages
from splatgraft.evaluation.benchmark.published_datasets import DOT3D, SYNCOM, download, find_scenes, method_pictures
from splatgraft.formats import write_capture


def write_small_capture(folder):
    (folder / "images").mkdir(parents=True)
    path = folder / "images" / "0000.png"
    write_image(path, torch.full((8, 10, 3), 0.5))
    intrinsics = torch.tensor([[[10.0, 0, 5], [0, 10.0, 4], [0, 0, 1]]])
    cameras = Cameras(torch.eye(4)[None], intrinsics, torch.tensor([[10, 8]]), ("0000.png",))
    write_capture(folder, PosedImages((path,), cameras, torch.zeros(0, 3), torch.zeros(0, 3)))


def test_scenes_of_all_parts_are_found_with_truth_or_without(tmp_path):
    for part, name, roles in (
        ("data_3d/synthetic/insertions", "kitchen", ("source", "target", "ground_truth")),
        ("data_3d/real/insertions", "desk", ("source", "target")),
        ("data_rotation", "hall", ("object", "background", "gt")),
    ):
        for role in roles:
            write_small_capture(tmp_path / part / name / role)
    found = {scene.name: scene for scene in find_scenes(DOT3D, tmp_path)}
    assert set(found) == {"kitchen", "desk", "hall"}
    assert found["desk"].truth is None
    assert found["hall"].truth == tmp_path / "data_rotation" / "hall" / "gt"


def test_a_folder_of_another_kind_is_refused_with_what_was_looked_for(tmp_path):
    with pytest.raises(ValueError, match=r"expected nviolante/dot3d with data_3d/synthetic/insertions/SCENE/"):
        find_scenes(DOT3D, tmp_path)
    with pytest.raises(ValueError, match=r"expected yGaoJiany/SynCom with"):
        find_scenes(SYNCOM, tmp_path)


def test_a_scene_without_a_target_is_named(tmp_path):
    write_small_capture(tmp_path / "data_rotation" / "hall" / "source")
    with pytest.raises(ValueError, match=r"hall: expected the target in a folder named target, background"):
        find_scenes(DOT3D, tmp_path)


def test_published_results_are_one_folder_a_method(tmp_path):
    (tmp_path / "results" / "ours" / "kitchen").mkdir(parents=True)
    assert method_pictures(DOT3D, tmp_path) == {"ours": tmp_path / "results" / "ours"}
    with pytest.raises(ValueError, match="expected one folder per method"):
        method_pictures(SYNCOM, tmp_path)


def test_a_hub_that_cannot_be_reached_is_one_line(tmp_path, monkeypatch):
    def unreachable(*_, **__):
        raise OSError("no route\nto host")

    monkeypatch.setattr(huggingface_hub, "snapshot_download", unreachable)
    with pytest.raises(ValueError, match=r"datasets/nviolante/dot3d: expected to fetch .*no route to host$"):
        download(DOT3D, tmp_path)


def test_what_is_fetched_are_the_documented_parts(tmp_path, monkeypatch):
    asked = {}
    monkeypatch.setattr(huggingface_hub, "snapshot_download", lambda repo, **how: asked.update(repo=repo, **how))
    download(DOT3D, tmp_path)
    assert asked["repo"] == "nviolante/dot3d"
    assert asked["repo_type"] == "dataset"
    assert asked["allow_patterns"] == [
        "data_3d/synthetic/insertions/**",
        "data_3d/real/insertions/**",
        "data_rotation/**",
    ]
