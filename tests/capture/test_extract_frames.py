"""Capture, video: sharp frames at equal steps of motion; pauses, cuts, and files that are no whole video."""

import wave

import cv2
import numpy as np
import pytest

from splatgraft.capture import extract_frames

SIZE = (160, 120)
STEP_PX = 2
"""The picture's motion from frame to frame: 1.25% of its width."""


def world(seed: int = 0) -> np.ndarray:
    """A textured wall, wide enough to pan along."""
    noise = np.random.default_rng(seed).integers(0, 255, (60, 400, 3), np.uint8)
    return cv2.resize(noise, (1600, 240), interpolation=cv2.INTER_CUBIC)


def view(wall: np.ndarray, x: float, *, blurred: bool = False) -> np.ndarray:
    shown = wall[40 : 40 + SIZE[1], round(x) : round(x) + SIZE[0]]
    return cv2.GaussianBlur(shown, (0, 0), 2.5) if blurred else shown


def write(path, frames, *, rate: float = 10) -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), rate, SIZE)
    for frame in frames:
        writer.write(np.ascontiguousarray(frame))
    writer.release()


def numbers(paths) -> list[int]:
    return [int(path.stem.split("_")[1]) for path in paths]


def test_each_frame_is_a_sharp_one(tmp_path):
    """Of every eight frames two are sharp; four stretches of 16 frames have sharp ones in their middle."""
    sharp = {i for i in range(64) if i % 8 in (3, 4)}
    write(tmp_path / "walk.avi", (view(world(), STEP_PX * i, blurred=i not in sharp) for i in range(64)))
    paths = extract_frames(tmp_path / "walk.avi", tmp_path / "frames", count=4)
    assert len(paths) == 4
    assert set(numbers(paths)) <= sharp
    assert all(cv2.imread(str(path)).shape == (SIZE[1], SIZE[0], 3) for path in paths)


def test_a_pause_gives_one_frame_and_motion_decides(tmp_path):
    """30 frames of walking, 100 of standing with noise, 30 of walking: by time most frames would show the pause."""
    generator = np.random.default_rng(1)
    positions = [STEP_PX * i for i in range(30)] + [60] * 100 + [60 + STEP_PX * i for i in range(30)]
    frames = (
        np.clip(view(world(), x).astype(int) + generator.normal(0, 3, (SIZE[1], SIZE[0], 1)), 0, 255).astype(np.uint8)
        for x in positions
    )
    write(tmp_path / "walk.avi", frames)
    said = []
    chosen = numbers(extract_frames(tmp_path / "walk.avi", tmp_path / "frames", count=20, say=said.append))
    assert 15 <= len(chosen) <= 20
    assert sum(30 <= number < 130 for number in chosen) <= 2  # the pause, and where it begins
    # neighbours are different views: at least half a step of a twentieth of 120 px
    assert min(np.diff([positions[number] for number in chosen])) >= 2
    assert any("stands still for about 1" in sentence for sentence in said)


def test_a_slow_video_gives_fewer_frames_than_asked_for(tmp_path):
    """40 frames that move by 0.5 px: 20 px in all, six steps of 2% of the width."""
    write(tmp_path / "slow.avi", (view(world(), 0.5 * i) for i in range(40)))
    chosen = numbers(extract_frames(tmp_path / "slow.avi", tmp_path / "frames", count=120))
    assert 5 <= len(chosen) <= 8


def test_cuts_are_found_and_said(tmp_path):
    frames = [view(world(0), STEP_PX * i) for i in range(30)] + [view(world(7), STEP_PX * i) for i in range(30)]
    write(tmp_path / "two.avi", frames)
    said = []
    chosen = numbers(extract_frames(tmp_path / "two.avi", tmp_path / "frames", count=10, say=said.append))
    assert any("the video is cut at 3.0 s:" in sentence for sentence in said)
    assert abs(sum(number < 30 for number in chosen) - sum(number >= 30 for number in chosen)) <= 1


def test_motion_and_blur_are_no_cut(tmp_path):
    """Frames that move by 6% of the width, some of them blurred."""
    write(tmp_path / "fast.avi", (view(world(), 10 * i, blurred=i % 4 == 2) for i in range(60)))
    said = []
    assert len(extract_frames(tmp_path / "fast.avi", tmp_path / "frames", count=30, say=said.append)) >= 25
    assert not any("cut at" in sentence for sentence in said)


def test_a_camera_that_never_moves_is_refused(tmp_path):
    write(tmp_path / "tripod.avi", (view(world(), 5) for _ in range(40)))
    with pytest.raises(ValueError, match=r"tripod\.avi: expected a camera that moves around, found 1 different views"):
        extract_frames(tmp_path / "tripod.avi", tmp_path / "frames")
    assert not (tmp_path / "frames").exists()


def test_black_frames_are_survived(tmp_path):
    frames = [view(world(), STEP_PX * i) for i in range(30)]
    frames[10:14] = [np.zeros_like(frames[0])] * 4
    write(tmp_path / "dark.avi", frames)
    chosen = numbers(extract_frames(tmp_path / "dark.avi", tmp_path / "frames", count=8))
    assert not set(chosen) & set(range(10, 14))


def test_a_truncated_video_goes_on_and_is_said_to_be(tmp_path):
    write(tmp_path / "whole.avi", (view(world(), STEP_PX * i) for i in range(60)))
    data = (tmp_path / "whole.avi").read_bytes()
    (tmp_path / "cut.avi").write_bytes(data[: len(data) * 2 // 3])
    said = []
    assert len(extract_frames(tmp_path / "cut.avi", tmp_path / "frames", count=8, say=said.append)) >= 3
    assert any("truncated" in sentence for sentence in said)


def sound(path) -> None:
    with wave.open(str(path), "wb") as stream:
        stream.setnchannels(1)
        stream.setsampwidth(2)
        stream.setframerate(8000)
        stream.writeframes(bytes(16000))


@pytest.mark.parametrize("content", [None, b"", b"no video at all" * 100, "sound", "header"])
def test_what_is_no_video_is_named(content, tmp_path):
    path = tmp_path / "clip.mp4"
    if content == "sound":
        sound(path)
    elif content == "header":
        write(tmp_path / "whole.avi", [view(world(), 0)] * 9)
        path.write_bytes((tmp_path / "whole.avi").read_bytes()[:300])
    elif content is not None:
        path.write_bytes(content)
    with pytest.raises(ValueError, match=r"clip\.mp4: expected a video") as caught:
        extract_frames(path, tmp_path / "frames")
    assert "\n" not in str(caught.value)
