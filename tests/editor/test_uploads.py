"""What has arrived of uploads on the disk: it is continued, refused early, and checked as files on disk are."""

import os
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_project import ball

from splatgraft.editor.uploads.incoming_upload import (
    KEPT_DAYS,
    AnnouncedFile,
    IncomingUpload,
    InterruptedUpload,
    UploadRules,
    interrupted_uploads,
    remove_old_uploads,
)
from splatgraft.editor.uploads.upload_checks import SCENES, SUFFIXES, check_file
from splatgraft.formats import write_gaussians

MODIFIED = 1_700_000_000_000


def rules_of(folder: Path, suffixes: tuple[str, ...] = SUFFIXES) -> UploadRules:
    return UploadRules(folder, suffixes, check_file)


def begun(rules: UploadRules, name: str, content: bytes, *, modified: int = MODIFIED) -> IncomingUpload:
    file = AnnouncedFile(name, len(content), modified)
    return IncomingUpload(rules, file, file.digest(content[:100] + content[-100:]))


def uploaded(rules: UploadRules, name: str, content: bytes) -> Path:
    upload = begun(rules, name, content)
    for index in range(0, len(content), 1000):
        upload.add(content[index : index + 1000])
    assert upload.is_complete
    return upload.finish()


@pytest.fixture
def scene(tmp_path: Path) -> bytes:
    write_gaussians(tmp_path / "ball.ply", ball())
    return (tmp_path / "ball.ply").read_bytes()


def test_uploads_are_read_before_they_are_stored(tmp_path: Path, scene: bytes) -> None:
    rules = rules_of(tmp_path, SCENES)
    kept = uploaded(rules, "../../my ball.ply", scene)
    assert kept == tmp_path / "uploads" / "my_ball.ply"
    assert kept.read_bytes() == scene
    with pytest.raises(ValueError, match=r"^my_ball\.ply: "):
        uploaded(rules, "my ball.ply", b"ply\nnonsense")
    assert kept.read_bytes() == scene
    with pytest.raises(ValueError, match="ends in"):
        uploaded(rules, "page.html", b"<html>")
    long = uploaded(rules, "x" * 255 + ".PLY", scene)
    assert long.suffix == ".PLY"
    assert sorted(p.name for p in kept.parent.iterdir()) == sorted(["my_ball.ply", long.name])


def test_videos_are_checked_as_scenes_are(tmp_path: Path) -> None:
    video = tmp_path / "walk.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    for level in range(5):
        writer.write(np.full((48, 64, 3), 40 * level, np.uint8))
    writer.release()
    assert uploaded(rules_of(tmp_path), "walk.avi", video.read_bytes()).read_bytes() == video.read_bytes()
    for name, content in (("noise.mp4", b"no video" * 1000), ("text.mov", b"x")):
        with pytest.raises(ValueError, match=f"^{name}: expected a video"):
            uploaded(rules_of(tmp_path), name, content)
    assert [p.name for p in (tmp_path / "uploads").iterdir()] == ["walk.avi"]


def test_wrong_sizes_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    rules = UploadRules(tmp_path, SCENES, check_file, limit=100)
    for size, found in ((101, "0 MiB"), (0, "an empty one"), (-1, "an empty one")):
        with pytest.raises(ValueError, match=f"found {found}; give its path"):
            rules.accepted_path(AnnouncedFile("a.ply", size, MODIFIED))
    assert not (tmp_path / "uploads").exists()
    with pytest.raises(ValueError, match="MiB on the disk"):
        IncomingUpload(
            UploadRules(tmp_path, SCENES, check_file, limit=1 << 62), AnnouncedFile("a.ply", 1 << 60, 0), "0" * 16
        )
    upload = begun(rules, "a.ply", b"x" * 10)
    with pytest.raises(ValueError, match="expected 10 bytes, found more"):
        upload.add(b"x" * 11)
    upload.discard()
    assert not list((tmp_path / "uploads").iterdir())


def test_an_upload_of_the_same_file_continues_and_one_of_a_changed_file_does_not(tmp_path: Path, scene: bytes) -> None:
    rules = rules_of(tmp_path)
    first = begun(rules, "ball.ply", scene)
    first.add(scene[:1000])
    # without closing the first one: the editor was killed
    again = begun(rules, "ball.ply", scene)
    assert again.received == 1000
    first.pause()
    again.add(scene[1000:1500])
    again.pause()
    assert interrupted_uploads(tmp_path) == (InterruptedUpload("ball.ply", len(scene), 1500),)
    changed = (
        {"content": scene[:-1] + b"#"},
        {"content": b"#" + scene[1:]},
        {"content": scene + b"#"},
        {"content": scene, "modified": MODIFIED + 1},
    )
    for change in changed:
        upload = begun(rules, "ball.ply", **change)
        assert upload.received == 0
        # what had arrived of the earlier one is of no use any more
        assert len(list((tmp_path / "uploads").iterdir())) == 1
        upload.add(b"x" * 10)
        upload.pause()
    # another file's upload is left alone
    begun(rules, "other.ply", scene).pause()
    assert [upload.name for upload in interrupted_uploads(tmp_path)] == ["ball.ply", "other.ply"]


def test_what_was_not_continued_for_days_is_deleted_with_a_reason(tmp_path: Path, scene: bytes) -> None:
    rules = rules_of(tmp_path)
    for name in ("old walk.ply", "new.ply"):
        upload = begun(rules, name, scene)
        upload.add(scene[:10])
        upload.pause()
    (old,) = (tmp_path / "uploads").glob("*old_walk.ply")
    long_ago = time.time() - (KEPT_DAYS + 1) * 86400
    os.utime(old, (long_ago, long_ago))
    (tmp_path / "uploads" / "stored.ply").write_bytes(scene)
    os.utime(tmp_path / "uploads" / "stored.ply", (long_ago, long_ago))
    said = remove_old_uploads(tmp_path, now=time.time())
    assert said == ("old_walk.ply: its upload was not continued for 7 days, and what had arrived was deleted",)
    assert sorted(p.name.rpartition("_")[2] for p in (tmp_path / "uploads").iterdir()) == ["new.ply", "stored.ply"]
    assert remove_old_uploads(tmp_path / "nowhere", now=time.time()) == ()
