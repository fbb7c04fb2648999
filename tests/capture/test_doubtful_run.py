"""Capture, doubt: a project stops after poses that are not plausible, keeps them, and goes on when it is told to."""

from pathlib import Path

import pytest
import torch

from splatgraft.capture import read_pose_report, structure_from_motion
from splatgraft.cli import main
from splatgraft.commands.steps.reconstruct import far_worse
from splatgraft.core.images import write_image

PHOTOS = 8


def project(folder: Path, key: str = "") -> Path:
    generator = torch.Generator().manual_seed(0)
    for side in ("source", "target"):
        (folder / side / "photos").mkdir(parents=True, exist_ok=True)
        for i in range(PHOTOS):
            path = folder / side / "photos" / f"{i}.png"
            if not path.exists():
                write_image(path, torch.rand(30, 40, 3, generator=generator))
    text = "".join(f'[{side}]\ncapture = "{side}/photos"\neffort = "quick"\n{key}\n' for side in ("source", "target"))
    path = folder / "project.toml"
    path.write_text(text)
    return path


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """COLMAP answers with all photos and an error of 1.05 px; every call is noted."""
    calls: list[str] = []

    def answer(job, advance, say):
        calls.append(job.photos)
        pose = torch.eye(4)[:3]
        names = [name for group in job.groups for name in group]
        images = [
            {
                "name": name,
                "world_from_camera": (pose + torch.tensor([0, 0, 0, float(i)])).tolist(),
                "camera": [40.0, 40.0, 20.0, 15.0, 0.0, 0.0, 0.0, 0.0],
                "camera_id": 1,
                "observations": 500,
            }
            for i, name in enumerate(names)
        ]
        return {
            "models": 1,
            "method": "global",
            "explained": 0.7,
            "seconds": {},
            "cpu_seconds": {},
            "unposed": [],
            "mean_reprojection_px": 1.05,
            "images": images,
            "points": [[0.0, 0.0, 5.0, 255, 0, 0, 0.3, 4]],
        }

    monkeypatch.setattr(structure_from_motion, "find_spec", lambda name: object())
    monkeypatch.setattr(structure_from_motion, "_run", answer)
    return calls


def test_run_stops_with_one_line_that_says_what_and_how_to_go_on(
    tmp_path: Path, runs: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    path = project(tmp_path)
    assert main(["run", str(path), "--to", "source/reconstruct"]) == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    for expected in ("mean reprojection error", "at most 1.00 px", "1.05 px", "more photos", "accept_doubtful = true"):
        assert expected in last
    assert not (tmp_path / "source" / "scene").exists()
    report = read_pose_report(tmp_path / "source" / "capture")
    assert report is not None
    assert [doubt.found for doubt in report.doubts] == ["1.05 px"]
    assert (tmp_path / "source" / "capture" / "transforms.json").is_file()


def test_it_stops_again_without_work_and_goes_on_with_the_same_poses_when_told_to(
    tmp_path: Path, runs: list[str]
) -> None:
    path = project(tmp_path)
    words = ["run", str(path), "--to", "capture"]
    assert main(words) == 2
    assert main(words) == 2
    assert len(runs) == 1
    assert main([*words, "--accept-doubtful"]) == 0
    assert len(runs) == 2  # the source's are kept; the target's are made
    project(tmp_path, key="accept_doubtful = true")
    assert main(words) == 0
    assert len(runs) == 2


def test_held_out_views_far_below_the_rest_are_named() -> None:
    usual = {f"photo_{i}": 25 + 0.3 * (i % 4) for i in range(9)}
    assert far_worse(usual) == {}
    worse = far_worse(usual | {"odd": 14.0, "turned": 11.0})
    assert list(worse) == ["turned", "odd"]
    assert all(name in sentence for name, sentence in worse.items())


def test_views_that_differ_a_lot_all_in_all_are_not_named() -> None:
    # the deviation is 1.4826 x 3 dB, and three of them lie below every view
    assert far_worse({f"photo_{i}": 18.0 + i for i in range(13)}) == {}
