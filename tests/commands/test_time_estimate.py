"""The time estimate that a run prints first, for captures of every kind."""

import json
from dataclasses import asdict
from pathlib import Path

import pytest
import torch

from splatgraft.core.images import write_image
from splatgraft.project.record import Record
from splatgraft.project.step import plain_options
from splatgraft.workflow.flow import read_flow
from splatgraft.workflow.time_estimate import describe_estimate, estimate_step_times


def photos(folder: Path, count: int) -> Path:
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for i in range(count):
        write_image(folder / "images" / f"{i:03d}.png", torch.full((30, 40, 3), i / count))
    return folder


def seconds(root: Path, **options: str) -> dict[str, float]:
    lines = [f'[{side}]\ncapture = "../{side}"\n' for side in ("source", "target")]
    lines += [f"[{table}]\n{text}\n" for table, text in options.items()]
    (root / "project").mkdir(exist_ok=True)
    (root / "project" / "project.toml").write_text("".join(lines))
    flow = read_flow(root / "project")
    return {step.name: step.seconds for step in estimate_step_times(flow, flow.steps)}


def test_photos_that_need_poses_take_longer_by_their_number(tmp_path: Path) -> None:
    photos(tmp_path / "source", 10)
    photos(tmp_path / "target", 100)
    found = seconds(tmp_path)
    assert found["target/capture"] > 150
    assert found["target/capture"] == pytest.approx(10 * found["source/capture"], rel=0.05)
    (tmp_path / "target" / "transforms.json").write_text(json.dumps({"frames": []}))
    assert seconds(tmp_path)["target/capture"] < 10


def test_a_better_reconstruction_takes_longer_and_what_cannot_be_read_is_left_to_the_step(tmp_path: Path) -> None:
    photos(tmp_path / "source", 4)
    assert seconds(tmp_path)["target/capture"] > 0
    photos(tmp_path / "target", 4)
    draft, high = (seconds(tmp_path, reconstruct=f'quality = "{q}"') for q in ("draft", "high"))
    assert high["target/reconstruct"] > 10 * draft["target/reconstruct"]


def test_what_a_draft_took_is_not_what_a_better_one_takes(tmp_path: Path) -> None:
    for side in ("source", "target"):
        photos(tmp_path / side, 4)
    draft = seconds(tmp_path, reconstruct='quality = "draft"')
    flow = read_flow(tmp_path / "project")
    for side in ("source", "target"):
        step = flow.steps[f"{side}/reconstruct"]
        step.out.mkdir(parents=True)
        record = Record("reconstruct", "0", plain_options(vars(step)), {}, (), draft[f"{side}/reconstruct"], 0)
        (step.out / "step.json").write_text(json.dumps(asdict(record)))
    again = seconds(tmp_path, reconstruct='quality = "draft"')
    assert again["source/reconstruct"] == draft["source/reconstruct"]
    high = seconds(tmp_path, reconstruct='quality = "high"')
    assert high["target/reconstruct"] > 10 * draft["target/reconstruct"]
    # the object has a fit of its own
    assert high["source/reconstruct"] == draft["source/reconstruct"]
    boxed = seconds(tmp_path, reconstruct='quality = "high"', segment='mask_source = "box"')
    assert boxed["source/reconstruct"] > 10 * draft["source/reconstruct"]


def test_a_capture_that_was_posed_does_not_make_the_rest_seem_slow(tmp_path: Path) -> None:
    photos(tmp_path / "source", 100)
    photos(tmp_path / "target", 100)
    before = seconds(tmp_path)
    flow = read_flow(tmp_path / "project")
    out = flow.steps["source/capture"].out
    out.mkdir(parents=True)
    record = Record("capture", "0", {}, {}, (), before["source/capture"], 0)
    (out / "step.json").write_text(json.dumps(asdict(record)))
    planned = estimate_step_times(flow, [name for name in flow.steps if name != "source/capture"])
    assert sum(step.seconds for step in planned) <= sum(before.values())
    assert "half or twice" in describe_estimate(planned)


def test_masks_that_have_to_be_cut_and_larger_pictures_take_longer(tmp_path: Path) -> None:
    photos(tmp_path / "source", 40)
    photos(tmp_path / "target", 40)
    cut = seconds(tmp_path)
    assert cut["segment"] > 30
    for photo in list((tmp_path / "source" / "images").iterdir()):
        write_image(photo.with_name(f"{photo.stem}_mask.png"), torch.ones(30, 40))
    assert seconds(tmp_path)["segment"] < 0.3 * cut["segment"]
    for photo in (tmp_path / "target" / "images").iterdir():
        write_image(photo, torch.zeros(1200, 1600, 3))
    assert seconds(tmp_path)["render"] > 2 * cut["render"]
