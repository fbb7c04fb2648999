"""Capture, plausibility: each figure out of its range is a doubt of its own, and ordinary captures have none."""

from dataclasses import replace
from pathlib import Path

import pytest

from splatgraft.capture import Doubt, Found, Lens, PoseReport, Unposed, find_doubts, read_pose_report, write_pose_report

# a phone: 26 mm equivalent is 0.72 longest sides
LENS = Lens(photos=("a", "b", "c"), size=(800, 600), focal_px=578.0, distortion=0.02)
ORDINARY = Found(photos=3, explained=0.75, mean_reprojection_px=0.4, observations=(900, 1100, 1000), lenses=(LENS,))


def test_an_ordinary_capture_has_no_doubts() -> None:
    assert find_doubts(ORDINARY) == ()


@pytest.mark.parametrize(
    ("change", "what", "found"),
    [
        ({"photos": 4}, "photos with a pose", "3 of 4"),
        ({"explained": 0.33}, "matches that the cameras explain", "33%"),
        ({"mean_reprojection_px": 1.05}, "mean reprojection error", "1.05 px"),
        ({"observations": (900, 40, 50)}, "points seen by the median photo", "50"),
        ({"lenses": (replace(LENS, focal_px=200.0, distortion=0.0),)}, "focal length of a and 2 more", "200 px"),
        ({"lenses": (replace(LENS, focal_px=5000.0),)}, "focal length of a and 2 more", "5000 px"),
        # the corner is 500 px from the middle: 0.5 (500 / 578)^2 = 37 percent
        ({"lenses": (replace(LENS, distortion=-0.5),)}, "distortion of a and 2 more", "37%"),
    ],
)
def test_each_figure_out_of_range_is_named(change: dict, what: str, found: str) -> None:
    (doubt,) = find_doubts(replace(ORDINARY, **change))
    assert (doubt.what, doubt.found) == (what, found)
    assert found in str(doubt)
    assert doubt.expected in str(doubt)


def test_lenses_that_bend_each_photo_otherwise_are_doubted() -> None:
    # corners moved by 15 percent inwards and outwards; the 10th and 90th percentile of three lie 0.8 of that apart
    k = 0.15 * 578**2 / 500**2
    lenses = tuple(replace(LENS, photos=(name,), distortion=d) for name, d in (("a", -k), ("b", 0.0), ("c", k)))
    (doubt,) = find_doubts(replace(ORDINARY, lenses=lenses))
    assert (doubt.what, doubt.found) == ("spread of the distortion between photos", "24%")


def test_the_report_and_its_doubts_come_back_from_their_file(tmp_path: Path) -> None:
    report = PoseReport(
        photos=4,
        registered=3,
        missing=(Unposed("d", 900, 12),),
        mean_reprojection_px=0.4,
        points=1000,
        models=1,
        method="global",
        explained=0.75,
        lenses=(LENS,),
        doubts=(Doubt("photos with a pose", "3 of 4", "at least 90%"),),
    )
    assert read_pose_report(tmp_path) is None
    write_pose_report(tmp_path, report)
    assert read_pose_report(tmp_path) == report
    (tmp_path / "pose_report.json").write_text("{}")
    with pytest.raises(ValueError, match=r"pose_report\.json: expected figures of poses"):
        read_pose_report(tmp_path)
