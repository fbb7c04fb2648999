"""Uploads go to the disk part by part, are refused early, and are checked as files on disk are."""

import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_project import ball
from viser import _messages
from waiting import HANG_LIMIT, wait_until

from splatgraft.editor.access.access_control import AccessControl
from splatgraft.editor.access.uploads import SCENES, SUFFIXES, IncomingUpload, UploadRules, remove_remains
from splatgraft.editor.page.server import GuardedServer
from splatgraft.editor.page.upload_receiver import UploadButton, UploadReceiver
from splatgraft.formats import write_gaussians


def uploaded(rules: UploadRules, name: str, content: bytes) -> Path:
    upload = IncomingUpload(rules, name, len(content))
    for index in range(0, len(content), 1000):
        upload.add(index // 1000, content[index : index + 1000])
    return upload.finish()


@pytest.fixture
def scene(tmp_path: Path) -> bytes:
    write_gaussians(tmp_path / "ball.ply", ball())
    return (tmp_path / "ball.ply").read_bytes()


def test_uploads_are_read_before_they_are_stored(tmp_path: Path, scene: bytes) -> None:
    rules = UploadRules(tmp_path, SCENES)
    kept = uploaded(rules, "../../my ball.ply", scene)
    assert kept == tmp_path / "uploads" / "my_ball.ply"
    assert kept.read_bytes() == scene
    with pytest.raises(ValueError, match=r"^my_ball\.ply: "):
        uploaded(rules, "my ball.ply", b"ply\nnonsense")
    assert kept.read_bytes() == scene
    with pytest.raises(ValueError, match="ends in"):
        uploaded(rules, "page.html", b"<html>")
    assert sorted(p.name for p in kept.parent.iterdir()) == ["my_ball.ply"]


def test_videos_are_checked_as_scenes_are(tmp_path: Path) -> None:
    video = tmp_path / "walk.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    for level in range(5):
        writer.write(np.full((48, 64, 3), 40 * level, np.uint8))
    writer.release()
    rules = UploadRules(tmp_path, SUFFIXES)
    assert uploaded(rules, "walk.avi", video.read_bytes()).read_bytes() == video.read_bytes()
    for name, content in (("noise.mp4", b"no video" * 1000), ("text.mov", b"x")):
        with pytest.raises(ValueError, match=f"^{name}: expected a video"):
            uploaded(rules, name, content)
    assert [p.name for p in (tmp_path / "uploads").iterdir()] == ["walk.avi"]


def test_wrong_sizes_and_orders_are_refused(tmp_path: Path) -> None:
    rules = UploadRules(tmp_path, SCENES, limit=100)
    for size, found in ((101, "0 MiB"), (0, "an empty one")):
        with pytest.raises(ValueError, match=f"found {found}; give its path"):
            IncomingUpload(rules, "a.ply", size)
    with pytest.raises(ValueError, match="MiB on the disk"):
        IncomingUpload(UploadRules(tmp_path, SCENES, limit=1 << 62), "a.ply", 1 << 60)
    upload = IncomingUpload(rules, "a.ply", 10)
    for index, content in ((1, b"x"), (0, b"x" * 11)):
        with pytest.raises(ValueError, match="in order"):
            upload.add(index, content)
    with pytest.raises(ValueError, match="expected 10 bytes, found 0"):
        upload.finish()
    assert not list((tmp_path / "uploads").iterdir())
    (tmp_path / "uploads" / ".trial_a.ply").write_bytes(b"left by a killed editor")
    remove_remains(tmp_path)
    assert not list((tmp_path / "uploads").iterdir())


class Wire:
    """A receiver with one button, what it sent, and what it said."""

    def __init__(self, folder: Path, *, limit: int = 10_000_000) -> None:
        self.sent: list[object] = []
        self.said: list[str] = []
        self.stored: list[Path] = []
        self.progress: list[IncomingUpload | None] = []
        self.receiver = UploadReceiver(lambda window, message: self.sent.append(message))
        self.receiver.on_refused = self.said.append
        self.receiver.on_progress = self.progress.append
        rules = UploadRules(folder, SCENES, limit)
        self.receiver._buttons["button"] = UploadButton(
            lambda: rules, lambda upload: self.stored.append(upload.finish())
        )

    def begin(self, name: str, size: int, window: int = 1) -> None:
        message = _messages.FileTransferStartUpload("button", name, name, "", 1, size)
        self.receiver.receive(window, message)

    def part(self, name: str, index: int, content: bytes, window: int = 1) -> None:
        message = _messages.FileTransferPart("button", transfer_uuid=name, part_index=index, content=content)
        self.receiver.receive(window, message)


def is_release(message: object) -> bool:
    """Whether viser's button counts it as the end of an upload, and its notification does not as a success."""
    return isinstance(message, _messages.FileTransferPartAck) and message.total_bytes < 0


def test_an_upload_is_acknowledged_part_by_part_and_stored(tmp_path: Path, scene: bytes) -> None:
    wire = Wire(tmp_path)
    wire.begin("a.ply", len(scene))
    half = len(scene) // 2
    wire.part("a.ply", 0, scene[:half])
    wire.part("a.ply", 1, scene[half:])
    wait_until(lambda: bool(wire.stored), what="the stored upload")
    assert wire.stored[0].read_bytes() == scene
    acknowledged = [m.transferred_bytes for m in wire.sent if isinstance(m, _messages.FileTransferPartAck)]
    assert acknowledged == [half, len(scene)]


def test_a_refused_upload_frees_the_button_at_once_and_its_parts_are_ignored(tmp_path: Path) -> None:
    wire = Wire(tmp_path, limit=5)
    wire.begin("large.ply", 2 << 30)
    assert "expected a file of at most" in wire.said[0]
    assert is_release(wire.sent[0])
    wire.part("large.ply", 0, b"x" * 100)
    assert len(wire.sent) == 1
    # what was never announced, and another button's
    wire.part("other.ply", 0, b"x")
    assert not (tmp_path / "uploads").exists()
    # and the browser's notification, which would turn for ever, is hidden
    wait_until(lambda: isinstance(wire.sent[-1], _messages.RemoveNotificationMessage), what="a hidden notification")


def test_an_upload_can_be_cancelled_and_ends_with_its_window(tmp_path: Path) -> None:
    wire = Wire(tmp_path)
    for end in (wire.receiver.cancel, lambda: wire.receiver.window_closed(1)):
        wire.begin("a.ply", 100)
        wire.part("a.ply", 0, b"x" * 10)
        wire.begin("b.ply", 100)
        assert "one upload at a time" in wire.said[-1]
        end()
        assert "cancelled" in wire.said[-1]
        assert is_release([m for m in wire.sent if isinstance(m, _messages.FileTransferPartAck)][-1])
        assert not list((tmp_path / "uploads").iterdir())
        assert wire.progress[-1] is None


_LARGE = textwrap.dedent("""
    import resource, sys
    from pathlib import Path
    from splatgraft.editor.access.uploads import IncomingUpload, UploadRules
    folder, size, part = Path(sys.argv[1]), 600 << 20, 512 << 10
    upload = IncomingUpload(UploadRules(folder, (".mp4",)), "a.mp4", size)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for index in range(size // part):
        upload.add(index, bytes(part))
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert upload.is_complete
    upload.discard()
    print(grown)
""")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="measures memory by getrusage")
def test_a_large_upload_takes_no_memory(tmp_path: Path) -> None:
    words = [sys.executable, "-c", _LARGE, str(tmp_path)]
    grown = subprocess.run(words, capture_output=True, text=True, check=True, timeout=HANG_LIMIT).stdout
    # KiB on Linux: a few parts of half a MiB, of 600 MiB
    assert int(grown) < 20_000


@pytest.fixture
def guarded() -> Iterator[GuardedServer]:
    made = GuardedServer(AccessControl("secret"), host="127.0.0.1", port=0)
    yield made
    made.close()


def test_uploads_never_reach_viser_s_memory(guarded: GuardedServer, tmp_path: Path, scene: bytes) -> None:
    stored: list[Path] = []
    button = guarded.viser.gui.add_upload_button("Upload")
    rules = UploadRules(tmp_path, SCENES)
    guarded.uploads.register(button, UploadButton(lambda: rules, lambda upload: stored.append(upload.finish())))
    guarded.edit_lock = guarded.edit_lock.with_window(1)

    async def inner(window: int, message: object) -> None:
        raise AssertionError("viser would collect it")

    uuid = button._impl.uuid
    for message in (
        _messages.FileTransferStartUpload(uuid, "t", "a.ply", "", 1, len(scene)),
        _messages.FileTransferPart(uuid, transfer_uuid="t", part_index=0, content=scene),
    ):
        with pytest.raises(StopIteration):
            guarded._forward_allowed(inner, 1, message).send(None)
    wait_until(lambda: bool(stored), what="the stored upload")
    assert stored[0].read_bytes() == scene
