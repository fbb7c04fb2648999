"""Rendered training pairs: the manifest, and the detection of defective renders."""

import json

import pytest
import torch

from splatgraft.cli import main
from splatgraft.core.images import read_rgb, write_image
from splatgraft_paper.synthesis import pairs
from splatgraft_paper.synthesis.jobs import RenderWorkers


def write_sample(folder, seed=0):
    """Write a folder like the worker's: one camera, one object, one light, 48x40."""
    g = torch.Generator().manual_seed(seed)
    background = torch.rand(40, 48, 3, generator=g) * 0.5 + 0.2
    mask = torch.zeros(40, 48)
    mask[12:26, 15:30] = 1
    target = torch.where(mask[..., None] > 0, torch.rand(40, 48, 3, generator=g), background)
    for take, image in (("background", background), ("object0", target), ("object0_light0", target * 0.4 + 0.1)):
        (folder / take).mkdir(parents=True)
        write_image(folder / take / "0000.png", image)
    write_image(folder / "object0" / "0000_mask.png", mask)
    takes = [{"name": name} for name in ("background", "object0", "object0_light0")]
    (folder / "job.json").write_text(json.dumps({"takes": takes, "cameras": [{}], "provenance": {"kind": "test"}}))
    return pairs.PairSample(folder, 0, "object0", "light0")


def test_sound_samples_make_the_manifest_and_come_back(tmp_path):
    sample = write_sample(tmp_path / "a")
    count, faults = pairs.write_manifest(tmp_path, [tmp_path / "a"])
    assert (count, faults) == (1, [])
    assert pairs.read_manifest(tmp_path) == [sample]


BLACK = torch.zeros(40, 48, 3)
DAMAGES = {
    "truncated": lambda sample: sample.path("background").write_bytes(sample.path("background").read_bytes()[:200]),
    "no target": lambda sample: sample.path("object0").unlink(),
    "empty mask": lambda sample: write_image(sample.path("object0", "mask"), BLACK[..., 0]),
    "black": lambda sample: write_image(sample.path("object0"), BLACK),
    "burnt": lambda sample: write_image(sample.path("object0"), 1 - torch.eye(40, 48)[..., None].expand(-1, -1, 3)),
    "dark object": lambda sample: write_image(sample.path("object0_light0"), BLACK),
    "another scene": lambda sample: write_image(sample.path("background"), 1 - read_rgb(sample.path("background"))),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_bad_renders_are_caught_and_named(tmp_path, damage):
    sample = write_sample(tmp_path / "a")
    assert pairs.find_defect(sample) is None
    DAMAGES[damage](sample)
    count, (fault,) = pairs.write_manifest(tmp_path, [tmp_path / "a"])
    assert count == 0
    assert str(tmp_path / "a") in fault
    assert "expected" in fault


def test_broken_manifest_line_is_named(tmp_path):
    (tmp_path / "manifest.jsonl").write_text('{"folder": "a"}\n')
    with pytest.raises(ValueError, match=r"manifest.jsonl, line 1: expected folder, camera"):
        pairs.read_manifest(tmp_path)


def test_the_paper_s_amount_is_1900_targets_and_a_little_over_51000_composites_and_its_hours_are_said_first(
    tmp_path, monkeypatch, capsys
):
    def nothing(*_):
        raise ValueError("stopped before anything is rendered")

    monkeypatch.setattr(RenderWorkers, "python", nothing)
    assert main(["paper", "synth", "pairs", str(tmp_path / "out"), "--paper", "--lights", "1"]) == 2
    said = capsys.readouterr().err
    assert "pairs: 1,900 targets, 51,300 composites (the paper: 1,900 and 51,000, --paper); about " in said
    assert main(["paper", "synth", "pairs", str(tmp_path / "out")]) == 2
    assert "pairs: 600 targets, 1,800 composites" in capsys.readouterr().err
    # Sec. 5.2: 704x496 with 128 samples; one picture of a room takes 336 CPU seconds
    plan = pairs.PairPlan(objects=2, lights=0)
    assert plan.cpu_seconds == pytest.approx(15 * 336, rel=0.02)
