"""`splatgraft check` on generated photos: each fault is named with its photos, and good photos have none."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from tiny_project import ball, photograph, plane

from splatgraft.capture.usable_views import find_odd_photos, log_sharpness
from splatgraft.cli import main
from splatgraft.core.exposure import Exposure
from splatgraft.formats.captures.exif import exif_of

COUNT = 24
SIZE = (320, 240)


def texture(seed: int) -> np.ndarray:
    """Return blotches of several sizes, which SIFT finds again."""
    generator = np.random.default_rng(seed)
    layers = [cv2.resize(generator.random((h, 2 * h), np.float32), (1600, 400), interpolation=2) for h in (25, 60, 200)]
    mixed = sum(layers)
    return (255 * (mixed - mixed.min()) / (mixed.max() - mixed.min())).astype(np.uint8)


def walk(seed: int = 0, count: int = COUNT) -> list[np.ndarray]:
    """Write photos of a sideways walk along a wall, with boards before it that move twice as much in the picture."""
    wall, boards = texture(seed), texture(seed + 100)
    width, height = SIZE
    photos: list[np.ndarray] = []
    for i in range(count):
        photo = wall[40 : 40 + height, 20 * i : 20 * i + width].copy()
        near = boards[40 : 40 + height, 40 * i : 40 * i + width]
        for left in range(100 - 40 * i % 200, width, 200):
            photo[30:200, max(left, 0) : left + 80] = near[30:200, max(left, 0) : left + 80]
        photos.append(photo)
    return photos


def save(folder: Path, photos: list[np.ndarray], *, exposure: Callable[[int], Exposure] | None = None) -> Path:
    folder.mkdir(parents=True)
    for i, photo in enumerate(photos):
        exif = Image.Exif() if exposure is None else exif_of(exposure(i))
        Image.fromarray(photo).convert("RGB").save(folder / f"{i:03d}.jpg", quality=95, exif=exif)
    return folder


def check(capture: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, dict[str, dict], str]:
    """Return exit status, and findings by subject and verdict."""
    capsys.readouterr()
    status = main(["check", str(capture), "--json"])
    found = json.loads(capsys.readouterr().out)
    return status, {finding["subject"]: finding for finding in found["findings"]}, found["verdict"]


def doubts(findings: dict[str, dict]) -> set[str]:
    return {subject for subject, finding in findings.items() if finding["level"] != "good"}


def test_good_photos_have_no_fault_and_few_are_said_to_be_in_one_line_per_subject(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, findings, verdict = check(save(tmp_path / "photos", walk()), capsys)
    assert (status, verdict, doubts(findings)) == (0, "good", set())
    assert "structure from motion" in findings["poses"]["text"]
    # `check` finds masks in the same places as `capture`
    folder = save(tmp_path / "capture" / "images", walk(count=10))
    for photo in sorted(folder.iterdir())[:3]:
        Image.new("L", SIZE, 255).save(folder / f"{photo.stem}_mask.png")
    assert main(["check", str(folder.parent)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split()[:4] == ["doubtful", "count", "10", "photos,"]
    assert any(line.split()[1:4] == ["masks", "3", "masks"] for line in lines)
    assert lines[-1].startswith("verdict: usable")


def test_faulty_photos_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photos = walk()
    photos[4] = cv2.blur(photos[4], (15, 1))
    photos[9] = texture(77)[:240, :320]
    photos[15] = (255 * (photos[15] / 255 * 0.6)).astype(np.uint8)  # 0.6 of the values is 1.6 stops less light
    photos[20] = photos[20][:200]
    folder = save(tmp_path / "photos", photos)
    (folder / "021.jpg").write_bytes((folder / "021.jpg").read_bytes()[:2000])
    (folder / "022.jpg").write_bytes(b"")
    shutil.copy(folder / "001.jpg", folder / "050.jpg")
    status, findings, verdict = check(folder, capsys)
    assert (status, verdict) == (0, "doubtful")
    wanted = {
        "overlap": ["009.jpg"],
        "exposure": ["015.jpg"],
        "sizes": ["020.jpg"],
        "left out": ["004.jpg", "021.jpg", "022.jpg", "050.jpg"],
    }
    assert {subject: findings[subject]["photos"] for subject in wanted} == wanted
    assert doubts(findings) == set(wanted)
    assert [one.name for one in find_odd_photos(sorted(folder.iterdir()))] == [
        str(folder / name) for name in wanted["left out"]
    ]
    assert all(finding["remedy"] for subject, finding in findings.items() if subject in wanted)
    # a photo that `capture` can use stays: without neighbours, fewer of the others get a pose
    advice = " ".join(findings[subject]["remedy"] for subject in ("overlap", "exposure", "sizes"))
    assert "leave" not in advice


def test_photos_in_no_order_hang_together_by_whatever_shows_the_same_place(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # every line of the progress, at any speed of the machine
    monkeypatch.setattr("splatgraft.runtime.console._LINE_SECONDS", 0.0)
    wall = np.hstack([texture(seed) for seed in range(5)])
    width, height = SIZE
    # each shows what two or three others show
    photos = [wall[:height, 150 * i : 150 * i + width] for i in np.random.default_rng(1).permutation(COUNT)]
    photos[3] = np.rot90(photos[3])  # held on its side by the same camera
    assert main(["check", str(save(tmp_path / "photos", photos)), "--json"]) == 0
    printed = capsys.readouterr()
    found = json.loads(printed.out)
    levels = {finding["subject"]: finding["level"] for finding in found["findings"]}
    assert (found["verdict"], levels["overlap"], levels["sizes"]) == ("good", "good", "good")
    # the step that takes longest
    assert "looking for partners" in printed.err


def test_one_photo_many_times_and_pictures_of_nothing_in_common_are_not_usable(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, findings, verdict = check(save(tmp_path / "one", [walk(count=1)[0]] * 12), capsys)
    assert (status, verdict) == (1, "unusable")
    assert findings["left out"]["level"] == findings["count"]["level"] == "unusable"
    assert len(findings["left out"]["photos"]) == 11
    screenshots = [texture(seed)[:240, :320] for seed in range(9)]
    status, findings, _ = check(save(tmp_path / "photos", screenshots), capsys)
    assert status == 1
    assert findings["overlap"]["level"] == "unusable"


def test_photos_of_two_places_are_told_apart_and_exposure_settings_are_compared(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = [Exposure(1 / 60, 8.0, 100.0), Exposure(1 / 15, 8.0, 100.0)]
    places = [*walk(count=8), *walk(seed=1, count=6)]
    status, findings, verdict = check(save(tmp_path / "photos", places, exposure=lambda i: settings[i % 2]), capsys)
    assert (status, verdict) == (0, "doubtful")
    assert findings["overlap"]["photos"] == [f"{i:03d}.jpg" for i in range(8, 14)]
    assert "2.0 stops apart" in findings["settings"]["text"]


def test_given_poses_and_masks_are_seen_and_a_video_is_looked_at(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photograph(tmp_path / "posed", plane((0.3, 0.5, 0.3)), ball())
    _, findings, _ = check(tmp_path / "posed", capsys)
    assert "given for 8 images" in findings["poses"]["text"]
    assert findings["masks"]["text"] == "8 masks"
    assert findings["overlap"]["level"] == "good"
    assert "the photos cover 315 of 360 degrees" in findings["coverage"]["text"]
    photograph(tmp_path / "front", plane((0.3, 0.5, 0.3)), ball(), around_deg=120.0)
    _, findings, _ = check(tmp_path / "front", capsys)
    assert findings["coverage"]["level"] == "doubtful"
    assert "between " in findings["coverage"]["text"]
    path = tmp_path / "walk.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, SIZE)
    for photo in walk(count=12):
        writer.write(cv2.cvtColor(photo, cv2.COLOR_GRAY2BGR))
    writer.release()
    status, findings, _ = check(path, capsys)
    assert status == 0
    assert findings["video"]["text"].startswith("12 frames")


def test_what_is_no_capture_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "clip.mp4"
    path.write_bytes(b"no video")
    (tmp_path / "empty").mkdir()
    for given in (path, tmp_path / "empty"):
        capsys.readouterr()
        assert main(["check", str(given)]) == 2
        assert f"{given}: expected" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize("kernel", [np.ones((1, 9)), np.ones((9, 1)), np.eye(9)])
def test_camera_motion_in_any_direction_blurs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kernel: np.ndarray
) -> None:
    sharp = walk()
    blurred = [cv2.filter2D(photo, -1, kernel / kernel.sum()) for photo in sharp]
    more = [cv2.filter2D(photo, -1, kernel / kernel.sum()) for photo in blurred]
    sharpness = [[log_sharpness(photo.astype(np.float32)) for photo in photos] for photos in (more, blurred, sharp)]
    assert np.all(np.diff(sharpness, axis=0) > 0)
    _, findings, _ = check(save(tmp_path / "photos", blurred), capsys)
    assert findings["sharpness"]["level"] == "doubtful"
