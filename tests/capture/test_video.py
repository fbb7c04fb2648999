"""Capture of video: sharp frames at equal steps of motion; pauses, cuts, and damaged files."""

import wave

import cv2
import numpy as np
import pytest

from splatgraft.capture import extract_frames

SIZE = (160, 120)
STEP_PX = 2
"""Motion of the picture from frame to frame: 1.25% of its width."""


def world(seed: int = 0) -> np.ndarray:
    """Return a textured wall, wide enough for a pan."""
    noise = np.random.default_rng(seed).integers(0, 255, (60, 400, 3), np.uint8)
    return cv2.resize(noise, (1600, 240), interpolation=cv2.INTER_CUBIC)


def view(wall: np.ndarray, x: float, *, blurred: bool = False) -> np.ndarray:
    shown = wall[40 : 40 + SIZE[1], round(x) : round(x) + SIZE[0]]
    return cv2.GaussianBlur(shown, (0, 0), 2.5) if blurred else shown


def write(path, frames):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, SIZE)
    for frame in frames:
        writer.write(np.ascontiguousarray(frame))
    writer.release()
    return path


def extracted(path, count) -> tuple[list[int], str]:
    """Return the numbers of the frames, and the messages."""
    paths, notes = extract_frames(path, path.parent / "frames", count=count)
    assert all(cv2.imread(str(frame)).shape == (SIZE[1], SIZE[0], 3) for frame in paths)
    return [int(frame.stem.split("_")[1]) for frame in paths], "\n".join(note.text for note in notes)


def test_each_frame_is_a_sharp_one(tmp_path):
    """Two of every eight frames are sharp; four stretches of 16 frames have sharp ones in their middle."""
    sharp = {i for i in range(64) if i % 8 in (3, 4)}
    frames = (view(world(), STEP_PX * i, blurred=i not in sharp) for i in range(64))
    chosen, _ = extracted(write(tmp_path / "walk.avi", frames), 4)
    assert len(chosen) == 4
    assert set(chosen) <= sharp


def test_a_pause_gives_one_frame_and_motion_decides(tmp_path):
    """30 frames of walking, 100 of standing with noise, 30 of walking: by time most frames would show the pause."""
    generator = np.random.default_rng(1)
    positions = [STEP_PX * i for i in range(30)] + [60] * 100 + [60 + STEP_PX * i for i in range(30)]
    frames = (
        np.clip(view(world(), x).astype(int) + generator.normal(0, 3, (SIZE[1], SIZE[0], 1)), 0, 255).astype(np.uint8)
        for x in positions
    )
    chosen, said = extracted(write(tmp_path / "walk.avi", frames), 20)
    assert 15 <= len(chosen) <= 20
    assert sum(30 <= number < 130 for number in chosen) <= 2  # the pause, and where it begins
    # neighbours are different views: at least half a step of a twentieth of 120 px
    assert min(np.diff([positions[number] for number in chosen])) >= 2
    assert "stands still for about 1" in said


def test_a_slow_video_gives_fewer_frames_than_asked_for(tmp_path):
    """40 frames that move by 0.5 px: 20 px in all, six steps of 2% of the width."""
    chosen, _ = extracted(write(tmp_path / "slow.avi", (view(world(), 0.5 * i) for i in range(40))), 120)
    assert 5 <= len(chosen) <= 8


def test_cuts_are_found_and_said(tmp_path):
    frames = [view(world(0), STEP_PX * i) for i in range(30)] + [view(world(7), STEP_PX * i) for i in range(30)]
    chosen, said = extracted(write(tmp_path / "two.avi", frames), 10)
    assert "the video is cut at 3.0 s:" in said
    assert abs(sum(number < 30 for number in chosen) - sum(number >= 30 for number in chosen)) <= 1


def test_motion_and_blur_are_no_cut(tmp_path):
    """Frames that move by 6% of the width, some of them blurred."""
    frames = (view(world(), 10 * i, blurred=i % 4 == 2) for i in range(60))
    chosen, said = extracted(write(tmp_path / "fast.avi", frames), 30)
    assert len(chosen) >= 25
    assert "cut at" not in said


def test_a_camera_that_never_moves_is_refused(tmp_path):
    path = write(tmp_path / "tripod.avi", (view(world(), 5) for _ in range(40)))
    with pytest.raises(ValueError, match=r"tripod\.avi: expected a camera that moves around, found 1 different views"):
        extracted(path, 10)
    assert not (tmp_path / "frames").exists()


def test_black_frames_are_survived_and_a_truncated_video_goes_on(tmp_path):
    frames = [view(world(), STEP_PX * i) for i in range(60)]
    frames[10:14] = [np.zeros_like(frames[0])] * 4
    chosen, _ = extracted(write(tmp_path / "dark.avi", frames), 16)
    assert not set(chosen) & set(range(10, 14))
    data = (tmp_path / "dark.avi").read_bytes()
    (tmp_path / "cut.avi").write_bytes(data[: len(data) * 2 // 3])
    chosen, said = extracted(tmp_path / "cut.avi", 8)
    assert len(chosen) >= 3
    assert "truncated" in said


@pytest.mark.parametrize("content", [None, b"", b"no video at all" * 100, "sound", "header"])
def test_what_is_no_video_is_named(content, tmp_path):
    path = tmp_path / "clip.mp4"
    if content == "sound":
        with wave.open(str(path), "wb") as stream:
            stream.setnchannels(1)
            stream.setsampwidth(2)
            stream.setframerate(8000)
            stream.writeframes(bytes(16000))
    elif content == "header":
        whole = write(tmp_path / "whole.avi", [view(world(), 0)] * 9)
        path.write_bytes(whole.read_bytes()[:300])
    elif content is not None:
        path.write_bytes(content)
    with pytest.raises(ValueError, match=r"clip\.mp4: expected a video") as caught:
        extracted(path, 10)
    assert "\n" not in str(caught.value)
