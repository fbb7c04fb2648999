"""A viser server with access control, an edit lock, and an upload form that viser's page loads."""

import contextlib
import gzip
import http
import http.client
import io
import secrets
import threading
from collections.abc import Callable
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import viser
import websockets.asyncio.server
from viser import _messages
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from splatgraft.editor.access.access_control import AccessControl, allowed_query, plain_headers
from splatgraft.editor.access.edit_lock import EditLock
from splatgraft.editor.uploads.upload_receiver import UPLOAD_PATH, UploadReceiver

FILES_PREFIX = "files/"
"""Of the addresses of files, below the page's own address, which a reverse proxy may put under a path."""
_CAMERA_MESSAGES = (_messages.ViewerCameraMessage, _messages.GetRenderResponseMessage)
_BLOCKED_MESSAGES = (
    # this message asks viser for a public tunnel to this machine
    _messages.ShareUrlRequest,
    # viser would collect uploads in memory; the page has a form of its own for them
    _messages.FileTransferStartUpload,
    _messages.FileTransferPart,
)
_FORM_SCRIPT = "upload_form.js"
_SCRIPT_TAG = f'<script src="{_FORM_SCRIPT}" defer></script>'.encode()
_TYPES = {".html": "text/html; charset=utf-8", ".png": "image/png", ".webp": "image/webp", ".gif": "image/gif"}
_TYPES |= {
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript",
    ".json": "application/json",
    ".jpg": "image/jpeg",
    ".mp4": "video/mp4",
}
_PATCH_LOCK = threading.Lock()
_PROBE_SECONDS = 300
"""Limit of the request to the own server at the start: against a hang, not for a busy machine."""


class GuardedServer:
    """A viser server with access control in front."""

    def __init__(self, access: AccessControl, *, host: str, port: int) -> None:
        """Start to listen at `port` or the next free one.

        Raises:
            OSError: If the running viser does not apply the access control.
        """
        self.edit_lock = EditLock()
        self.on_edit_lock_changed: Callable[[], None] = lambda: None
        self.files: Callable[[str], Path | None] = lambda name: None
        self._access = access
        self._window_keys: dict[str, int] = {}
        self._last_key: str | None = None
        self._pages: dict[bool, Response] = {}
        self.uploads = UploadReceiver(self._may_edit)
        with _PATCH_LOCK:
            # viser has no hook for requests: websockets.serve is replaced while viser starts
            original = websockets.asyncio.server.serve
            websockets.asyncio.server.serve = partial(self._serve, original)  # pyright: ignore
            try:
                # viser prints an address without the token to stdout, which is for results
                with contextlib.redirect_stdout(io.StringIO()):
                    self.viser = viser.ViserServer(host=host, port=port, verbose=False)
            finally:
                websockets.asyncio.server.serve = original
        inner = self.viser._websock_server
        # setattr, because pyright compares parameter names with viser's
        setattr(inner, "_handle_incoming_message", partial(self._forward_allowed, inner._handle_incoming_message))  # noqa: B010
        inner.on_client_connect(
            lambda connection: self._set_edit_lock(self.edit_lock.with_window(connection.client_id))
        )
        inner.on_client_disconnect(
            lambda connection: self._set_edit_lock(self.edit_lock.without_window(connection.client_id))
        )
        inner.on_client_disconnect(lambda connection: self._forget_window_key(connection.client_id))
        self.viser.on_client_connect(self._send_window_key)
        self._check(host)

    @property
    def port(self) -> int:
        """The port."""
        return self.viser.get_port()

    def take_edit_lock(self, window: int) -> None:
        """Give the edit lock to a window."""
        self._set_edit_lock(self.edit_lock.held_by(window))

    def close(self) -> None:
        """Stop the server."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.viser.stop()

    def _set_edit_lock(self, edit_lock: EditLock) -> None:
        self.edit_lock = edit_lock
        self.on_edit_lock_changed()

    def _send_window_key(self, window: viser.ClientHandle) -> None:
        """Tell a window the key by which its uploads are known to be its own; the cookie belongs to all windows."""
        key = secrets.token_urlsafe(16)
        self._window_keys[key] = window.client_id
        window.gui.add_html(f'<splatgraft-window key="{key}"></splatgraft-window>')

    def _forget_window_key(self, window: int) -> None:
        for key in [key for key, number in tuple(self._window_keys.items()) if number == window]:
            del self._window_keys[key]
            if self.edit_lock.holder is None:
                self._last_key = key

    def _may_edit(self, key: str) -> bool | None:
        """Whether a window edits; None where its connection is lost, and another window is open or edited since."""
        window = self._window_keys.get(key)
        if window is None and self.edit_lock.holder is None and key == self._last_key:
            # viser's page connects again only while it has the focus; the upload of the last window goes on meanwhile
            return True
        return None if window not in self.edit_lock.windows else window == self.edit_lock.holder

    def _serve(self, original: Callable[..., Any], handler: Callable[..., Any], *args: Any, **options: Any) -> Any:
        inner = options["process_request"]
        routed = partial(self._handle_websocket, handler)
        return original(routed, *args, **options | {"process_request": partial(self._answer, inner)})

    async def _handle_websocket(self, inner: Callable[..., Any], connection: Any) -> None:
        """Pass an upload's websocket to its receiver, all others to viser."""
        if connection.request.path.partition("?")[0] == f"/{UPLOAD_PATH}":
            await self.uploads.serve(connection)
        else:
            await inner(connection)

    def _answer(self, inner: Callable[..., Response | None], connection: Any, request: Request) -> Response | None:
        decision = self._access.check(plain_headers(request.headers), request.path)
        if not decision.allowed:
            return _response(http.HTTPStatus.FORBIDDEN, f"splatgraft: {decision.reason}\n".encode(), "text/plain")
        path, query = request.path.partition("?")[0].removeprefix("/"), allowed_query(request.path)
        if query is not None and "Upgrade" not in request.headers:
            moved = _response(http.HTTPStatus.FOUND, b"", "text/plain")
            moved.headers["Location"] = query
            return moved
        if path.startswith(FILES_PREFIX):
            found = self.files(unquote(path.removeprefix(FILES_PREFIX)))
            if found is None:
                return _response(http.HTTPStatus.NOT_FOUND, b"splatgraft: no such file\n", "text/plain")
            kind = _TYPES.get(found.suffix, "application/octet-stream")
            return _response(http.HTTPStatus.OK, found.read_bytes(), kind)
        if path == _FORM_SCRIPT:
            return _response(http.HTTPStatus.OK, _form_script(), _TYPES[".js"])
        is_page = path in ("", "index.html") and "Upgrade" not in request.headers
        response = self._page(inner, connection, request) if is_page else inner(connection, request)
        if response is not None and decision.cookie is not None:
            response.headers["Set-Cookie"] = decision.cookie
        if response is not None:
            # no other site may embed this page in a frame (clickjacking)
            response.headers["X-Frame-Options"] = "DENY"
            # the address holds the token
            response.headers["Referrer-Policy"] = "no-referrer"
        return response

    def _page(self, inner: Callable[..., Response | None], connection: Any, request: Request) -> Response:
        """viser's page, with the script of the upload form."""
        is_packed = "gzip" in request.headers.get("Accept-Encoding", "")
        if is_packed not in self._pages:
            answer = inner(connection, Request(request.path, Headers()))
            assert answer is not None
            body = bytes(answer.body).replace(b"<head>", b"<head>" + _SCRIPT_TAG, 1)
            made = _response(http.HTTPStatus.OK, gzip.compress(body) if is_packed else body, _TYPES[".html"])
            if is_packed:
                made.headers["Content-Encoding"] = "gzip"
            self._pages[is_packed] = made
        found = self._pages[is_packed]
        return Response(found.status_code, found.reason_phrase, found.headers.copy(), found.body)

    async def _forward_allowed(self, inner: Callable[..., Any], window: int, message: Any) -> None:
        """Forward messages of the editing window, camera messages of all windows."""
        if isinstance(message, _BLOCKED_MESSAGES) or (
            window != self.edit_lock.holder and not isinstance(message, _CAMERA_MESSAGES)
        ):
            return
        await inner(window, message)

    def _check(self, host: str) -> None:
        """Ask the own server for its page: a viser version that bypasses what stands before it must be detected."""
        # as a page of another site would
        status, _ = self._own_answer(host, {"Origin": "http://foreign.invalid"})
        if status != http.HTTPStatus.FORBIDDEN:
            self.close()
            raise OSError(
                f"viser {viser.__version__}: expected it to refuse other sites, found status {status}; install 1.1.1"
            )
        status, body = self._own_answer(host, {})
        if _SCRIPT_TAG not in body:
            self.close()
            raise OSError(
                f"viser {viser.__version__}: expected a page with a head, found status {status}; install 1.1.1"
            )

    def _own_answer(self, host: str, headers: dict[str, str]) -> tuple[int, bytes]:
        reached = "127.0.0.1" if host in ("0.0.0.0", "") else "::1" if host == "::" else host
        probe = http.client.HTTPConnection(reached, self.port, timeout=_PROBE_SECONDS)
        try:
            probe.request("GET", f"/?token={self._access.token}", headers=headers)
            answer = probe.getresponse()
            return answer.status, answer.read()
        finally:
            probe.close()


def _form_script() -> bytes:
    return (files("splatgraft.editor.uploads") / _FORM_SCRIPT).read_bytes()


def _response(status: http.HTTPStatus, body: bytes, kind: str) -> Response:
    headers = Headers({"Content-Type": kind, "Content-Length": str(len(body)), "X-Content-Type-Options": "nosniff"})
    return Response(int(status), status.phrase, headers, body)
