"""A viser server with access control, an edit lock and uploads that go to the disk."""

import contextlib
import http
import http.client
import io
import threading
from collections.abc import Callable
from functools import partial
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
from splatgraft.editor.page.upload_receiver import UPLOAD_MESSAGES, UploadReceiver

FILES_PREFIX = "files/"
"""Of the addresses of files, below the page's own address, which a reverse proxy may put under a path."""
_CAMERA_MESSAGES = (_messages.ViewerCameraMessage, _messages.GetRenderResponseMessage)
# this message asks viser for a public tunnel to this machine
_BLOCKED_MESSAGES = (_messages.ShareUrlRequest,)
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
        self.uploads = UploadReceiver(self._send)
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
        inner.on_client_disconnect(lambda connection: self.uploads.window_closed(connection.client_id))
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

    def _serve(self, original: Callable[..., Any], *args: Any, **options: Any) -> Any:
        inner = options["process_request"]
        return original(*args, **options | {"process_request": partial(self._answer, inner)})

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
        response = inner(connection, request)
        if response is not None and decision.cookie is not None:
            response.headers["Set-Cookie"] = decision.cookie
        if response is not None:
            # no other site may embed this page in a frame (clickjacking)
            response.headers["X-Frame-Options"] = "DENY"
            # the address holds the token
            response.headers["Referrer-Policy"] = "no-referrer"
        return response

    async def _forward_allowed(self, inner: Callable[..., Any], window: int, message: Any) -> None:
        """Forward messages of the editing window, camera messages of all windows; receive its uploads."""
        if isinstance(message, _BLOCKED_MESSAGES) or (
            window != self.edit_lock.holder and not isinstance(message, _CAMERA_MESSAGES)
        ):
            return
        if isinstance(message, UPLOAD_MESSAGES):
            self.uploads.receive(window, message)
            return
        await inner(window, message)

    def _send(self, window: int, message: Any) -> None:
        client = self.viser.get_clients().get(window)
        if client is not None:
            client._websock_connection.queue_message(message)

    def _check(self, host: str) -> None:
        """Send a request with a foreign Origin: a viser version that bypasses the access control must be detected."""
        reached = "127.0.0.1" if host in ("0.0.0.0", "") else "::1" if host == "::" else host
        probe = http.client.HTTPConnection(reached, self.port, timeout=_PROBE_SECONDS)
        try:
            probe.request("GET", f"/?token={self._access.token}", headers={"Origin": "http://foreign.invalid"})
            status = probe.getresponse().status
        finally:
            probe.close()
        if status != http.HTTPStatus.FORBIDDEN:
            self.close()
            raise OSError(
                f"viser {viser.__version__}: expected it to refuse other sites, found status {status}; install 1.1.1"
            )


def _response(status: http.HTTPStatus, body: bytes, kind: str) -> Response:
    headers = Headers({"Content-Type": kind, "Content-Length": str(len(body)), "X-Content-Type-Options": "nosniff"})
    return Response(int(status), status.phrase, headers, body)
