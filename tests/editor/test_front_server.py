"""Several projects behind one port: access, hostile requests, and the end of processes."""

import contextlib
import json
import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from editor_driver import Editor
from front_requests import (
    PROJECT,
    all_child_pids,
    answer,
    child_pids,
    cookie_of,
    is_alive,
    kill,
    opened,
    websocket,
)
from tiny_project import ball, plane
from waiting import HANG_LIMIT, wait_until

from splatgraft.cli import main
from splatgraft.formats import write_gaussians

NAMES = ("one", "Küche & Flur #1", "broken")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("served") / "work"
    for name in NAMES:
        (root / name).mkdir(parents=True)
        (root / name / "project.toml").write_text(PROJECT if name != "broken" else "[source\n")
    write_gaussians(root / "source.ply", ball())
    write_gaussians(root / "target.ply", plane((0.5, 0.5, 0.5)))
    (root / "secret.txt").write_text("secret")
    return root


@pytest.fixture(scope="module")
def editor(folder: Path) -> Iterator[Editor]:
    made = Editor(folder)
    yield made
    if made.process.poll() is None:
        made.kill()


@pytest.fixture(scope="module")
def cookie(editor: Editor) -> str:
    return cookie_of(editor)


def keys(editor: Editor, cookie: str) -> dict[str, str]:
    """The addresses of the projects by name."""
    page = answer(f"{editor.base}/list", Cookie=cookie)[2].decode()
    found = re.findall(r'href="p/([^"/]+)/".*?class="name">([^<]+)<', page)
    return {name.replace("&amp;", "&"): key for key, name in found}


def test_the_start_page_lists_all_projects_and_names_what_is_wrong(editor: Editor, cookie: str) -> None:
    status, headers, page = answer(editor.url)
    assert status == 200
    assert headers["X-Frame-Options"] == "DENY"
    assert headers["Content-Security-Policy"].startswith("default-src 'none'")
    assert "HttpOnly; SameSite=Strict; Path=/" in headers["Set-Cookie"]
    assert set(keys(editor, cookie)) == set(NAMES)
    assert b"<h1>work</h1>" in page

    def is_looked_at() -> bool:
        found = answer(f"{editor.base}/list", Cookie=cookie)[2].decode()
        return found.count("nothing was run yet") == 2 and "project.toml: expected TOML, found" in found

    wait_until(is_looked_at, what="the states of all projects")


def test_nothing_is_answered_without_the_token(editor: Editor, cookie: str) -> None:
    name = cookie.partition("=")[0]
    paths = ["/", "/list", "/start_page.js", "/p/one", "/p/one/", "/p/one/files/index.html", "/thumbnails/one/1", "/x"]
    for path in paths:
        for refused in ({}, {"Cookie": f"{name}=guess"}, {"Cookie": cookie, "Origin": "https://evil.example"}):
            status, headers, body = answer(editor.base + path, follow=False, **refused)
            assert status == 403, (path, refused)
            assert body.startswith(b"splatgraft: expected")
            assert "Set-Cookie" not in headers
        assert answer(f"{editor.base}{path}?token=guess", follow=False)[0] == 403
        assert answer(editor.base + path, follow=False, Cookie=cookie, Host="evil.example")[0] == 403
    for project in ("/p/one", "/p/broken", "/"):
        url = editor.base + project
        assert websocket(url, editor.base)[0] == 403
        assert websocket(url, editor.base, f"{name}=guess")[0] == 403
        assert websocket(url, "https://evil.example", cookie)[0] == 403
        assert websocket(url, None, cookie)[0] == 403
    assert child_pids(editor) == []


def test_other_paths_lead_nowhere(editor: Editor, cookie: str, folder: Path) -> None:
    inner = keys(editor, cookie)["Küche & Flur #1"]
    for path in (
        *("/p/", "/p/nowhere/", "/p/../secret.txt", "/p/%2e%2e/", "/p/..%2f..%2fsecret.txt/", "/p/%00/", "/secret.txt"),
        *(
            "/thumbnails/nowhere/1",
            "/thumbnails/../secret.txt",
            "/start_page.py",
            "/../start_page.css",
            "/p/K%C3%BCche/",
        ),
        *("//evil.example/", "/p//", "/list/x", "/thumbnails/one/1", f"/P/{inner}/"),
    ):
        status, headers, body = answer(editor.base + path, follow=False, Cookie=cookie)
        assert status == 404, path
        assert b"secret" not in body
        assert "Location" not in headers
    # the server sends nobody elsewhere
    assert answer(f"{editor.base}/p/{inner}?token=x", follow=False, Cookie=cookie)[1]["Location"] == f"{inner}/?token=x"
    found = answer(f"{editor.base}/p/{inner}/?websocket=ws://evil.example", follow=False, Cookie=cookie)
    assert (found[0], found[1]["Location"]) == (302, "?")
    assert answer(f"{editor.base}/p/{inner}/files/x", Cookie=cookie)[0] == 503


@pytest.mark.parametrize(
    "request_",
    [
        b"POST /list HTTP/1.1\r\nHost: {host}\r\nCookie: {cookie}\r\nContent-Length: 3\r\n\r\nabc",
        b"GET /list HTTP/1.1\r\nHost: {host}\r\nCookie: {cookie}\r\nContent-Length: 9\r\n\r\nGET /p/on",
        b"GET /list HTTP/1.1\r\nHost: {host}\r\nCookie: {cookie}\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
        b"GET /list HTTP/1.0\r\nHost: {host}\r\nCookie: {cookie}\r\n\r\n",
        b"GET /list\r\n\r\n",
        b"GET /p/one?token=\xff HTTP/1.1\r\nHost: {host}\r\nCookie: {cookie}\r\n\r\n",
        b"GET /p/one?token=\x0b HTTP/1.1\r\nHost: {host}\r\nCookie: {cookie}\r\n\r\n",
        b"GET http://{host}/list HTTP/1.1\r\nHost: {host}\r\nCookie: {cookie}\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n",
        b"GET /list HTTP/1.1\r\nHost: {host}\r\nCookie : {cookie}\r\n\r\n",
        b"GET /" + b"a" * 9000 + b" HTTP/1.1\r\nHost: {host}\r\n\r\n",
        b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * 300 + b"\r\n",
    ],
)
def test_malformed_requests_are_refused(editor: Editor, cookie: str, request_: bytes) -> None:
    assert exchange(editor, cookie, request_).startswith(b"HTTP/1.1 400 ")


def test_a_connection_carries_one_request_and_endless_heads_end_it(editor: Editor, cookie: str) -> None:
    one = b"GET /list HTTP/1.1\r\nHost: {host}\r\nCookie: {cookie}\r\n\r\n"
    assert exchange(editor, cookie, one + one).count(b"HTTP/1.1 ") == 1
    with contextlib.suppress(ConnectionError):
        assert exchange(editor, cookie, b"GET / HTTP/1.1\r\na: " + b"b" * 100_000) == b""
    assert answer(f"{editor.base}/list", Cookie=cookie)[0] == 200


def exchange(editor: Editor, cookie: str, request: bytes) -> bytes:
    host = editor.base.removeprefix("http://")
    name, _, port = host.partition(":")
    with socket.create_connection((name, int(port)), timeout=HANG_LIMIT) as connection:
        connection.sendall(request.replace(b"{host}", host.encode()).replace(b"{cookie}", cookie.encode()))
        found = b""
        while piece := connection.recv(1 << 16):
            found += piece
        return found


def wait_for_file(url: str, cookie: str) -> None:
    """A project's files are served once it is loaded."""
    wait_until(lambda: answer(url, Cookie=cookie)[0] == 200, what=f"the file {url}")


def test_projects_are_served_and_one_s_end_leaves_the_others(editor: Editor, cookie: str, folder: Path) -> None:
    by_name = keys(editor, cookie)
    one, other = (f"{editor.base}/p/{by_name[name]}" for name in ("one", "Küche & Flur #1"))
    assert "<title>Viser</title>" in opened(f"{one}/", cookie)
    (first,) = child_pids(editor)
    # by a window alone, as after a restart of the server
    status, message = websocket(other, editor.base, cookie)
    assert (status, len(message) > 100) == (101, True)
    (second,) = set(child_pids(editor)) - {first}
    # the project's own server has another token, which no list of processes shows
    words = Path(f"/proc/{first}/cmdline").read_bytes()
    assert editor.token.encode() not in words
    (folder / "one" / "report").mkdir(exist_ok=True)
    (folder / "one" / "report" / "index.html").write_text("a report")
    wait_for_file(f"{one}/files/index.html", cookie)
    assert answer(f"{one}/files/index.html", Cookie=cookie)[2] == b"a report"
    for path in ("files/../project.toml", "files/%2e%2e/project.toml", "../../secret.txt", "files/"):
        assert answer(f"{one}/{path}", Cookie=cookie)[0] == 404, path
    kill(first)
    wait_until(lambda: not is_alive(first), what="the end of a project's process")
    wait_until(lambda: websocket(one, editor.base, cookie)[0] == 503, what="a refused window of the ended process")
    assert is_alive(second)
    assert websocket(other, editor.base, cookie)[0] == 101
    page = opened(f"{one}/", cookie)
    assert "expected its editor to go on, found that it ended (-9)" in page
    assert "<title>Viser</title>" in opened(f"{one}/", cookie)
    assert websocket(one, editor.base, cookie)[0] == 101


def test_a_broken_project_can_be_opened_to_mend_it(editor: Editor, cookie: str) -> None:
    assert "<title>Viser</title>" in opened(f"{editor.base}/p/broken/", cookie)
    assert websocket(f"{editor.base}/p/broken", editor.base, cookie)[0] == 101


def test_a_project_that_another_editor_has_open_says_so(editor: Editor, cookie: str, folder: Path) -> None:
    (folder / "taken").mkdir()
    (folder / "taken" / "project.toml").write_text(PROJECT)
    taker = Editor(folder / "taken")
    try:
        assert answer(f"{editor.base}/list", Cookie=cookie)[2].count(b"<li ") == 4
        page = opened(f"{editor.base}/p/taken/", cookie)
        assert "expected no other run at work here, found one" in page
        assert "All projects" in page
    finally:
        taker.kill()
    assert "<title>Viser</title>" in opened(f"{editor.base}/p/taken/", cookie)


def test_a_slow_client_gets_the_whole_file(editor: Editor, cookie: str, folder: Path) -> None:
    content = bytes(range(256)) * 100_000
    (folder / "one" / "export").mkdir()
    (folder / "one" / "export" / "a.ply").write_bytes(content)
    opened(f"{editor.base}/p/one/", cookie)
    wait_for_file(f"{editor.base}/p/one/files/export/a.ply", cookie)
    host = editor.base.removeprefix("http://")
    name, _, port = host.partition(":")
    with socket.create_connection((name, int(port)), timeout=HANG_LIMIT) as connection:
        head = f"GET /p/one/files/export/a.ply HTTP/1.1\r\nHost: {host}\r\nCookie: {cookie}\r\n\r\n"
        connection.sendall(head.encode())
        # viser's server gives a client ten seconds to take an answer
        time.sleep(12)
        found = b""
        while piece := connection.recv(1 << 20):
            found += piece
    assert found.partition(b"\r\n\r\n")[2] == content


def test_an_upload_is_not_counted_as_a_window(editor: Editor, cookie: str) -> None:
    from websockets.sync.client import connect

    opened(f"{editor.base}/p/one/", cookie)
    address = f"{editor.base.replace('http', 'ws', 1)}/p/one"
    options = {"additional_headers": {"Cookie": cookie}, "origin": editor.base, "proxy": None}
    with connect(f"{address}/upload", **options):  # pyright: ignore
        assert b"open in" not in answer(f"{editor.base}/list", Cookie=cookie)[2]
        with connect(address, subprotocols=["viser-v1.1.1"], **options):  # pyright: ignore
            assert b"open in 1 window" in answer(f"{editor.base}/list", Cookie=cookie)[2]


def test_the_server_s_end_is_that_of_its_processes(editor: Editor, cookie: str) -> None:
    opened(f"{editor.base}/p/one/", cookie)
    pids = all_child_pids(editor)
    assert len(pids) >= 3
    assert editor.end() == 0
    assert not any(is_alive(pid) for pid in pids)


def test_a_killed_server_leaves_no_processes(folder: Path) -> None:
    made = Editor(folder)
    cookie = cookie_of(made)
    opened(f"{made.base}/p/one/", cookie)
    pids = all_child_pids(made)
    assert pids
    made.kill()
    wait_until(lambda: not any(is_alive(pid) for pid in pids), what="the end of the server's processes")


def test_one_project_beyond_loopback_is_opened_without_a_list(folder: Path) -> None:
    made = Editor(folder / "one", "--host", "0.0.0.0")
    try:
        base = made.base.replace("0.0.0.0", "127.0.0.1")
        status, headers, _ = answer(f"{base}/?token={made.token}", follow=False)
        # the token stays in the address: a cookie does not come along where another site's link was followed
        assert (status, headers["Location"]) == (302, f"./p/one/?token={made.token}")
        assert "<title>Viser</title>" in opened(f"{base}/p/one/", headers["Set-Cookie"].partition(";")[0])
        # windows of other machines may not name paths outside of the project
        (words,) = [Path(f"/proc/{pid}/cmdline").read_bytes() for pid in child_pids(made)]
        options = json.loads(words.split(b"\0")[3])
        assert options["is_remote"] is True
        assert options["start_page"] is None
    finally:
        made.kill()


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["{tmp}/a", "{tmp}/nowhere"], "{tmp}/a: expected a project or a folder that holds projects, found nothing"),
        (["{tmp}", "--out", "{tmp}/out"], "--out: expected one project, found several"),
        (["{tmp}", "--public-url", "studio"], "--public-url: expected an address such as"),
        (["{tmp}", "--tls-key", "{tmp}/key"], "--tls-key: expected also --tls-certificate, found none"),
    ],
)
def test_bad_options_are_one_line(
    words: list[str], line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner" / "project.toml").write_text(PROJECT)
    assert main(["edit", *(word.replace("{tmp}", str(tmp_path)) for word in words)]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert len(printed.err.splitlines()) == 1
    assert line.replace("{tmp}", str(tmp_path)) in printed.err
    assert "(see docs/troubleshooting.md#editor)" in printed.err


def test_the_front_server_needs_neither_torch_nor_viser() -> None:
    source = "import sys, splatgraft.commands.edit; print([m for m in ('torch', 'viser', 'numba') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
