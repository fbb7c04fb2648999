"""Uploads through the editor's server, as the form of its page makes them: broken, continued, refused, taken over."""

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from editor import Client
from editor_driver import Editor
from test_server_and_windows import status, websocket_status
from tiny_project import ball
from upload_requests import ChosenFile, Upload, arriving, opened_window
from waiting import wait_until

from splatgraft.core.gaussians import concatenate
from splatgraft.editor.uploads.incoming_upload import LIMIT_BYTES
from splatgraft.formats import write_gaussians

MIB = 1 << 20


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A scene file of about 0.6 MB, so of several parts."""
    path = tmp_path_factory.mktemp("scene") / "balls.ply"
    write_gaussians(path, concatenate([ball()] * 100))
    content = path.read_bytes()
    assert len(content) > 400_000
    return content


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Editor, Path]]:
    project = tmp_path_factory.mktemp("uploads") / "project" / "project.toml"
    project.parent.mkdir()
    made = Editor(project)
    yield made, project
    made.kill()


@pytest.fixture
def editor(served: tuple[Editor, Path]) -> Editor:
    return served[0]


@pytest.fixture
def project(served: tuple[Editor, Path]) -> Path:
    return served[1]


@pytest.fixture
def open_window(editor: Editor) -> Iterator[Callable[[], tuple[Client, str]]]:
    windows: list[Client] = []

    def open_one() -> tuple[Client, str]:
        window, key = opened_window(editor.url)
        windows.append(window)
        return window, key

    yield open_one
    for window in windows:
        window.close()


@pytest.fixture
def window(open_window: Callable[[], tuple[Client, str]]) -> tuple[Client, str]:
    return open_window()


def ready(url: str, key: str, file: ChosenFile, **options: str) -> Upload:
    """An upload that the server is ready for; the form tries again until it is."""
    made: list[Upload] = []

    def is_ready() -> bool:
        made.append(Upload(url, key, file, **options))
        return made[-1].answer["type"] != "wait"

    wait_until(is_ready, what="a page that receives uploads")
    return made[-1]


def contents(window: Client) -> str:
    """All texts of the panel."""
    return " ".join(str(props.get("content")) for props in window._gui.values())


def test_a_broken_upload_goes_on_where_it_stopped(
    editor: Editor, project: Path, window: tuple[Client, str], scene: bytes
) -> None:
    file = ChosenFile(scene)
    first = ready(editor.url, window[1], file)
    assert first.begin() == 0
    first.send_parts(until=300_000)
    first.cut()
    window[0].until(lambda: "ball.ply: 0.3 of" in contents(window[0]))
    # chosen again later, in a page that was loaded again
    second = Upload(editor.url, window[1], ChosenFile(scene))
    assert second.begin() == 300_000
    second.send_parts()
    assert first.sent + second.sent == len(scene)
    assert second.end() == {"type": "stored", "text": "ball.ply: stored"}
    assert (project.parent / "uploads" / "ball.ply").read_bytes() == scene
    assert arriving(project) == []
    window[0].until(lambda: "ball.ply: stored as" in contents(window[0]))


def test_a_restarted_server_continues(tmp_path: Path, scene: bytes) -> None:
    project = tmp_path / "project" / "project.toml"
    project.parent.mkdir()
    editor = Editor(project)
    try:
        window, key = opened_window(editor.url)
        first = ready(editor.url, key, ChosenFile(scene))
        assert first.begin() == 0
        first.send_parts(until=250_000)
        # a part that is on its way when the server dies may have arrived or not
        first.connection.send(scene[250_000:260_000])
        editor.kill()
        old = project.parent / "uploads" / ".incoming_0123456789abcdef_100_old.ply"
        old.write_bytes(b"x" * 10)
        os.utime(old, (1e9, 1e9))
        editor = Editor(project)
        window, key = opened_window(editor.url)
        window.until(lambda: "old.ply: its upload was not continued for 7 days" in contents(window))
        assert not old.exists()
        second = ready(editor.url, key, ChosenFile(scene))
        assert second.begin() in (250_000, 260_000)
        second.send_parts()
        assert second.end()["type"] == "stored"
        assert (project.parent / "uploads" / "ball.ply").read_bytes() == scene
        window.close()
    finally:
        editor.kill()


def test_only_the_page_s_own_windows_may_upload(
    editor: Editor, project: Path, window: tuple[Client, str], scene: bytes
) -> None:
    own, query = editor.base, f"/upload?token={editor.token}"
    assert websocket_status(own, own, "/upload") == 403
    assert websocket_status(own, own, "/upload?token=guess") == 403
    assert websocket_status(own, "http://evil.example", query) == 403
    assert websocket_status(own, None, query) == 403
    assert websocket_status(own, own, query) == 101
    assert status(f"{own}/upload_form.js") == 403
    assert status(f"{own}/upload_form.js?token={editor.token}") == 200
    assert status(f"{own}/upload?token={editor.token}") == 404
    # the key of a window, which the cookie alone does not give
    ready(editor.url, window[1], ChosenFile(scene)).close()
    for key in ("", "guess"):
        assert Upload(editor.url, key, ChosenFile(scene)).answer["type"] == "wait"
    for message in ("nonsense", b"\xff", "[]", '{"window": 1}', "[" * 5000):
        broken = Upload(editor.url, window[1], ChosenFile(scene))
        broken.close()
        broken = Upload.__new__(Upload)
        broken.connection = _connected(editor)
        broken.connection.send(message)
        assert broken.hear()["text"] == "upload: expected a file's name, size and time, found another message"
    assert arriving(project) == []


def _connected(editor: Editor):
    from websockets.sync.client import connect

    address = f"{editor.base.replace('http', 'ws')}/upload?token={editor.token}"
    return connect(address, origin=editor.base, proxy=None)  # pyright: ignore


def test_the_window_without_the_edit_lock_is_refused_also_in_the_middle(
    editor: Editor, project: Path, open_window: Callable[[], tuple[Client, str]], scene: bytes
) -> None:
    _, first_key = open_window()
    upload = ready(editor.url, first_key, ChosenFile(scene))
    assert upload.begin() == 0
    second, second_key = open_window()
    locked = {"type": "locked", "text": "another window edits this project"}
    assert Upload(editor.url, second_key, ChosenFile(scene)).answer == locked
    upload.send_parts(until=200_000)
    takes: list[str] = []

    def has_button() -> bool:
        takes.extend(uuid for uuid, props in second._gui.items() if props.get("label") == "Edit here instead")
        return bool(takes)

    second.until(has_button)
    second.send("GuiUpdateMessage", uuid=takes[0], updates={"value": True})

    def is_handed_over() -> bool:
        again = Upload(editor.url, second_key, ChosenFile(scene))
        again.close()
        return again.answer["type"] == "sample"

    # a window without the lock may take it, and nothing else
    wait_until(is_handed_over, what="the edit lock of the second window")
    upload.connection.send(scene[200_000:250_000])
    assert upload.hear() == locked
    # what had arrived is kept, for whoever edits
    again = Upload(editor.url, second_key, ChosenFile(scene))
    assert again.begin() == 200_000
    again.connection.send("cancel")
    assert again.end() == {"type": "cancelled"}
    assert arriving(project) == []


def test_the_upload_of_the_last_window_goes_on_while_its_window_is_lost(
    editor: Editor, project: Path, open_window: Callable[[], tuple[Client, str]], scene: bytes
) -> None:
    window, key = open_window()
    upload = ready(editor.url, key, ChosenFile(scene))
    upload.begin()
    upload.send_parts(until=100_000)
    upload.cut()
    window.close()
    # viser's page connects again only while it has the focus
    again = Upload(editor.url, key, upload.file)
    assert again.begin() == 100_000
    again.send_parts(until=200_000)
    assert Upload(editor.url, "guess", upload.file).answer["type"] == "wait"
    # but not where another window edits by then
    other, other_key = open_window()
    again.connection.send(scene[200_000:250_000])
    assert again.hear()["type"] == "wait"
    other.close()
    wait_until(lambda: Upload(editor.url, other_key, upload.file).answer["type"] == "sample", what="the last window")
    assert Upload(editor.url, key, upload.file).answer["type"] == "wait"
    last = Upload(editor.url, other_key, upload.file)
    assert last.begin() == 200_000
    last.connection.send("cancel")
    assert last.end() == {"type": "cancelled"}


def test_a_changed_file_starts_anew_and_cancel_removes(
    editor: Editor, project: Path, window: tuple[Client, str], scene: bytes
) -> None:
    first = ready(editor.url, window[1], ChosenFile(scene, name="walk.ply"))
    first.begin()
    first.send_parts(until=300_000)
    first.close()
    assert [path.stat().st_size for path in arriving(project)] == [300_000]
    changed = Upload(editor.url, window[1], ChosenFile(scene, name="walk.ply", modified=1))
    assert changed.begin() == 0
    assert [path.stat().st_size for path in arriving(project)] == [0]
    changed.send_parts(until=100_000)
    changed.connection.send("cancel")
    assert changed.end() == {"type": "cancelled"}
    assert arriving(project) == []
    assert Upload(editor.url, window[1], ChosenFile(scene, name="walk.ply")).begin() == 0


def test_the_newest_connection_counts(editor: Editor, project: Path, window: tuple[Client, str], scene: bytes) -> None:
    # the server may learn late that the first one is dead
    file = ChosenFile(scene)
    first = ready(editor.url, window[1], file)
    first.begin()
    first.send_parts(until=100_000)
    second = Upload(editor.url, window[1], file)
    assert second.begin() == 100_000
    first.connection.send(scene[100_000:200_000])
    assert first.hear()["type"] == "wait"
    second.send_parts()
    assert second.end()["type"] == "stored"
    # the end is known to a form whose connection was lost just then
    third = Upload(editor.url, window[1], file)
    assert third.begin() == -1
    assert third.answer == {"type": "stored", "text": "ball.ply: stored"}
    assert third.sent == 0


def test_what_cannot_be_stored_is_refused_before_its_bytes_are_sent(
    editor: Editor, project: Path, window: tuple[Client, str], scene: bytes
) -> None:
    ready(editor.url, window[1], ChosenFile(scene)).close()
    cases = [
        (ChosenFile(scene, announced=LIMIT_BYTES + 1), "ball.ply: expected a file of at most 8192 MiB, found 8192 MiB"),
        (ChosenFile(b""), "ball.ply: expected a file of at most 8192 MiB, found an empty one"),
        (ChosenFile(scene, name="page.html"), "page.html: expected a file that ends in"),
        (ChosenFile(scene, form="another"), "ball.ply: expected one of the page's upload forms, found 'another'"),
        # a form takes what it is for
        (ChosenFile(scene, name="a.mp4", form="upload-a-file"), "a.mp4: expected a file that ends in .ply"),
    ]
    for file, reason in cases:
        upload = Upload(editor.url, window[1], file)
        assert upload.answer["type"] == "refused"
        assert upload.answer["text"].startswith(reason)
        window[0].until(lambda reason=reason: reason.replace("'", "&#x27;") in contents(window[0]))
    upload = Upload(editor.url, window[1], ChosenFile(scene, announced=1000))
    assert upload.begin() == 0
    upload.connection.send(scene[:1001])
    assert upload.hear() == {"type": "refused", "text": "ball.ply: expected 1000 bytes, found more; upload it again"}
    upload = Upload(editor.url, window[1], ChosenFile(bytes(3 * MIB), name="a.mp4"))
    assert upload.begin() == 0
    upload.connection.send(bytes(2 * MIB))
    assert upload.hear()["text"] == "a.mp4: expected parts of 1048576 bytes, found a larger one"
    upload = Upload(editor.url, window[1], ChosenFile(b"no scene" * 1000))
    upload.begin()
    upload.send_parts()
    assert upload.end()["type"] == "refused"
    assert upload.answer["text"].startswith("ball.ply: ")
    assert not (project.parent / "uploads" / "page.html").exists()


@pytest.mark.long
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads the peak of a process's memory from /proc")
def test_a_large_upload_takes_no_memory(editor: Editor, project: Path, window: tuple[Client, str]) -> None:
    file = ChosenFile(bytes(300 * MIB), name="large.mp4")
    upload = ready(editor.url, window[1], file)
    before = peak_memory(editor)
    assert upload.begin() == 0
    # as the form does, several parts before they are acknowledged
    part, ahead = file.content[: 128 << 10], 16
    count = len(file.content) // len(part)
    for index in range(count):
        upload.connection.send(part)
        if index >= ahead:
            upload.hear()
    while upload.hear()["type"] != "refused":
        pass
    grown = peak_memory(editor) - before
    print(f"peak memory grew by {grown / MIB:.1f} MiB of an upload of 300 MiB")
    # the parts that are on their way, the websocket's buffers, and OpenCV, which looks at the file at the end
    assert grown < 60 * MIB


def peak_memory(editor: Editor) -> int:
    """The largest resident memory so far of the editor's process, bytes."""
    lines = Path(f"/proc/{editor.process.pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) << 10 for line in lines if line.startswith("VmHWM"))
