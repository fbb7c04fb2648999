"""`paper benchmark` on the shipped scene: measured views are held out, missing methods are named, the light helps."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from splatgraft.cli import main
from splatgraft.reconstruction import ReconstructOptions
from splatgraft.runtime.console import Console
from splatgraft_paper.benchmark.methods import Method
from splatgraft_paper.commands.benchmark import EvaluateBenchmark

SCENES = Path(__file__).parents[2] / "data" / "benchmark"
QUICK = ReconstructOptions(quality="draft", device="cpu", iterations=30, budget=1500)
BETTER = replace(QUICK, iterations=300, budget=8000)


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """Run a command once: one of our methods, the truth as another program's, and one that cannot run."""
    out = tmp_path_factory.mktemp("benchmark")
    (out / "theirs").mkdir()
    shutil.copytree(SCENES / "terrace" / "ground_truth" / "images", out / "theirs" / "terrace")
    numbered = out / "numbered" / "terrace"
    numbered.mkdir(parents=True)
    for number, stem in enumerate(("0000", "0008", "0016")):
        shutil.copy(out / "theirs" / "terrace" / f"{stem}.png", numbered / f"{number:05d}.png")
    pictures = (f"truth={out / 'theirs'}", f"GS-IR={numbered.parent}")
    methods = ("reinhard", *pictures, "off+nosuch")
    command = EvaluateBenchmark(SCENES, out / "report", methods=methods, options=QUICK)
    assert command.execute(Console()) == 1
    return command


def rows(command):
    found = json.loads((command.out / "benchmark.json").read_text())
    return {row["method"]: row["values"] for row in found["rows"]}, found


@pytest.mark.long
def test_the_true_light_takes_most_of_the_shadows_error_and_colours_alone_none(tmp_path):
    methods = ("copy-paste", "reinhard", "true-light")
    command = EvaluateBenchmark(SCENES, tmp_path, methods=methods, options=BETTER)
    assert command.execute(Console()) == 0
    values, _ = rows(command)
    assert values["true-light"]["shadow_ratio_rmse"] < 0.6 * values["copy-paste"]["shadow_ratio_rmse"]
    assert values["reinhard"]["shadow_ratio_rmse"] > 0.9 * values["copy-paste"]["shadow_ratio_rmse"]


@pytest.mark.long
def test_the_truth_as_another_programs_pictures_has_no_error_left(measured):
    values, _ = rows(measured)
    assert values["truth"]["ssim_whole"] == pytest.approx(1)
    assert values["truth"]["disagreement"] == values["truth"]["disagreement_truth"]
    # numbers of held-out views by 3DGS's render.py, which GS-IR, GaussianShader and 3DGS-DR keep
    assert values["GS-IR"]["ssim_whole"] == pytest.approx(1)
    # an infinite PSNR has no number
    assert values["truth"]["psnr_whole"] is None


@pytest.mark.long
def test_measured_views_were_held_out_of_everything(measured):
    work = measured.out / "scenes" / "terrace"
    held = {f"{i:04d}" for i in (0, 8, 16)}
    seen = {
        Path(f["file_path"]).stem for f in json.loads((work / "target/capture/transforms.json").read_text())["frames"]
    }
    assert len(seen) == 21
    assert not seen & held
    harmonized = {path.stem for path in (work / "harmonized").glob("*/images/*.png")}
    assert harmonized
    assert not harmonized & held
    for metrics in work.glob("measured/*/metrics.json"):
        assert set(json.loads(metrics.read_text())["views"]) == held


@pytest.mark.long
def test_what_could_not_run_or_be_measured_is_said_and_never_filled(measured):
    _, found = rows(measured)
    assert any("off+nosuch on terrace not run: harmonizer: expected one of" in line for line in found["not_run"])
    for metric, key in (("lpips", "lpips_whole"), ("fid and kid", "fid_whole")):
        if metric in found["not_measured"]:
            assert found["means"]["reinhard"][key] is None
    text = (measured.out / "benchmark.md").read_text()
    assert "reconstruct target" in text
    page = (measured.out / "index.html").read_text()
    assert "terrace 0008" in page
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert "https://" not in page


@pytest.mark.long
def test_a_second_run_measures_nothing_again(measured):
    files = sorted(measured.out.glob("scenes/terrace/*/**/metrics.json"))
    before = {path: path.stat().st_mtime_ns for path in files}
    again = replace(measured, methods=measured.methods[:2])
    assert again.execute(Console()) == 0
    assert {path: path.stat().st_mtime_ns for path in files} == before


@pytest.mark.parametrize("text", ["transfre", "transfer/l1-dssim", "off+reinhard/l2", "lbm=nowhere", "=x"])
def test_a_method_that_means_nothing_is_refused(text):
    with pytest.raises(ValueError, match="--methods: expected"):
        Method.parse(text)


def test_a_folder_without_scenes_is_one_line(tmp_path, capsys):
    assert main(["paper", "benchmark", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "expected scenes with ground_truth/, found none" in capsys.readouterr().err


@pytest.mark.long
def test_pictures_that_lack_a_held_out_view_are_named(tmp_path, measured):
    theirs = tmp_path / "theirs" / "terrace"
    theirs.mkdir(parents=True)
    for name in ("0000.png", "0008.png"):
        shutil.copy(SCENES / "terrace" / "ground_truth" / "images" / name, theirs)
    command = replace(measured, methods=(f"half={theirs.parent}",))
    assert command.execute(Console()) == 1
    _, found = rows(command)
    assert any("0016.png: expected the method's picture of a held-out view" in line for line in found["not_run"])
