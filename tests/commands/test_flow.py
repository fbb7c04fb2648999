"""The whole flow on a tiny scene, through the commands: done once, redone only if stale, intact after every kill."""

import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from killing import Killed, killed_at_write
from tiny_project import ball, contents, photograph, plane

from splatgraft.cli import main
from splatgraft.core.images import read_rgb, write_image
from splatgraft.formats import read_gaussians
from splatgraft.harmonization import HARMONIZERS, EditOptions, FluxOptions, HarmonizerOptions
from splatgraft.project.record import read_record, why_stale
from splatgraft.project.step import FolderCheckpoint, job_of, replacing
from splatgraft.runtime.settings import choices, field_types
from splatgraft.steps.harmonize import Harmonize
from splatgraft.workflow import run
from splatgraft.workflow.flow import read_flow

STEPS = ("segment", "compose", "relight", "render", "harmonize", "consolidate", "evaluate")


@pytest.fixture
def project(copy_project: Callable[[], Path]) -> Path:
    return copy_project() / "project.toml"


def stale(project: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, str]:
    capsys.readouterr()
    assert main(["status", str(project)]) == 0
    lines = capsys.readouterr().out.splitlines()[1:]
    return {line.split()[0]: line.split("stale: ")[1] for line in lines if "stale: " in line}


def test_everything_is_made_and_fresh_wherever_the_project_lies(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert stale(project, capsys) == {}
    layout = read_flow(project).layout
    composite, relit, result = (
        read_gaussians(folder / "scene.ply") for folder in (layout.composite, layout.relit, layout.result)
    )
    assert torch.equal(composite.means, result.means)
    assert torch.equal(composite.opacity_logits, result.opacity_logits)
    # no harmoniser, and images of 8 bits are off by half a level at most, which counts as unchanged: the same colours
    assert torch.equal(relit.sh, result.sh)
    for name in ("index.html", "before.png", "after.png", "turntable.gif"):
        assert (layout.report / name).is_file()
    page = (layout.report / "index.html").read_text()
    assert "<h2>Depth and normals</h2>" in page
    for label in ("Depth", "Normals"):
        (name,) = re.findall(rf'src="(geometry/0000_\d\.webp)" alt="{label} ', page)
        # the plane and the ball are in it, so it has several colours
        assert read_rgb(layout.report / name).flatten(0, 1).std(0).max() > 0.05
    record = read_record(layout.harmonized)
    assert record is not None
    assert record.options == {"method": "none"}
    assert main(["run", str(project)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(layout.report / "index.html")


def test_a_changed_input_makes_stale_what_depends_on_it_and_nothing_else(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mask = project.parents[1] / "photos" / "source" / "masks" / "view_0000.png"
    write_image(mask, 1 - read_rgb(mask)[..., 0])
    reasons = stale(project, capsys)
    assert set(reasons) == {"source/capture", "source/reconstruct", *STEPS}
    assert reasons["source/capture"] == "masks: view_0000.png changed"
    before = contents(project.parent / "source" / "scene")
    assert main(["run", str(project), "--to", "source/reconstruct"]) == 0
    # the capture is unchanged, so nothing is trained again; only the masks are new to segment
    assert any(
        line.split() == ["source/reconstruct", "up", "to", "date"] for line in capsys.readouterr().err.splitlines()
    )
    assert contents(project.parent / "source" / "scene") == before
    assert set(stale(project, capsys)) == set(STEPS)


def test_a_changed_option_reruns_its_step_and_identical_results_go_no_further(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    project.write_text(project.read_text().replace("frames = 3", "frames = 2"))
    assert stale(project, capsys) == {"evaluate": "frames is now 2, was 3"}
    assert main(["run", str(project), "--force", "harmonize"]) == 0
    ran = [line.split()[0] for line in capsys.readouterr().err.splitlines() if line.endswith(" begins")]
    assert ran == ["harmonize", "evaluate"]
    assert stale(project, capsys) == {}


@pytest.mark.long
def test_each_step_also_takes_paths_and_makes_the_same(project: Path, tmp_path: Path) -> None:
    layout = read_flow(project).layout
    words = ["render", "--scene", str(layout.result / "scene.ply"), "--cameras", str(layout.capture("target"))]
    assert main([*words, "--out", str(tmp_path / "pictures")]) == 0
    assert len(list((tmp_path / "pictures" / "images").iterdir())) == 8
    scene, capture = str(layout.scene("source") / "scene.ply"), str(layout.capture("source"))
    words = ["segment", "--scene", scene, "--capture", capture, "--threshold", "0.5", "--solidify", "4"]
    assert main([*words, "--out", str(tmp_path / "object")]) == 0
    assert contents(tmp_path / "object") == contents(layout.object)
    words = ["reconstruct", capture, "--quality", "draft", "--iterations", "60", "--budget", "400", "--sh-degree", "1"]
    assert main([*words, "--out", str(tmp_path / "scene")]) == 0
    assert contents(tmp_path / "scene") == contents(layout.scene("source"))


def test_a_project_that_cannot_be_says_so_in_one_line(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    original = project.read_text()
    for change, line in (
        (("[segment]", "[segments]"), "project.toml: expected tables among source, target, capture"),
        (("passes = 1", "pases = 1"), "project.toml [consolidate]: expected keys among"),
        (("passes = 1", 'nuisance = "slow"'), "[consolidate] nuisance: expected 'tint-flow' or 'none', found 'slow'"),
        (("[consolidate]", "[harmonize]\nlora = 'a'\n[consolidate]"), 'ray with method = "none"; found lora'),
        (
            ("[consolidate]", "[harmonize]\nmethod = 'compact'\n[consolidate]"),
            "[harmonize] method: expected one of edit, flux, none; found 'compact'",
        ),
        (("budget = 400", "budget = 0"), "expected budget of at least 1, found 0"),
        (("../photos/source", "../photos/gone"), "gone: expected"),
    ):
        project.write_text(original.replace(*change))
        capsys.readouterr()
        assert main(["run", str(project)]) == 2
        printed = capsys.readouterr()
        assert printed.out == ""
        assert line in printed.err.splitlines()[-1]


def test_a_run_up_to_a_step_needs_only_the_inputs_of_that_step(
    project: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "transforms.json").write_text("{")
    before, after = project.read_text().split("[target]\ncapture = ")
    project.write_text(f"{before}[target]\ncapture = {str(broken)!r}\n{after.split(chr(10), 1)[1]}")
    assert main(["run", str(project), "--to", "source/reconstruct"]) == 0
    capsys.readouterr()
    assert main(["run", str(project)]) == 2
    assert "transforms.json: expected" in capsys.readouterr().err


def test_every_harmoniser_is_a_sub_command_and_its_keys_stand_beside_it_in_the_table(project: Path) -> None:
    assert choices(field_types(Harmonize)["method"]) == HARMONIZERS
    text = project.read_text()
    keys = '[harmonize]\nmethod = "flux"\nweights = "hub/id"\nlora = "a/lora.safetensors"\nprocesses = 2\n'
    project.write_text(text + keys)
    step = read_flow(project).steps["harmonize"]
    assert isinstance(step, Harmonize)
    lora = project.parent / "a/lora.safetensors"
    assert (step.method, step.processes) == (FluxOptions(weights="hub/id", lora=lora), 2)


@pytest.mark.parametrize(
    ("method", "file"),
    [
        (FluxOptions(weights="w", base="hub/id"), "w/transformer/diffusion_pytorch_model.safetensors"),
        (FluxOptions(weights="hub/id", base="w"), "w/vae/diffusion_pytorch_model.safetensors"),
        (FluxOptions(weights="hub/id", lora=Path("w/lora.safetensors")), "w/lora.safetensors"),
        (EditOptions(model="w"), "w/unet/model.bin"),
    ],
)
def test_new_weights_make_harmonised_views_stale(
    project: Path, monkeypatch: pytest.MonkeyPatch, method: HarmonizerOptions, file: str
) -> None:
    monkeypatch.chdir(project.parent)
    step = read_flow(project).steps["harmonize"]
    assert isinstance(step, Harmonize)
    step, weights = replace(step, method=method), Path(file)
    weights.parent.mkdir(parents=True)
    weights.write_bytes(b"old")
    with replacing(job_of(step)):
        pass
    assert why_stale(job_of(step)) is None
    weights.write_bytes(b"new")
    assert why_stale(job_of(step)) == f"weights: {weights.name} changed"


def test_views_of_a_ground_truth_that_no_step_saw_are_measured_apart(project: Path) -> None:
    truth = project.parents[1] / "photos" / "truth"
    photograph(truth, plane((0.5, 0.45, 0.6)), ball())
    (truth / "points.ply").unlink()
    options = f'[render]\neval = true\n[evaluate]\nground_truth = "{truth}"\n'
    project.write_text(project.read_text().replace("[evaluate]\n", options))
    assert main(["run", str(project)]) == 0
    assert len(list((project.parent / "harmonized" / "images").iterdir())) == 7
    metrics = json.loads((project.parent / "report" / "metrics.json").read_text())
    assert metrics["views"] == "held out"
    assert metrics["view_count"] == 1
    assert [row["held_out"] for row in metrics["per_view"]] == [True] + [False] * 7


@pytest.mark.long
def test_a_later_capture_is_made_by_a_second_process_and_its_failure_is_the_steps_own(
    project: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "_WORTHWHILE_SECONDS", -1.0)
    performed, processes = [], []
    perform, finish = run.perform, run._finish

    def performing(step: Any, console: Any, *, name: str) -> Path:
        performed.append(name)
        return perform(step, console, name=name)

    def finishing(process: subprocess.Popen[str], console: Any) -> None:
        processes.append(process)
        finish(process, console)

    monkeypatch.setattr(run, "perform", performing)
    monkeypatch.setattr(run, "_finish", finishing)
    flow = read_flow(project)
    before = contents(flow.steps["target/capture"].out)
    for side in ("source", "target"):
        shutil.rmtree(flow.steps[f"{side}/capture"].out)
    assert main(["run", str(project), "--to", "capture"]) == 0
    assert performed == ["source/capture"]
    (process,) = processes
    assert process.pid != os.getpid()
    assert process.returncode == 0
    assert contents(flow.steps["target/capture"].out) == before
    said = capsys.readouterr().err
    assert said.index("source/capture       done") < said.index("target/capture       done")
    # the second process fails, and this one gives the reason
    shutil.rmtree(project.parents[1] / "photos" / "target" / "images")
    assert main(["run", str(project), "--to", "capture", "--force", "capture"]) == 2
    assert str(project.parents[1] / "photos" / "target") in capsys.readouterr().err.splitlines()[-1]


def test_no_masks_are_cut_from_the_images_and_the_choice_is_said(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.rmtree(project.parents[1] / "photos" / "source" / "masks")
    assert main(["run", str(project), "--to", "segment"]) == 0
    said = capsys.readouterr().err
    assert "not every image has a mask; masks are cut by grabcut" in said
    assert "the masks agree with the object by" in said
    folder = read_flow(project).layout.object
    assert len(list((folder / "masks").iterdir())) == 8
    agreement = json.loads((folder / "agreement.json").read_text())
    assert len(agreement["views"]) == 8
    assert read_rgb(folder / "views.png").shape[2] == 3
    # up to date with the same source, named or not
    assert "segment" not in stale(project, capsys)
    project.write_text(project.read_text().replace("[segment]", '[segment]\nmask_source = "files"'))
    assert main(["run", str(project), "--to", "segment"]) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    for choice in ("--masks", "--mask-source grabcut", "--prompts", "--box", "birefnet"):
        assert choice in line


def test_killed_inside_any_step_earlier_results_stay_whole_and_run_finishes(project: Path) -> None:
    """Request every step again, kill it at one of its writes, then bring all up to date."""
    generator = random.Random(0)
    wanted = {step.out: contents(step.out) for _, step in read_flow(project)}
    for name, _ in read_flow(project):
        # the lock, the checkpoint and the new folder are the first writes; each step has at least ten
        with pytest.raises(Killed), killed_at_write(generator.randrange(4, 10)):
            main(["run", str(project), "--to", name, "--force", name])
        assert {folder: contents(folder) for folder in wanted} == wanted
    shutil.rmtree(project.parent / "source" / "scene")
    assert main(["run", str(project), "--force", "consolidate"]) == 0
    # the same seeds give the same files, after any number of kills
    assert {folder: contents(folder) for folder in wanted} == wanted
    assert not list(project.parent.rglob(".*.checkpoint"))


@pytest.mark.parametrize("number", [signal.SIGKILL, pytest.param(signal.SIGTERM, marks=pytest.mark.long)])
def test_a_killed_process_leaves_earlier_results_whole_and_the_next_run_finishes(project: Path, number: int) -> None:
    wanted = {step.out: contents(step.out) for _, step in read_flow(project)}
    words = [sys.executable, "-m", "splatgraft", "run", str(project), "--force", "target/reconstruct"]
    source = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2] / "src")}
    run = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=source)
    while not (project.parent / "target" / ".scene.new").exists():
        assert run.poll() is None
        time.sleep(0.001)
    run.send_signal(number)
    assert run.wait() == -number
    assert {folder: contents(folder) for folder in wanted} == wanted
    # the lock died with its holder
    assert main(["run", str(project)]) == 0
    assert {folder: contents(folder) for folder in wanted} == wanted


"""Program that runs `splatgraft` with frequent checkpoints, and sleeps forever after the third."""


def test_a_killed_training_goes_on_from_its_checkpoint(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flow = read_flow(project)
    folder, wanted = flow.layout.scene("source"), contents(flow.layout.scene("source"))
    shutil.rmtree(folder)
    monkeypatch.setattr("splatgraft.fitting.gaussian_fit._CHECKPOINT_SECONDS", 0.0)
    saves = 0

    def save(self: FolderCheckpoint, state: dict) -> None:
        nonlocal saves
        original(self, state)
        saves += 1
        if saves == 2:
            raise KeyboardInterrupt

    original = FolderCheckpoint.save
    monkeypatch.setattr(FolderCheckpoint, "save", save)
    assert main(["run", str(project), "--to", "source/reconstruct"]) == 130
    state = FolderCheckpoint(job_of(flow.steps["source/reconstruct"])).load()
    assert state is not None
    monkeypatch.undo()
    assert main(["run", str(project), "--to", "source/reconstruct"]) == 0
    assert contents(folder) == wanted
