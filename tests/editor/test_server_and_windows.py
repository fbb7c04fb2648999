"""The editor's server: access control, uploads, a second window, a second editor on the same project."""

import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from editor_driver import Editor, Window
from tiny_project import write_project
from waiting import HANG_LIMIT

from splatgraft.editor.access.access_control import cookie_name


@pytest.fixture
def project(tmp_path: Path) -> Path:
    return write_project(tmp_path)


@pytest.fixture
def editor(project: Path) -> Iterator[Editor]:
    made = Editor(project)
    yield made
    if made.process.poll() is None:
        made.kill()


def status(url: str, **headers: str) -> int:
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=HANG_LIMIT) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        with error:
            return error.code


def websocket_status(url: str, origin: str | None, query: str = "") -> int:
    """HTTP status of the answer to a websocket request with that origin."""
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    try:
        with connect(
            url.replace("http", "ws") + query,
            origin=origin,  # pyright: ignore
            subprotocols=["viser-v1.1.1"],  # pyright: ignore
            open_timeout=HANG_LIMIT,
        ):
            return 101
    except InvalidStatus as refused:
        return refused.response.status_code


def test_the_page_is_served_before_torch_is_loaded() -> None:
    source = "import sys, splatgraft.commands.edit, splatgraft.editor.page.server; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_foreign_origins_hosts_and_paths_are_refused(editor: Editor, project: Path) -> None:
    own, query = editor.base, f"/?token={editor.token}"
    assert len(editor.token) > 20
    assert status(own + query) == 200
    assert status(own) == 403
    assert status(own + query, Origin="http://evil.example") == 403
    assert status(own + query, Host="evil.example") == 403
    assert websocket_status(own, own, query) == 101
    # a program of another user of this machine that sends the page's Origin
    assert websocket_status(own, own) == 403
    assert websocket_status(own, "http://evil.example", query) == 403
    assert websocket_status(own, None, query) == 403
    for path in (
        "/files/../project.toml",
        "/files/%2e%2e/project.toml",
        "/project.toml",
        "/../project.toml",
        "/files/",
    ):
        assert status(f"{own}{path}{query[1:]}") == 404, path
    again = [sys.executable, "-m", "splatgraft", "edit", str(project), "--port", "18081"]
    done = subprocess.run(again, capture_output=True, text=True, timeout=HANG_LIMIT, check=False)
    assert done.returncode == 2
    assert "expected no other run at work here" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert editor.end() == 0


def test_other_machines_need_the_token(project: Path) -> None:
    editor = Editor(project, "--host", "0.0.0.0")
    try:
        address, _, token = editor.url.replace("0.0.0.0", "127.0.0.1").partition("?token=")
        cookie = cookie_name(address.removesuffix("/"))
        assert status(address) == 403
        assert status(address + "?token=guess") == 403
        assert status(f"{address}?token={token}") == 200
        assert status(address, Cookie=f"{cookie}={token}") == 200
        assert status(address, Cookie=f"{cookie}={token}", Origin="http://evil.example") == 403
    finally:
        editor.kill()


def test_public_tunnels_and_read_only_windows_are_blocked() -> None:
    from viser import _messages

    from splatgraft.editor.access.access_control import AccessControl
    from splatgraft.editor.page.server import GuardedServer

    guarded = GuardedServer(AccessControl("secret"), host="127.0.0.1", port=18090)
    try:
        passed: list[object] = []

        async def inner(window: int, message: object) -> None:
            passed.append(message)

        def send(window: int, message: object) -> None:
            coroutine = guarded._forward_allowed(inner, window, message)
            with pytest.raises(StopIteration):
                coroutine.send(None)

        guarded.edit_lock = guarded.edit_lock.with_window(1).with_window(2)
        send(1, _messages.ShareUrlRequest())
        send(2, _messages.GuiFormSubmitMessage("x"))
        assert passed == []
        send(1, _messages.GuiFormSubmitMessage("x"))
        assert len(passed) == 1
    finally:
        guarded.close()


def test_a_second_window_is_read_only_until_it_takes_the_edit_lock(browser: Any, editor: Editor) -> None:
    notice = "This window is read-only"
    first = Window.opened(browser, editor)
    second = Window.opened(browser, editor)
    second.says(notice)
    assert first.page.get_by_text(notice).count() == 0
    second.click("Edit here instead")
    first.says(notice)
    second.page.get_by_text(notice).wait_for(state="detached")
    second.page.close()
    first.page.get_by_text(notice).wait_for(state="detached")
    first.show_phase("Run")
    first.says("not made yet")
