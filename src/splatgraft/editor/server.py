"""The editor's web server: one page, one websocket for each window, files and uploads, all behind access control.

The sizes of messages and uploads and the number of windows are limited. The oldest window edits, all others watch. An
invalid message gives one line on standard error. This module does not load torch.
"""

import asyncio
import contextlib
import itertools
import json
import socket
import sys
import threading
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import uvicorn
from starlette.applications import Starlette
from starlette.requests import HTTPConnection, Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketClose, WebSocketDisconnect

from splatgraft.editor.access import cookie_name, why_refused
from splatgraft.runtime.files import atomic_write

if TYPE_CHECKING:
    from splatgraft.editor.editor import Editor

FILES_PREFIX = "files/"
"""Prefix of the addresses of the project's files, relative to the page."""
_ASSETS = {"": "index.html", "editor.js": "editor.js", "editor.css": "editor.css"}
_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".webp": "image/webp",
    ".gif": "image/gif",
    ".mp4": "video/mp4",
}
_POLICY = "default-src 'self'; img-src 'self' blob: data:; style-src 'self' 'unsafe-inline'; frame-ancestors 'none'"
_HEADERS = {"X-Frame-Options": "DENY", "Referrer-Policy": "no-referrer", "X-Content-Type-Options": "nosniff"}
"""Headers against frames of other sites (clickjacking), and against leaks of the token in the address."""
_MAX_MESSAGE_BYTES = 1 << 16  # a page's largest message is a path or a file's name
_MAX_UPLOAD_BYTES = 1 << 30  # one upload, which is written to disk
_MAX_WINDOWS = 16  # each takes drawing time
_MAX_UPLOADS = 4  # at the same time
_ATTACHED_SECONDS = 0.05  # pause between looks for a client, while the project is loaded
_NOT_OURS = (ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError)
"""Errors that an invalid message can raise."""
_START_SECONDS = 60  # limit against a hang


class Window:
    """One browser window. Only the newest message of each kind waits to be sent."""

    def __init__(self, number: int, loop: asyncio.AbstractEventLoop) -> None:
        """Start without messages."""
        self.number = number
        self._loop, self._wake = loop, asyncio.Event()
        self._waiting: dict[str, str | bytes] = {}
        self._lock = threading.Lock()

    def send(self, kind: str, content: str | bytes) -> None:
        """Send a message from any thread; it replaces a waiting one of that kind."""
        with self._lock:
            self._waiting[kind] = content
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._wake.set)

    async def pump(self, connection: WebSocket) -> None:
        """Send waiting messages until the connection ends."""
        while True:
            await self._wake.wait()
            self._wake.clear()
            with self._lock:
                waiting, self._waiting = self._waiting, {}
            for content in waiting.values():
                if isinstance(content, bytes):
                    await connection.send_bytes(content)
                else:
                    await connection.send_text(content)


class Server:
    """The server, in its own thread."""

    def __init__(self, token: str, *, host: str, port: int) -> None:
        """Start to listen at `port` or the next free one; each request must carry the token."""
        self._token = token
        self._client: Editor | None = None
        self._windows: list[Window] = []
        self._numbers = itertools.count(1)
        self._uploads = asyncio.Semaphore(_MAX_UPLOADS)
        self._lock = threading.Lock()
        listener = _listener(host, port)
        self.port: int = listener.getsockname()[1]
        routes = [
            Route("/upload", self._upload, methods=["POST"]),
            Route(f"/{FILES_PREFIX}{{name:path}}", self._file),
            WebSocketRoute("/socket", self._socket),
            Route("/{name:path}", self._page),
        ]
        app = _guarded(Starlette(routes=routes), token)
        config = uvicorn.Config(
            app, log_config=None, lifespan="off", ws="websockets-sansio", ws_max_size=_MAX_MESSAGE_BYTES,
            ws_per_message_deflate=False, timeout_graceful_shutdown=1, server_header=False, timeout_keep_alive=5,
        )  # fmt: skip
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(
            target=self._server.run, args=([listener],), name="splatgraft server", daemon=True
        )
        self._thread.start()

    def attach(self, client: "Editor") -> None:
        """Send events of windows to a client from now on; what open windows have sent so far has waited for it."""
        with self._lock:
            self._client = client
            for window in self._windows:
                client.opened(window)

    def close(self) -> None:
        """Stop the server."""
        self._server.should_exit = True
        self._thread.join(_START_SECONDS)

    # requests

    async def _page(self, request: Request) -> Response:
        name = _ASSETS.get(request.path_params["name"])
        if name is None:
            return _no_file()
        content = resources.files("splatgraft.editor").joinpath("static", name).read_bytes()
        response = Response(content, media_type=_TYPES[Path(name).suffix])
        cookie = f"{cookie_name(request.headers['Host'])}={self._token}; HttpOnly; SameSite=Strict; Path=/"
        response.headers["Set-Cookie"] = cookie
        response.headers["Cache-Control"] = "no-cache"
        return response

    async def _file(self, request: Request) -> Response:
        """Send a file of the project."""
        try:
            found = None if self._client is None else self._client.file(request.path_params["name"])
            if found is None or not found.is_file():
                return _no_file()
            return FileResponse(found, media_type=_TYPES.get(found.suffix, "application/octet-stream"))
        except (OSError, ValueError):  # a name that no file can have
            return _no_file()

    async def _upload(self, request: Request) -> Response:
        """Store a file from the editing window; it is written to disk part by part."""
        query, client = request.query_params, self._client
        with self._lock:
            is_editing = bool(self._windows) and query.get("window") == str(self._windows[0].number)
        if client is None or not is_editing:
            return _refusal("another window edits", 403)
        if self._uploads.locked():
            return _refusal(f"expected at most {_MAX_UPLOADS} uploads at once, found one more", 429)
        async with self._uploads:
            try:
                path = client.upload_path(query.get("name", ""))
                announced = request.headers.get("Content-Length", "0")
                if not announced.isdecimal() or int(announced) > _MAX_UPLOAD_BYTES:
                    return _too_large()
                size = 0
                with atomic_write(path) as stream:
                    async for part in request.stream():
                        size += len(part)
                        if size > _MAX_UPLOAD_BYTES:
                            return _too_large()
                        await asyncio.to_thread(stream.write, part)
            except (ValueError, OSError) as error:
                return _refusal(" ".join(str(error).split()), 400)
        await asyncio.to_thread(client.uploaded, path, query.get("use", ""))
        return PlainTextResponse(str(path))

    async def _socket(self, connection: WebSocket) -> None:
        """Serve one window until it closes."""
        await connection.accept()
        if len(self._windows) >= _MAX_WINDOWS:
            reason = f"splatgraft: expected at most {_MAX_WINDOWS} windows, found one more; close another"
            await connection.close(1013, reason)
            return
        window = Window(next(self._numbers), asyncio.get_running_loop())
        pump = asyncio.create_task(window.pump(connection))
        try:
            with self._lock:
                self._windows.append(window)
                if self._client is not None:
                    self._client.opened(window)
            while self._client is None:
                await asyncio.sleep(_ATTACHED_SECONDS)
            while True:
                _pass_on(self._client, window, await connection.receive())
        except WebSocketDisconnect:
            pass
        finally:
            pump.cancel()
            with contextlib.suppress(asyncio.CancelledError, Exception):
                await pump
            with self._lock:
                self._windows.remove(window)
                if self._client is not None:
                    self._client.closed(window)


def _pass_on(client: "Editor", window: Window, event: Any) -> None:
    """Pass a window's message on, or report that it is invalid."""
    if event["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(event.get("code", 1000))
    try:
        client.received(window, dict(json.loads(event.get("text") or "", parse_constant=_no_number)))
    except _NOT_OURS as error:
        # without the error's text, which may quote the message
        found = f"one that is not ({type(error).__name__})"
        sys.stderr.write(f"splatgraft: expected a message of the editor's own page, found {found}\n")


def _guarded(app: ASGIApp, token: str) -> ASGIApp:
    """Return an application with access control of its requests, and with headers of its responses."""

    async def serve(scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with_headers(message: Any) -> None:
            if message["type"] == "http.response.start":
                # reports and exported pages hold scripts of their own
                is_file = scope["path"].startswith(f"/{FILES_PREFIX}")
                extra = _HEADERS if is_file else _HEADERS | {"Content-Security-Policy": _POLICY}
                message["headers"] += [(name.encode(), value.encode()) for name, value in extra.items()]
            await send(message)

        served, refused = app, why_refused(token, HTTPConnection(scope))
        if refused is not None:
            is_socket = scope["type"] == "websocket"
            served = WebSocketClose(1008, refused) if is_socket else _refusal(refused, 403)  # a socket gets 403, too
        await served(scope, receive, send_with_headers)

    return serve


def _listener(host: str, port: int) -> socket.socket:
    """Open a socket at the port, or at the next free one."""
    for tried in range(port, port + 100):
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, sys.platform != "win32")
        try:
            listener.bind((host, tried if port else 0))
        except OSError:
            listener.close()
            continue
        listener.listen(64)
        return listener
    raise ValueError(f"port {port}: expected a free one here or among the next 100, found none")


def _no_number(text: str) -> Callable[[], None]:
    raise ValueError(f"expected a finite number, found {text}")


def _too_large() -> Response:
    gib = _MAX_UPLOAD_BYTES >> 30
    return _refusal(f"expected an upload of at most {gib} GiB; write the path of the file instead", 413)


def _refusal(text: str, status: int) -> Response:
    return PlainTextResponse(f"splatgraft: {text}\n", status)


def _no_file() -> Response:
    return _refusal("no such file", 404)
