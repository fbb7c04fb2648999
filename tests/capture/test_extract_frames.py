"""Capture, video: the sharpest frame of each interval is taken, and files that are no video are refused."""

import cv2
import numpy as np
import pytest

from splatgraft.capture import extract_frames

SHARP = (2, 5, 11, 13)


@pytest.fixture
def video(tmp_path):
    """16 frames, all blurred but one in each stretch of four."""
    path = tmp_path / "walk.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (96, 64))
    generator = np.random.default_rng(0)
    for index in range(16):
        frame = generator.integers(0, 255, (64, 96, 3), np.uint8)
        writer.write(frame if index in SHARP else cv2.GaussianBlur(frame, (0, 0), 3))
    writer.release()
    return path


def test_sharpest_frame_of_each_stretch(video, tmp_path):
    paths = extract_frames(video, tmp_path / "frames", count=4)
    assert [int(path.stem.split("_")[1]) for path in paths] == list(SHARP)
    assert all(cv2.imread(str(path)).shape == (64, 96, 3) for path in paths)


def test_a_short_video_gives_all_its_frames(video, tmp_path):
    assert len(extract_frames(video, tmp_path / "frames", count=100)) == 16


@pytest.mark.parametrize("content", [None, b"", b"no video at all" * 100])
def test_what_is_no_video_is_named(content, tmp_path):
    path = tmp_path / "clip.mp4"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ValueError, match=r"clip\.mp4: expected a video"):
        extract_frames(path, tmp_path / "frames")
