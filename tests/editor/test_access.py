"""Access to the page: requests by Host, Origin and token, and the window that edits."""

import http.client
import subprocess
import sys
from pathlib import Path

import pytest
from editor_pages import TOKEN, Client, served
from starlette.requests import HTTPConnection
from waiting import wait_until
from websockets.exceptions import InvalidStatus

from splatgraft.cli import main
from splatgraft.editor import access
from splatgraft.editor.access import cookie_name
from splatgraft.project.step import locked

HERE = {"Host": "127.0.0.1:8080"}
PAGE = HERE | {"Origin": "http://127.0.0.1:8080", "Upgrade": "websocket"}


def why_refused(token: str, headers: dict[str, str], path: str) -> str | None:
    raw = [(name.lower().encode(), value.encode()) for name, value in headers.items()]
    kind = "websocket" if "Upgrade" in headers else "http"
    query = path.partition("?")[2].encode()
    return access.why_refused(token, HTTPConnection({"type": kind, "headers": raw, "query_string": query}))


def test_the_page_s_own_requests_are_accepted_with_the_token() -> None:
    for headers in (HERE, PAGE, {"Host": "localhost:8080"}, {"Host": "[::1]:8080", "Origin": "http://[::1]:8080"}):
        assert why_refused("secret", headers, "/?token=secret") is None, headers
        # programs of other users of the machine can send the same headers
        assert why_refused("secret", headers, "/"), headers
        assert why_refused("secret", headers, "/?token=guess"), headers


@pytest.mark.parametrize(
    "headers",
    [
        HERE | {"Origin": "http://evil.example"},
        HERE | {"Origin": "null"},
        HERE | {"Origin": "http://127.0.0.1:9999"},
        PAGE | {"Origin": "http://evil.example"},
        HERE | {"Upgrade": "websocket"},
        # DNS rebinding: a foreign name that resolves to this machine
        {"Host": "evil.example:8080"},
        {"Host": "evil.example:8080", "Origin": "http://evil.example:8080"},
        {"Host": "evil.example", "X-Forwarded-Host": "127.0.0.1", "X-Forwarded-For": "127.0.0.1"},
        {"Host": "127.0.0.1:8080, evil.example"},
        {"Host": "127.0.0.1:8080", "Origin": "http://127.0.0.1:8080, http://evil.example"},
        # a repeated header
        HERE | {"host": "evil.example"},
        PAGE | {"origin": "http://evil.example"},
        {},
    ],
)
def test_foreign_requests_are_refused(headers: dict[str, str]) -> None:
    assert why_refused("secret", headers, "/?token=secret")


def test_the_token_is_kept_in_a_cookie_of_the_port() -> None:
    names = [cookie_name(host) for host in ("127.0.0.1:8080", "127.0.0.1:8081", "[::1]:8080", "localhost")]
    assert names == [f"splatgraft_token_{key}" for key in (8080, 8081, 8080, "default")]
    both = "; ".join(f"{name}={token}" for name, token in zip(names[:2], ("first", "second"), strict=True))
    for port, token in ((8080, "first"), (8081, "second")):
        headers = {"Host": f"127.0.0.1:{port}", "Cookie": both}
        assert why_refused(token, headers, "/assets/x.js") is None
        assert why_refused("third", headers, "/")
        assert why_refused(token, headers | {"Origin": "http://evil.example"}, "/")


class Files:
    """A client of the server that gives one file."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def file(self, name: str) -> Path | None:
        path = (self.folder / name).resolve()
        return path if path.name == "a.sog" and path.parent == self.folder.resolve() else None

    def opened(self, window: object) -> None: ...
    def closed(self, window: object) -> None: ...
    def received(self, window: object, message: dict[str, object]) -> None: ...
    def uploaded(self, path: Path, use: str) -> None: ...

    def upload_path(self, name: str) -> Path:
        return self.folder / name


def test_the_server_refuses_what_is_foreign_and_serves_only_shared_files(tmp_path: Path) -> None:
    (tmp_path / "a.sog").write_bytes(b"scene")
    with served() as guarded:
        guarded.attach(Files(tmp_path))

        def answer(path: str, **headers: str) -> http.client.HTTPResponse:
            connection = http.client.HTTPConnection("127.0.0.1", guarded.port, timeout=600)
            connection.request("GET", path, headers=headers)
            found = connection.getresponse()
            found.read()
            connection.close()
            assert found.headers["X-Frame-Options"] == "DENY" or found.status == 403
            return found

        page = answer(f"/?token={TOKEN}")
        assert page.status == 200
        assert page.headers["X-Frame-Options"] == "DENY"
        cookie, _, attributes = (page.headers["Set-Cookie"] or "").partition("; ")
        assert (cookie, attributes) == (
            f"splatgraft_token_{guarded.port}={TOKEN}",
            "HttpOnly; SameSite=Strict; Path=/",
        )
        assert answer("/files/a.sog", Cookie=cookie).status == 200
        assert answer("/").status == 403
        assert answer(f"/?token={TOKEN}", Origin="http://evil.example").status == 403
        assert answer(f"/?token={TOKEN}", Host="evil.example").status == 403
        assert "default-src 'self'" in page.headers["Content-Security-Policy"]
        outside = ("/files/../project.toml", "/files/%2e%2e/project.toml", "/project.toml", "/files/", "/files/b/a.sog")
        for path in (*outside, "/files/%00", f"/files/{'a' * 5000}", f"/{'a' * 5000}", "/%00"):
            assert answer(path, Cookie=cookie).status == 404, path


def test_a_websocket_needs_the_page_s_origin_and_the_token() -> None:
    with served() as server:
        client = Client(server.port)
        client.connect().close()
        for wrong in ({"cookie": ""}, {"cookie": "splatgraft_token_1=secret"}, {"origin": "http://evil.example"}):
            with pytest.raises(InvalidStatus):
                client.connect(**wrong)


def test_what_a_window_sends_before_the_project_is_open_is_kept(tmp_path: Path) -> None:
    got: list[dict[str, object]] = []

    class Editor(Files):
        def received(self, window: object, message: dict[str, object]) -> None:
            got.append(message)

    with served() as server, Client(server.port).connect() as connection:
        connection.send("[1]")
        connection.send('{"t": "size", "w": 640, "h": 480}')
        wait_until(lambda: len(server._windows) == 1, what="the window")
        server.attach(Editor(tmp_path))
        wait_until(lambda: bool(got), what="the message")
        assert got == [{"t": "size", "w": 640, "h": 480}]


def test_the_page_is_served_before_torch_is_loaded() -> None:
    code = "import sys, splatgraft.commands.edit, splatgraft.editor.server; print('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"


def test_a_second_editor_on_a_project_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with locked(tmp_path / "edit"):
        assert main(["edit", str(tmp_path)]) == 2
    assert "expected no other run at work here" in capsys.readouterr().err
