"""Capture, the COLMAP process as it is called: masks where the background does not move, and runs that are killed."""

import json
import random
import subprocess
import sys
import time
from dataclasses import asdict, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_up_photos import FOCAL, turntable

from splatgraft.capture import colmap_process
from splatgraft.capture.colmap_process.job import SEARCH, Job

pytestmark = pytest.mark.skipif(find_spec("pycolmap") is None, reason="pycolmap is an optional extra")


def job_of(folder: Path, scratch: str, *, masks: bool = False) -> Job:
    (folder / scratch).mkdir(exist_ok=True)
    for mask in (folder / "masks").glob("??.png"):
        mask.rename(mask.with_name(f"{mask.name}.png"))
    return Job(
        photos=str(folder / "images"),
        masks=str(folder / "masks") if masks else "",
        scratch=str(folder / scratch),
        thorough=False,
        groups=[sorted(photo.name for photo in (folder / "images").iterdir())],
        exhaustive=True,
        threads=2,
        seed=0,
    )


def start(job: Job) -> subprocess.Popen[bytes]:
    command = [sys.executable, str(Path(colmap_process.__file__).parent), json.dumps(asdict(job))]
    with (job.folder / "log").open("wb") as log:
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=log)


def finish(job: Job) -> dict[str, Any]:
    with start(job) as process:
        assert process.wait() == 0, (job.folder / "log").read_text()
    best = json.loads(job.output.read_text())
    return {key: value for key, value in best.items() if not key.endswith("seconds")}


def camera_centers(model: dict[str, Any]) -> np.ndarray:
    return np.array([image["world_from_camera"] for image in model["images"]])[:, :, 3]


def error_after_alignment(found: np.ndarray, truth: np.ndarray) -> float:
    """Largest distance after the best similarity transform (Umeyama 1991)."""
    x, y = found - found.mean(0), truth - truth.mean(0)
    u, s, vt = np.linalg.svd(y.T @ x)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = (s * np.diag(sign)).sum() / (x**2).sum()
    return float(np.linalg.norm(y - scale * x @ (u @ sign @ vt).T, axis=1).max())


def test_an_object_on_a_turntable_is_posed_by_its_masks(tmp_path: Path) -> None:
    truth = turntable(tmp_path, 12, 15)
    job = job_of(tmp_path, "masked", masks=True)
    masked = finish(job)
    whole = json.loads((job.folder / "answers" / "global, all pairs.json").read_text())
    assert whole["explained"] < SEARCH.clear_explained  # what the still wall says is another motion
    assert masked["database"] == "masked"
    assert len(masked["images"]) == 12
    assert masked["images"][0]["camera"][0] == pytest.approx(FOCAL, rel=0.03)
    # a third of a pixel (SIFT) at a focal length of 500 px and a distance of 4.5 is 3 mm; hundreds of points share it,
    # while focal length and distance trade against each other: one percent of 4.5
    assert error_after_alignment(camera_centers(masked), truth[:, :3, 3]) < 0.045


def test_a_still_scene_is_posed_by_all_its_features(tmp_path: Path) -> None:
    turntable(tmp_path, 6, 12, wall=False)
    assert finish(job_of(tmp_path, "masked", masks=True))["database"] == "photos"


def test_killed_runs_go_on_to_the_result_of_one_that_was_not(tmp_path: Path) -> None:
    turntable(tmp_path, 6, 12, wall=False)
    whole = job_of(tmp_path, "whole")
    began = time.monotonic()
    expected = finish(whole)
    took = time.monotonic() - began
    assert all(sum(point[3:6]) > 0 for point in expected["points"])  # those of the refinement have colours, too
    job, chance = replace(whole, scratch=str(tmp_path / "killed")), random.Random(0)
    job.folder.mkdir()
    for _ in range(6):
        with start(job) as process:
            try:
                process.wait(chance.uniform(0.1, 0.6) * took)
                break
            except subprocess.TimeoutExpired:
                process.kill()
    assert finish(job) == expected


def test_the_process_ends_with_its_parent(tmp_path: Path) -> None:
    turntable(tmp_path, 6, 12, wall=False)
    with start(job_of(tmp_path, "orphan")) as process:
        assert process.stdin is not None
        process.stdin.close()
        assert process.wait() == 1


def test_models_that_share_photos_are_joined_and_missing_photos_are_posed(tmp_path: Path) -> None:
    program = Path(__file__).with_name("join_synthetic_models.py")
    command = [sys.executable, str(program), str(Path(colmap_process.__file__).parents[1]), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
