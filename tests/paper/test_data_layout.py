"""Scenes of the authors' data set, matching of pictures to views, and the paper's numbers."""

import pytest
import torch
from paper_data import put

from splatgraft_paper.tables.layout import find_scenes, held_out_stems, match_views, pictures
from splatgraft_paper.tables.measure_pictures import padded_ssim
from splatgraft_paper.tables.paper_numbers import ROTATION, SYNTHETIC, UPDATES, published_name

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


def test_the_papers_numbers_are_whole_rows():
    for table in (SYNTHETIC, ROTATION, UPDATES):
        assert all(len(row) == len(table.columns) for row in table.rows.values())
    assert SYNTHETIC.value("Ours", "psnr") == 22.53


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
