"""Requests to the front server as programs make them, and small projects behind it."""

import os
import signal
import ssl
import urllib.error
import urllib.request
from pathlib import Path

from editor_driver import Editor
from waiting import HANG_LIMIT, wait_until

PROJECT = '[source]\nscene = "../source.ply"\n[target]\nscene = "../target.ply"\n'


class NoRedirection(urllib.request.HTTPRedirectHandler):
    """Shows redirections instead of following them."""

    def redirect_request(self, *args: object, **options: object) -> None:
        return None


def answer(
    url: str, context: ssl.SSLContext | None = None, *, follow: bool = True, **headers: str
) -> tuple[int, dict[str, str], bytes]:
    """Status, headers and content of an answer; underscores in names of headers stand for dashes."""
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    handlers: list[urllib.request.BaseHandler] = [] if follow else [NoRedirection()]
    if context is not None:
        handlers.append(urllib.request.HTTPSHandler(context=context))
    opener = urllib.request.build_opener(*handlers)
    try:
        with opener.open(urllib.request.Request(url, headers=named), timeout=HANG_LIMIT) as found:
            return found.status, dict(found.headers), found.read()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, dict(error.headers), error.read()


def cookie_of(editor: Editor, **options: ssl.SSLContext) -> str:
    """The cookie that the complete address sets."""
    headers = answer(editor.url, options.get("context"), follow=False)[1]
    return headers["Set-Cookie"].partition(";")[0]


def websocket(
    url: str, origin: str | None, cookie: str = "", context: ssl.SSLContext | None = None
) -> tuple[int, bytes]:
    """Status of the answer to a websocket request, and the first message."""
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    try:
        with connect(
            url.replace("http", "ws", 1),
            origin=origin,  # pyright: ignore
            subprotocols=["viser-v1.1.1"],  # pyright: ignore
            additional_headers={"Cookie": cookie} if cookie else {},
            open_timeout=HANG_LIMIT,
            ssl=context,
            max_size=None,
            proxy=None,
        ) as connection:
            first = connection.recv(HANG_LIMIT)
            assert isinstance(first, bytes)
            return 101, first
    except InvalidStatus as refused:
        return refused.response.status_code, b""


def opened(url: str, cookie: str, context: ssl.SSLContext | None = None) -> str:
    """The project's page once its process serves it, or the page that says why it does not."""
    pages: list[str] = []

    def is_served() -> bool:
        pages.append(answer(url, context, Cookie=cookie)[2].decode(errors="replace"))
        return "The editor starts" not in pages[-1]

    wait_until(is_served, what=f"the page {url}")
    return pages[-1]


def child_pids(editor: Editor) -> list[int]:
    """Processes of projects that the server has started."""
    return [pid for pid, words in _processes_of(editor) if "splatgraft.commands.edit_process" in words]


def all_child_pids(editor: Editor) -> list[int]:
    """All processes that the server has started."""
    return [pid for pid, _ in _processes_of(editor)]


def kill(pid: int) -> None:
    """End a process, as a crash would."""
    os.kill(pid, signal.SIGKILL)


def is_alive(pid: int) -> bool:
    """Whether a process runs."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def _processes_of(editor: Editor) -> list[tuple[int, str]]:
    found = []
    for folder in Path("/proc").iterdir():
        if not folder.name.isdigit():
            continue
        try:
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            words = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:
            continue
        if parent == editor.process.pid:
            found.append((int(folder.name), words))
    return found
