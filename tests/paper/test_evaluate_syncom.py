"""`evaluate paper --dataset syncom` on a folder laid out as the card and the loader of its authors say."""

import json
import shutil
import tomllib
from dataclasses import replace

import pytest
import torch
from paper_data import parts_of_view, put
from syncom_data import COMPOSED, COMPOSITION, SCENE_FROM_OBJECT, write_syncom

from splatgraft.cli import main
from splatgraft.core.image_metrics import psnr
from splatgraft.formats.placement import read_placement
from splatgraft.reconstruction import ReconstructOptions
from splatgraft.runtime.console import Console
from splatgraft_paper.commands.tables import EvaluatePaper
from splatgraft_paper.tables.data_layout import as_toml, find_layout

QUICK = ReconstructOptions(quality="draft", device="cpu", iterations=100, budget=3000)


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """The command, run with --measure-only."""
    root = tmp_path_factory.mktemp("syncom")
    command = EvaluatePaper(
        write_syncom(root / "data", object_views=10), root / "out", dataset="syncom", measure_only=True, options=QUICK
    )
    assert command.execute(Console()) == 0
    return command


def results(command):
    found = json.loads((command.out / "paper.json").read_text())
    return {(row["scene"], row["method"]): row for row in found["measured"]}, found


def test_pictures_of_comgs_are_measured_in_every_view_of_the_composition(measured):
    rows, _ = results(measured)
    row = rows[COMPOSITION, "ComGS"]
    assert row["protocol"]["view_count"] == len(COMPOSED)
    assert row["protocol"]["views"] == "all"
    assert "all 6 views by order" in row["protocol"]["matched"]
    truth = torch.stack([parts_of_view(stem)[0] for stem in COMPOSED])
    # the truth times 0.9 in all views, rounded to 8 bits: 0.5 of 25.5 levels at most
    assert row["values"]["psnr_whole"] == pytest.approx(float(psnr(truth * 0.9, truth)), abs=0.4)


def test_the_table_has_comgs_published_range_and_says_what_its_protocol_gives(measured):
    text = (measured.out / "paper.md").read_text()
    assert "| ComGS, lowest number as published | 24.46 |" in text
    assert "| ComGS, highest number as published | 24.60 |" in text
    assert "| ComGS, its pictures, measured here |" in text
    assert "the ratio of the true to the estimated albedo" in text
    assert "of two protocols" in text
    assert "1 of 16 syncom" in text
    assert "Table 1" not in text
    assert text.count("PSNR by scene") == 1
    page = (measured.out / "index.html").read_text()
    assert "the ratio of the true to the estimated albedo" in page
    assert "figures/syncom.png" in page
    assert (measured.out / "figures" / "syncom.png").is_file()


def test_what_was_guessed_is_said_and_can_be_corrected(measured, tmp_path):
    layout = find_layout(measured.data, dataset="syncom")
    (scene,) = layout.scenes
    assert any("images: taken for the truth (a guess" in line for line in scene.taken)
    found = tomllib.loads((measured.out / "layout.toml").read_text())["scenes"][COMPOSITION]
    assert found["source_capture"] == "object/pot/train"
    assert found["target_capture"] == "scene/patio/train"
    assert found["placement"] == f"composition/{COMPOSITION}/transform.json"
    data = tmp_path / "data"
    shutil.copytree(measured.data, data)
    (data / f"composition/{COMPOSITION}/images").rename(data / f"composition/{COMPOSITION}/shaded")
    (unknown,) = find_layout(data, dataset="syncom").scenes
    assert "truth" not in unknown.folders
    assert any("shaded: not used; name it in layout.toml" in line for line in unknown.taken)
    (data / "layout.toml").write_text(f'[scenes.{COMPOSITION}]\ntruth = "composition/{COMPOSITION}/shaded"\n')
    corrected = replace(measured, data=data, out=tmp_path / "out")
    assert corrected.execute(Console()) == 0
    assert results(corrected)[0][COMPOSITION, "ComGS"]["values"]["psnr_whole"] > 0
    (data / "layout.toml").write_text(as_toml(find_layout(data, dataset="syncom")))
    assert find_layout(data, dataset="syncom").scenes[0].folders["truth"].name == "shaded"


def test_masks_and_a_composite_beside_the_truth_are_taken_by_their_names(tmp_path):
    root = write_syncom(tmp_path, object_views=1)
    put(root / f"composition/{COMPOSITION}/mask/0018.png", torch.ones(4, 4, 3))
    put(root / f"composition/{COMPOSITION}/depth/0018.png", torch.ones(4, 4, 3))
    (scene,) = find_layout(root, dataset="syncom").scenes
    assert scene.folders["masks"].name == "mask"
    assert scene.folders["truth"].name == "images"
    assert any("depth: not used" in line for line in scene.taken)


def test_a_folder_of_another_data_set_is_one_line(tmp_path, capsys):
    (tmp_path / "data_3d").mkdir()
    arguments = ["evaluate", "paper", "--dataset", "syncom", "--data", str(tmp_path), "--out", str(tmp_path / "out")]
    assert main(arguments) == 2
    assert "expected composition/SCENE_with_OBJECT in it, found data_3d" in capsys.readouterr().err


def test_our_methods_get_every_view_of_the_captures_and_the_placement(measured, tmp_path):
    command = replace(measured, out=tmp_path / "out", measure_only=False, methods=("copy-paste",))
    assert command.execute(Console()) == 0
    rows, _ = results(command)
    row = rows[COMPOSITION, "copy-paste"]
    assert row["by"] == "this software"
    assert row["protocol"]["view_count"] == len(COMPOSED)
    assert row["protocol"]["matched"] == "6 of 6 views by name"
    # a reconstruction in 100 steps of views at 224x158; black pictures have less than 8 dB
    assert row["values"]["psnr_whole"] > 12
    work = command.out / "scenes" / COMPOSITION
    (placed,) = read_placement(work / "given/placement.json").objects
    assert torch.allclose(placed.target_from_object.translation, SCENE_FROM_OBJECT.translation)
    for side, count in (("target", 18), ("source", 10)):
        seen = json.loads((work / side / "capture/transforms.json").read_text())["frames"]
        assert len(seen) == count


def test_a_composition_without_its_parts_leaves_the_reason(measured, tmp_path):
    data = tmp_path / "data"
    shutil.copytree(measured.data, data)
    (data / f"composition/{COMPOSITION}/transform.json").unlink()
    command = replace(measured, data=data, out=tmp_path / "out", measure_only=False, methods=("copy-paste",))
    assert command.execute(Console()) == 1
    _, found = results(command)
    reasons = {row["method"]: row["reason"] for row in found["missing"]}
    assert "expected SCENE_with_OBJECT with source_capture" in reasons["copy-paste"]
    assert "found no placement; name them in layout.toml" in reasons["copy-paste"]
    (scene,) = find_layout(data, dataset="syncom").scenes
    assert any("transform.json: not found; our methods need it as the placement" in line for line in scene.taken)
