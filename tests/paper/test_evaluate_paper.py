"""`paper tables` on a folder of the published data set: measured numbers, published ones, reasons, and our rows."""

import json
import re
import shutil
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from paper_data import PLAIN, STEMS, parts_of_view, put, write_data
from random_lpips import write_random_lpips
from shapes import ring, surfels
from tiny_models import CHANNELS, flux_folder
from tiny_pairs import relit_folder

from splatgraft.cli import main
from splatgraft.core.gaussians import concatenate
from splatgraft.core.image_metrics import psnr
from splatgraft.core.images import read_rgb, write_image
from splatgraft.formats import read_gaussians, write_cameras, write_gaussians
from splatgraft.harmonization import FluxOptions, HarmonizerInputs, make_harmonizer
from splatgraft.rendering import render
from splatgraft.runtime.console import Console
from splatgraft_paper.commands.tables import EvaluatePaper
from splatgraft_paper.tables.report import _changed_part
from splatgraft_paper.training.pairs import DataOptions, open_training_data


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """Run the command with --measure-only."""
    root = tmp_path_factory.mktemp("published")
    command = EvaluatePaper(write_data(root / "dot3d_data").parent, root / "out", measure_only=True)
    assert command.execute(Console()) == 0
    return command


def by_scene_and_method(command):
    found = json.loads((command.out / "paper.json").read_text())
    return {(row["scene"], row["method"]): row for row in found["measured"]}, found


def test_published_pictures_have_the_numbers_of_their_held_out_views(measured):
    rows, _ = by_scene_and_method(measured)
    row = rows[PLAIN, "Ours"]
    wanted = []
    for stem in STEMS[::8]:
        truth = read_rgb(measured.data / "dot3d_data/data_3d/synthetic/insertions" / PLAIN / "gt" / f"{stem}.png")
        mine = read_rgb(measured.data / "dot3d_data/results_3d/synthetic/ours" / PLAIN / f"{stem}.png")
        wanted.append(float(psnr(mine, truth)))
    assert row["values"]["psnr"] == pytest.approx(sum(wanted) / 3)
    assert row["values"]["flip"] > 0
    assert row["by"] == "the authors"
    assert row["protocol"]["view_count"] == 3
    assert row["protocol"]["resolution"] == ["224x158"]
    assert "held out: every 8th" in row["protocol"]["views"]


def test_numbered_pictures_of_3dgs_are_the_held_out_views_in_order(measured):
    rows, _ = by_scene_and_method(measured)
    row = rows["bathroom_rot_120", "Ours"]
    assert "the held-out 3 views by order" in row["protocol"]["matched"]
    assert row["pose"] == "P1"
    # the truth times 0.9 in all views, rounded to 8 bits: 0.5 of 25.5 levels at most
    truth = torch.stack([parts_of_view(stem)[0] for stem in STEMS[::8]])
    assert row["values"]["psnr"] == pytest.approx(float(psnr(truth * 0.9, truth)), abs=0.4)


def test_the_tables_have_published_numbers_beside_measured_ones_and_notes_say_what_is_missing(measured):
    text = (measured.out / "paper.md").read_text()
    assert "| Ours, as published | 22.53 | 0.840 | 0.214 | 0.214 | 55.86 | 0.0413 |" in text
    line = next(row for row in text.splitlines() if row.startswith("| GS-IR, the authors' pictures, measured here"))
    # both scenes show the same pictures, so the interval of their mean is a point
    assert line.count("[") == 3
    assert line.endswith("| 2 |")
    assert "| GShader, the authors' pictures, measured here | – | – | – | – | – | – | – | 0 |" in text
    assert "--measure-only: nothing was run" in text
    assert "Not measured: lpips" in text
    page = (measured.out / "index.html").read_text()
    assert "figures/synthetic.png" in page
    assert (measured.out / "figures" / "rotation.png").is_file()
    assert (measured.out / "figures" / "real.png").is_file()


def test_pictures_of_another_size_or_of_other_views_are_said_and_leave_their_cells_empty(measured, tmp_path):
    root = tmp_path / "data"
    for stem in STEMS:
        truth = parts_of_view(stem)[0]
        put(root / "data_3d/synthetic/insertions" / PLAIN / "gt" / f"{stem}.png", truth)
        put(root / "results_3d/synthetic/ours" / PLAIN / f"{stem}.png", truth[:100])
        put(root / "results_3d/synthetic/gs_ir" / PLAIN / f"other_{stem}.png", truth)
    command = replace(measured, data=root, out=tmp_path / "out")
    assert command.execute(Console()) == 1
    _, found = by_scene_and_method(command)
    reasons = {row["method"]: row["reason"] for row in found["missing"]}
    assert "expected 224x100 pixels as the method's picture, found 224x158" in reasons["Ours"]
    assert "none of 17 pictures fits 17 views" in reasons["GS-IR"]


def test_a_second_run_measures_nothing_again(measured):
    files = sorted(measured.out.glob("measured/*/*/metrics.json"))
    before = {path: path.stat().st_mtime_ns for path in files}
    assert measured.execute(Console()) == 0
    assert {path: path.stat().st_mtime_ns for path in files} == before


def write_placed_scene(root):
    """Return a table and a ball of Gaussians that already is on it, with cameras, and the composite as the truth."""
    generator = torch.Generator().manual_seed(0)
    table = torch.cat([4 * torch.rand(400, 2, generator=generator) - 2, torch.zeros(400, 1)], 1)
    up = torch.tensor([0.0, 0.0, 1.0])
    normals = torch.nn.functional.normalize(torch.randn(150, 3, generator=generator), dim=1)
    ball = surfels(normals * 0.4 + torch.tensor([0, 0, 0.4]), normals, width=0.08, srgb=(0.8, 0.3, 0.2))
    plane = surfels(table, up.expand(400, 3), width=0.15, srgb=(0.4, 0.5, 0.4))
    scene = root / "data_3d/synthetic/insertions" / PLAIN
    cameras = ring(10, size=(64, 48), focal=50.0)
    for name, gaussians in (("object.ply", ball), ("background.ply", plane)):
        scene.mkdir(parents=True, exist_ok=True)
        write_gaussians(scene / name, gaussians)
    write_cameras(scene / "transforms.json", cameras)
    both = concatenate([plane, ball])
    for index, name in enumerate(cameras.names):
        image = render(both, cameras[index]).color[0].clamp(0, 1)
        put(scene / "gt" / f"{Path(name).stem}.png", image)
    return root


def test_table_2_stands_beside_the_disagreement_of_views_its_worst_scene_and_insets(tmp_path):
    data = write_placed_scene(tmp_path / "data")
    for number, pose in enumerate(("000", "120")):
        shutil.copytree(data / "data_3d/synthetic/insertions" / PLAIN, data / "data_rotation/yard" / pose)
        for path in (data / "data_rotation/yard" / pose / "gt").iterdir():
            write_image(path, (read_rgb(path) - 0.1 * number).clamp(0, 1))
    shutil.rmtree(data / "data_3d")
    words = ["paper", "tables", "--data", str(data), "--out", str(tmp_path / "out"), "--methods", "copy-paste"]
    assert main([*words, "--device", "cpu"]) == 0
    found = json.loads((tmp_path / "out/paper.json").read_text())
    first, second = (row["values"] for row in found["measured"])
    # the first truth is a render of the same Gaussians, but for those that compose flattens, in 8 bits
    assert first["disagreement"] == pytest.approx(first["disagreement_truth"], abs=0.01)
    assert 0 < second["disagreement_truth"] != first["disagreement_truth"]
    text = (tmp_path / "out/paper.md").read_text()
    beside = text[text.index("### Illumination") : text.index("### Dataset")]
    assert f"| P1 | copy-paste | {second['disagreement']:.4f} | {second['disagreement_truth']:.4f} | 1 |" in beside
    # the second truth is darker than its result by 0.1: 20 dB
    assert re.search(r"!\[worst of rotation: yard_120, (19|20|21)\.\d\d dB by copy-paste\]", beside)
    # pictures of 64x48 at a height of 200, and the insets below
    assert read_rgb(tmp_path / "out/figures/rotation_worst.png").shape[0] == 404


def test_insets_show_where_the_object_changes_the_picture():
    truth = torch.full((60, 90, 3), 0.5)
    composite = truth.clone()
    composite[42:52, 10:30] = 0.9
    part = _changed_part({"composite": composite, "truth": truth})
    assert composite[part].shape == (20, 30, 3)
    # all 200 changed pixels are in the part
    assert int((composite[part] != 0.5).all(-1).sum()) == 200


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Make every table at toy size: tiny weights of the harmoniser, random ones of LPIPS."""
    pytest.importorskip("diffusers")
    root = tmp_path_factory.mktemp("whole")
    (root / "weights").mkdir()
    write_random_lpips(root / "weights")
    flux = flux_folder(root / "image-mask", 12 * CHANNELS)
    command = EvaluatePaper(
        write_placed_scene(root / "data"),
        root / "out",
        weights=root / "weights",
        harmonizer_weights=str(flux),
        models=(f"paper={flux}", f"without-flux={flux}", f"mine={flux}"),
        generated=(str(relit_folder(root / "pairs")),),
        pairs_size="32x32",
        iterations_of_consolidation=3,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert command.execute(Console()) == 0
    return command


@pytest.mark.long
def test_our_methods_run_on_a_composite_that_is_already_placed(whole):
    rows, found = by_scene_and_method(whole)
    assert found["missing"] == []
    assert {"copy-paste", "paper", "paper/paper-l1-dssim", "paper@linear"} <= {m for _, m in rows}
    # the truth is a render of the same Gaussians, but for the table, which compose presses flat under the ball's foot
    assert rows[PLAIN, "copy-paste"]["values"]["psnr"] > 40
    assert rows[PLAIN, "copy-paste"]["values"]["lpips"] is not None
    assert rows[PLAIN, "paper"]["seconds"]["consolidate"] > 0
    seen = json.loads((whole.out / "scenes" / PLAIN / "target/capture/transforms.json").read_text())["frames"]
    assert len(seen) == 8


def test_the_paper_s_row_pastes_the_object_as_it_is_and_each_table_s_head_says_how_rows_were_made(whole):
    pasted, ours = (
        read_gaussians(whole.out / "scenes" / PLAIN / folder / "composite/scene.ply") for folder in ("as_paper", "")
    )
    scene = whole.data / "data_3d/synthetic/insertions" / PLAIN
    given = concatenate([read_gaussians(scene / name) for name in ("background.ply", "object.ply")])
    # a .ply has float32; the object's turn by the identity rounds quaternions
    assert torch.equal(pasted.means, given.means)
    assert torch.allclose(pasted.covariances, given.covariances, atol=1e-7)
    assert ours.count != given.count or not torch.allclose(ours.means, given.means, atol=1e-3)
    parts = (whole.out / "paper.md").read_text().split("### ")[1:]
    heads = [part.splitlines()[2] for part in parts if "\n| " in part]
    assert len(set(heads)) == 1
    for words in (
        "paper: quality full (30,000 steps), masks by BiRefNet",
        "ours: quality draft (1,000 steps)",
        "image-mask",
        "commit",
    ):
        assert words in heads[0]


def test_updates_1_3_and_5_are_pictured(whole):
    figure = read_rgb(whole.out / "figures" / "updates.png")
    # linear and geometric, three pictures of 64x48 each, with gaps of 2 and 4
    assert figure.shape == (2 * (48 + 4), 3 * 64 + 2 * 2, 3)
    folders = [whole.out / "scenes" / PLAIN / "updates" / "paper@linear" / str(number) for number in (1, 3, 5)]
    first, third, fifth = (read_rgb(next(folder.glob("*.png"))) for folder in folders)
    assert not torch.equal(first, third)
    assert not torch.equal(third, fifth)


def table(command, title):
    text = (command.out / "paper.md").read_text()
    return next(part for part in text.split("## ") if part.startswith(title)).splitlines()


def test_the_ablation_of_the_data_is_measured_on_each_source_s_test_split(whole):
    _, found = by_scene_and_method(whole)
    assert set(found["by_model"]) == {"Ours", "w/o Flux", "mine"}
    assert found["by_model"]["Ours"] == found["by_model"]["mine"]
    # numpy computes it again, on the one held-out pair of three scenes
    data = open_training_data(DataOptions(generated=whole.generated, size="32x32"), 0, None)
    (pair, *rest) = data.held_out.all()
    read = [files.read() for files in (pair, *rest)]
    harmonizer = make_harmonizer(FluxOptions(weights=whole.harmonizer_weights))
    empty = torch.zeros(32, 32)
    scores = []
    for one in read:
        view = HarmonizerInputs(one.composite, one.background, one.mask, empty, one.composite)
        error = (harmonizer.harmonize(view) - one.target).numpy()
        scores.append(-10 * np.log10((error**2).mean()))
    assert found["by_model"]["Ours"]["psnr FLUX"] == pytest.approx(float(np.mean(scores)), abs=1e-3)
    assert found["by_model"]["Ours"]["psnr Average"] == found["by_model"]["Ours"]["psnr FLUX"]
    lines = table(whole, "Dataset ablation")
    assert any(line.startswith("| w/o Blender, as published | 25.69 | 0.870 | 0.164 | 47.78 |") for line in lines)
    assert any(line.startswith("| w/o Flux, measured here | – | – | – | – |") for line in lines)


def test_random_weights_are_never_printed_as_lpips(whole):
    text = (whole.out / "paper.md").read_text()
    assert "stand-in for LPIPS [-1, 1]" in text
    assert "stand-in for LPIPS [0, 1]" in text
    assert "| LPIPS" not in text
    assert "LPIPS [-1, 1]: the weights are not the published ones" in text
    assert "Not measured: fid and kid" in text


def test_costs_come_from_the_records_of_the_steps_and_a_dash_has_its_reason(whole):
    rows, _ = by_scene_and_method(whole)
    lines = {line.split(" | ")[0].strip("| "): line for line in table(whole, "Computational cost") if "|" in line}
    spent = rows[PLAIN, "paper"]["seconds"]["harmonize"] / 60
    none = "– (no method that ran has this step)"
    assert lines["harmonize"] == f"| harmonize | 12.50 | {spent:.2f} | {none} |"
    # the scene was already reconstructed
    assert lines["segment"] == f"| segment | 0.67 | {none} | {none} |"
    losses = table(whole, "Perceptual against photometric")
    assert any(line.startswith("| stand-in for LPIPS [-1, 1]: paper, run here |") for line in losses)
    assert any(line.startswith("| L1 and SSIM: paper/paper-l1-dssim, run here |") for line in losses)


def test_a_model_that_is_no_folder_or_without_pairs_is_one_line(whole, tmp_path, capsys):
    words = ["paper", "tables", "--data", str(whole.data), "--out", str(tmp_path / "out"), "--measure-only", "--models"]
    assert main([*words, "paper=nowhere"]) == 2
    assert "--models: expected NAME=FOLDER with existing folders, found paper=nowhere" in capsys.readouterr().err
    assert main([*words, f"paper={tmp_path}"]) == 2
    assert "--models: expected test pairs by --pairs, --generated or --orida, found none" in capsys.readouterr().err
