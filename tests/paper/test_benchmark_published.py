"""Published data sets: what is asked of the hub, and a hub that cannot be reached. Layouts: test_data_layout.py."""

import huggingface_hub
import pytest

from splatgraft_paper.tables.published_datasets import DOT3D, SYNCOM, download


def test_a_hub_that_cannot_be_reached_is_one_line(tmp_path, monkeypatch):
    def unreachable(*_, **__):
        raise OSError("no route\nto host")

    monkeypatch.setattr(huggingface_hub, "snapshot_download", unreachable)
    with pytest.raises(ValueError, match=r"datasets/nviolante/dot3d: expected to fetch .*no route to host$"):
        download(DOT3D, tmp_path)


def test_scenes_and_the_authors_results_are_fetched_wherever_the_card_puts_them(tmp_path, monkeypatch):
    asked = {}
    monkeypatch.setattr(huggingface_hub, "snapshot_download", lambda repo, **how: asked.update(repo=repo, **how))
    download(DOT3D, tmp_path)
    assert asked["repo"] == "nviolante/dot3d"
    assert asked["repo_type"] == "dataset"
    files = huggingface_hub.utils.filter_repo_objects(
        [
            "dot3d_data/results_3d/real/truck_in_garden/ours/0000.png",
            "results_rotation/bathroom/0.png",
            "data_3d/synthetic/insertions/sink_in_blend_92e6c7/gt/0000.png",
            "other/0.png",
        ],
        allow_patterns=asked["allow_patterns"],
    )
    assert len(list(files)) == 3


def test_of_syncom_the_linear_pictures_and_the_test_views_are_not_fetched(tmp_path, monkeypatch):
    asked = {}
    monkeypatch.setattr(huggingface_hub, "snapshot_download", lambda repo, **how: asked.update(repo=repo, **how))
    download(SYNCOM, tmp_path)
    assert asked["repo"] == "yGaoJiany/SynCom"
    wanted = [
        "composition/room_with_toy/transform.json",
        "composition/room_with_toy/images/0000.png",
        "scene/room/train/cameras.json",
        "object/toy/train/cameras.json",
        "object/toy/train/images/0000.png",
    ]
    others = ["object/toy/train/images/0000.exr", "object/toy/test/images/0000.png", "demo/room_with_toy/cameras.json"]
    found = huggingface_hub.utils.filter_repo_objects([*wanted, *others], allow_patterns=asked["allow_patterns"])
    assert list(found) == wanted
