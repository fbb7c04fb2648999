"""The COLMAP process: masks before a still background, and killed runs."""

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
from made_up_photos import FOCAL, similarity_to, turned_between_series, turntable

from splatgraft.capture import colmap_process, pose_photos
from splatgraft.capture.colmap_process.job import Job
from splatgraft.formats.captures.masks import PhotoFiles

PROGRAM = Path(colmap_process.__file__).parent
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
    command = [sys.executable, str(PROGRAM), json.dumps(asdict(job))]
    with (job.folder / "log").open("wb") as log:
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=log)


def finish(job: Job) -> dict[str, Any]:
    with start(job) as process:
        assert process.wait() == 0, (job.folder / "log").read_text()
    best = json.loads(job.output.read_text())
    return {key: value for key, value in best.items() if not key.endswith("seconds")}


@pytest.mark.long
def test_an_object_on_a_turntable_is_posed_by_its_masks(tmp_path: Path) -> None:
    truth = turntable(tmp_path, 12, 15)
    job = job_of(tmp_path, "masked", masks=True)
    masked = finish(job)
    whole = json.loads((job.folder / "answers" / "global, all pairs.json").read_text())
    assert whole["explained"] < 0.5  # the still wall shows another motion
    assert masked["database"] == "masked"
    assert len(masked["images"]) == 12
    assert masked["images"][0]["camera"][0] == pytest.approx(FOCAL, rel=0.03)
    centers = np.array([image["world_from_camera"] for image in masked["images"]])[:, :, 3]
    # a third of a pixel (SIFT) at a focal length of 500 px and a distance of 4.5 is 3 mm; hundreds of points share it,
    # while focal length and distance trade against each other: one percent of 4.5
    assert similarity_to(truth[:, :3, 3], centers)[1] < 0.045


@pytest.mark.long
def test_an_object_turned_between_two_series_is_posed_by_its_masks_in_a_room_that_explains_all_photos(
    tmp_path: Path,
) -> None:
    truth = turned_between_series(tmp_path, (9, 9), 20, 120)
    job = job_of(tmp_path, "masked", masks=True)
    best = finish(job)
    whole = json.loads((job.folder / "answers" / "global, all pairs.json").read_text())
    assert len(whole["images"]) == 18
    assert whole["explained"] > 0.5  # it was enough, before the object's own matches counted
    assert whole["moved"] == [f"{i:02d}.png" for i in range(9, 18)]
    assert best["database"] == "masked"
    assert len(best["images"]) == 18
    centers = np.array([image["world_from_camera"] for image in best["images"]])[:, :, 3]
    assert similarity_to(truth[:, :3, 3], centers)[1] < 0.045  # as for the turntable


@pytest.mark.long
def test_without_masks_photos_of_the_object_at_another_place_are_left_out_and_named(tmp_path: Path) -> None:
    turned_between_series(tmp_path, (18, 3), 15, 90, moved=(-3.3, 1.2, 0), half=0.45)
    photos = PhotoFiles(tuple(sorted((tmp_path / "images").iterdir())))
    (tmp_path / "out").mkdir()
    posed, report = pose_photos(photos, tmp_path / "out", scratch=tmp_path / "scratch")
    assert [(one.name, one.astray) for one in report.missing] == [(f"{i:02d}", True) for i in (18, 19, 20)]
    assert len(posed) == 18


@pytest.mark.long
def test_killed_runs_go_on_to_the_result_of_one_that_was_not_by_all_features_of_a_still_scene(tmp_path: Path) -> None:
    turntable(tmp_path, 6, 12, wall=False)
    whole = job_of(tmp_path, "whole", masks=True)
    began = time.monotonic()
    expected = finish(whole)
    took = time.monotonic() - began
    assert expected["database"] == "photos"
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


BEGIN = """
import sys
from pathlib import Path

import pycolmap

sys.path.insert(0, sys.argv[1])
from colmap_process.job import Job

folder = Path(sys.argv[2])
pycolmap.set_random_seed(0)
"""
"""First lines of the programs below. pycolmap shares no process with Pillow, so each runs in a process of its own."""


def printed_by(program: str, folder: Path) -> str:
    command = [sys.executable, "-c", BEGIN + program, str(PROGRAM.parent), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


REFINE = """
from colmap_process.refinement import refined

options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=10, num_points3D=300)
with pycolmap.Database.open(folder / "photos.db") as opened:
    truth = pycolmap.synthesize_dataset(options, opened)
pycolmap.synthesize_images(pycolmap.SyntheticImageOptions(), truth, folder)
photos = sorted(truth.reg_image_ids())
part = pycolmap.Reconstruction(truth)
for i in photos[7:]:
    part.deregister_frame(part.images[i].frame_id)
job = Job(str(folder), "", str(folder), False, [[truth.images[i].name for i in photos]], True, 1, 0)
assert refined(job, folder / "photos.db", [part]).num_reg_images() == 10
"""
"""Refines a synthetic model without three of its ten photos."""


def test_photos_that_no_model_holds_are_posed_from_the_points_of_the_others(tmp_path: Path) -> None:
    printed_by(REFINE, tmp_path)


AGREE = """
from colmap_process.scores import agreements, best_of

options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=10, num_points3D=300)
with pycolmap.Database.open(folder / "photos.db") as opened:
    truth = pycolmap.synthesize_dataset(options, opened)
images = best_of(folder / "photos.db", [truth], 10)["images"]
x, y, z = zip(*(row[:3] for row in images[4]["world_from_camera"]))
turned = zip(z, y, (-a for a in x), (row[3] for row in images[4]["world_from_camera"]))
images[4]["world_from_camera"] = [list(row) for row in turned]
for a, b, matches, share in agreements(folder / "photos.db", images):
    print(images[4]["name"] in (a, b), share)
"""
"""Turns the pose of one of ten photos of a synthetic model by 90 degrees, and prints how its pairs agree."""


def test_matches_contradict_a_wrong_pose_and_no_other(tmp_path: Path) -> None:
    pairs = [line.split() for line in printed_by(AGREE, tmp_path).splitlines() if line]
    assert len(pairs) == 45
    for is_turned, share in pairs:
        # matches with an error within 4 px by chance: 8 of the 1000 px or so across an image
        assert float(share) < 0.1 if is_turned == "True" else float(share) > 0.9


PARTNERS = """
from colmap_process.database import _promising_pairs

options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=40, num_points3D=150)
with pycolmap.Database.open(folder / "photos.db") as opened:
    truth = pycolmap.synthesize_dataset(options, opened)
job = Job("", "", str(folder), False, [[image.name for image in truth.images.values()]], True, 2, 0)
print(_promising_pairs(job, folder / "photos.db").read_text())
"""
"""Matches forty photos that all show the same points, as photos before a still background do."""


def test_where_all_photos_match_each_is_compared_with_its_best_partners_alone(tmp_path: Path) -> None:
    pairs = [line.split() for line in printed_by(PARTNERS, tmp_path).splitlines() if line]
    assert len(pairs) < 0.9 * 40 * 39 / 2
    partners = [sum(name in pair for pair in pairs) for name in {name for pair in pairs for name in pair}]
    assert len(partners) == 40
    assert min(partners) >= 16
