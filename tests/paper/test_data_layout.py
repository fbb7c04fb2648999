"""Scenes of the authors' data set and the matching of pictures to views."""

import json
import os
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from paper_data import put
from shapes import ring
from tiny_project import ball, plane

from splatgraft.cli import main
from splatgraft.core.gaussians import concatenate
from splatgraft.core.images import read_rgb
from splatgraft.formats import read_cameras, read_gaussians, write_cameras
from splatgraft.rendering import render
from splatgraft.runtime.console import Console
from splatgraft.steps.segment import Segment
from splatgraft_paper.benchmark.image_features import INCEPTION_FILE, frechet_distance
from splatgraft_paper.benchmark.scene import perform_if_stale
from splatgraft_paper.tables.layout import find_scenes, held_out_stems, match_views, pictures
from splatgraft_paper.tables.measure_pictures import MeasurePictures, MetricOptions, padded_ssim, pooled_distances
from splatgraft_paper.tables.paper_numbers import published_name

SOFA, TRUCK = "bathtub_57e_in_blend_57eadb", "truck_in_garden"
GREY = torch.full((12, 16, 3), 0.5)


def test_views_are_in_the_order_of_their_numbers_and_every_8th_is_held_out(tmp_path):
    for index in (0, 1, 2, 10, 9):
        put(tmp_path / f"frame_{index}.png", GREY)
    assert list(pictures(tmp_path)) == ["frame_0", "frame_1", "frame_2", "frame_9", "frame_10"]
    assert held_out_stems([str(i) for i in range(17)]) == ["0", "8", "16"]


def test_pictures_are_matched_by_name_then_by_number_and_never_by_chance(tmp_path):
    views = [f"r_{i}" for i in range(16)]
    by_name = {"r_3": tmp_path / "r_3.png", "r_8": tmp_path / "r_8.png"}
    assert list(match_views(views, by_name)[0]) == ["r_3", "r_8"]
    all_of_them = {f"{i:05d}": tmp_path / f"{i:05d}.png" for i in range(16)}
    assert match_views(views, all_of_them)[0]["r_15"] == tmp_path / "00015.png"
    held_out = {f"{i:05d}": tmp_path / f"{i:05d}.png" for i in range(2)}
    assert match_views(views, held_out)[0] == {"r_0": tmp_path / "00000.png", "r_8": tmp_path / "00001.png"}
    assert match_views(views, {"00000": tmp_path / "a.png"})[0] == {}
    assert match_views(views, {"a": tmp_path / "a.png", "b": tmp_path / "b.png"})[0] == {}


def test_scenes_their_captures_and_the_authors_pictures_are_found_by_the_layout(tmp_path):
    for role in ("gt", "background"):
        put(tmp_path / "data_3d/synthetic/insertions/truck_in_garden" / role / "0.png", GREY)
    put(tmp_path / "data_3d/synthetic/scenes/objects/truck/images/0.png", GREY)
    put(tmp_path / "results_3d/synthetic/3dgs_dr/truck_in_garden/0.png", GREY)
    for pose in ("90", "00"):
        put(tmp_path / "data_rotation/yard" / pose / "gt" / "0.png", GREY)
        put(tmp_path / "results_rotation/ours/yard" / pose / "0.png", GREY)
    plain, first, second = find_scenes(tmp_path)
    assert set(plain.folders) == {"truth", "background"}
    assert set(plain.files) == {"source_capture"}
    assert list(plain.results) == ["3DGS-DR"]
    assert [(scene.name, scene.pose) for scene in (first, second)] == [("yard_00", "P0"), ("yard_90", "P1")]
    assert first.results["Ours"] == tmp_path / "results_rotation/ours/yard/00"
    with pytest.raises(ValueError, match="expected data_3d or data_rotation in it, found neither"):
        find_scenes(tmp_path / "data_3d")


def test_names_of_methods_are_those_of_the_paper():
    assert [published_name(name) for name in ("ours", "gaussian_shader", "GS-IR", "3dgs-dr", "lbm")] == [
        *("Ours", "GShader", "GS-IR", "3DGS-DR", "lbm")
    ]


def test_padded_ssim_counts_border_pixels_beside_zeros():
    a, b = torch.rand(30, 40, 3), torch.rand(30, 40, 3)
    from skimage.metrics import structural_similarity

    _, wanted = structural_similarity(
        *(torch.nn.functional.pad(x, (0, 0, 5, 5, 5, 5)).double().numpy() for x in (a, b)),
        **{"channel_axis": 2, "gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False},
        data_range=1.0,
        full=True,
    )
    # float32 against float64: 1e-6 of values up to 1, divided by the constant 0.03^2 at worst
    assert float(padded_ssim(a, b)) == pytest.approx(float(wanted[5:-5, 5:-5].mean()), abs=1e-4)


def tables(data, out, *words):
    """Run the command on pictures alone; returns its exit code and paper.json."""
    code = main(["paper", "tables", "--data", str(data), "--out", str(out), "--measure-only", *words])
    return code, json.loads((out / "paper.json").read_text())


LAYOUTS = {
    # truth, the authors' pictures of a scene and of a pose, poses, names
    "as documented": ("gt", "{method}/{scene}", "ours/yard/{pose}", "yard/{pose}", ()),
    "scene first, flat poses": ("GT", "{scene}/{method}", "yard_{pose}/ours", "yard_{pose}", ("truth=GT",)),
    "deeper": (
        *("test/gt", "{method}/{scene}/test/renders", "yard/{pose}/test/renders", "yard/{pose}"),
        ("truth=test/gt", "results=test/renders"),
    ),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_each_layout_of_the_data_set_is_measured(tmp_path, layout):
    truth, shown, turned, pose_folder, names = LAYOUTS[layout]
    data, poses = tmp_path / "data", ("000", "120", "240")
    for stem in ("0", "1"):
        put(data / "data_3d/synthetic/insertions" / SOFA / truth / f"{stem}.png", GREY)
        for method in ("ours", "gs-ir"):
            place = shown.format(method=method, scene=SOFA)
            put(data / "results_3d/synthetic" / place / f"{stem}.png", GREY * 0.8)
        for pose in poses:
            put(data / "data_rotation" / pose_folder.format(pose=pose) / truth / f"{stem}.png", GREY)
            put(data / "results_rotation" / turned.format(pose=pose) / f"{stem}.png", GREY * 0.8)
    code, found = tables(data, tmp_path / "a" / "new" / "folder", *(["--names", *names] if names else []))
    assert code == 0
    rows = {(row["scene"], row["method"], row["pose"]) for row in found["measured"]}
    assert rows == {(SOFA, "Ours", ""), (SOFA, "GS-IR", "")} | {
        (f"yard_{pose}", "Ours", f"P{number}") for number, pose in enumerate(poses)
    }
    assert "1 of 9 synthetic, 0 of 7 real, 3 of 9 rotation" in found["notes"][0]


def test_other_names_end_in_exit_1_with_the_names_that_are_there(tmp_path, capsys):
    data = tmp_path / "data"
    for name in ("GT", "alpha"):
        put(data / "data_3d/synthetic/insertions" / SOFA / name / "0.png", GREY)
        put(data / "data_rotation/yard_0" / name / "0.png", GREY)
    code, found = tables(data, tmp_path / "out")
    assert code == 1
    said = " ".join(capsys.readouterr().err.split())
    assert f"{SOFA}: expected gt/ (truth), found GT/, alpha/; other names: --names truth=NAME" in said
    assert "0 of 9 synthetic, 0 of 7 real, 0 of 9 rotation" in found["notes"][0]
    assert main(["paper", "tables", "--data", str(data), "--names", "truht=GT"]) == 2
    assert "expected ROLE=NAME with ROLE of truth, background" in capsys.readouterr().err


def test_scenes_are_compared_with_those_that_the_data_set_s_card_names(tmp_path):
    for name in (TRUCK, "chair_in_attic"):
        put(tmp_path / "data/data_3d/real/insertions" / name / "composite/0.png", GREY)
    code, found = tables(tmp_path / "data", tmp_path / "out")
    assert code == 0
    absent, others = found["notes"][1:3]
    assert "desk_in_london_bedroom, locomotive_in_train" in absent
    assert TRUCK not in absent
    assert others == "Real scenes that its card does not name: chair_in_attic."


@pytest.mark.long
def test_our_methods_run_on_pasted_pictures_and_masks_alone(tmp_path, monkeypatch):
    monkeypatch.setattr("splatgraft_paper.benchmark.scene.Segment", partial(Segment, solidify=4))
    scene = tmp_path / "data/data_3d/real/insertions" / TRUCK
    ground, thing, cameras = plane((0.6, 0.6, 0.7)), ball(), ring(10, radius=1.6, height=1.0, size=(48, 36), focal=45.0)
    both = concatenate([ground, thing])
    is_object = (torch.arange(both.count) >= ground.count)[:, None].float()
    pasted, empty = render(both, cameras, features=is_object), render(ground, cameras)
    for index, name in enumerate(cameras.names):
        stem = Path(name).stem
        put(scene / "composite" / f"{stem}.png", pasted.color[index].clamp(0, 1))
        put(scene / "background" / f"{stem}.png", empty.color[index].clamp(0, 1))
        put(scene / "masks" / f"{stem}.png", pasted.features[index].expand(-1, -1, 3).clamp(0, 1))
    write_cameras(scene / "transforms.json", cameras)
    words = ["--iterations", "40", "--budget", "400", "--device", "cpu"]
    data = ["--data", str(tmp_path / "data"), "--out", str(tmp_path / "out")]
    assert main(["paper", "tables", *data, "--methods", "transfer", *words]) == 0
    work = tmp_path / "out/scenes" / TRUCK
    assert len(list((work / "pictures/transfer").glob("*.png"))) == 2
    # the object is cut out at its place, without the two held-out views; the ball's centre is 0.3 above the ground
    assert len(read_cameras(work / "source/capture")) == 8
    means = read_gaussians(work / "object/object.ply").means
    assert torch.allclose(means.median(0).values, torch.tensor([0, 0, 0.3]), atol=0.15)


def test_fid_over_scenes_comes_from_the_features_that_each_scene_keeps(tmp_path, monkeypatch):
    generator = torch.Generator().manual_seed(0)
    asked = []

    def features(images):
        asked.append(len(images))
        return np.stack([image.mean((0, 1)).double().numpy() for image in images])

    monkeypatch.setattr("splatgraft_paper.tables.measure_pictures.inception_features", lambda folder: features)
    (tmp_path / INCEPTION_FILE).write_bytes(b"weights")
    steps, everything = [], {"made": [], "true": []}
    for scene in ("a", "b"):
        for stem in ("0", "1", "2"):
            for kind, images in everything.items():
                put(tmp_path / scene / kind / f"{stem}.png", torch.rand(12, 16, 3, generator=generator))
                images.append(read_rgb(tmp_path / scene / kind / f"{stem}.png"))
        options = MetricOptions(tmp_path, fid=True)
        folders = (tmp_path / scene / "made", tmp_path / scene / "true", tmp_path / scene / "out")
        steps.append(MeasurePictures(*folders, options, all_views=True))
        perform_if_stale(steps[-1], Console())
    count = len(asked)
    found = pooled_distances({"both": steps, "one": steps[:1]})
    made, true = (features(images) for images in everything.values())
    assert found["both"]["fid"] == pytest.approx(frechet_distance(made, true))
    assert found["one"]["fid"] == pytest.approx(frechet_distance(made[:3], true[:3]))
    # nothing is computed again, but with other weights
    for changed in (False, True):
        if changed:
            os.utime(tmp_path / INCEPTION_FILE, ns=(0, 0))
        asked.clear()
        perform_if_stale(steps[0], Console())
        assert len(asked) == (3 if changed else 0)
    assert count == 6
