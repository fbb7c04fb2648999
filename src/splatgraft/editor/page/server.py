"""A viser server that only the editor's own page can reach, with one editing window and limited uploads.

Knows nothing about what the page shows.
"""

import contextlib
import http
import http.client
import io
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import viser
import websockets.asyncio.server
from viser import _messages
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from splatgraft.editor.access.access_control import AccessControl
from splatgraft.editor.access.edit_lock import EditLock

FILES_PREFIX = "/files/"
_LOOKING_ON = (_messages.ViewerCameraMessage, _messages.GetRenderResponseMessage)
_UPLOAD = (_messages.FileTransferStartUpload, _messages.FileTransferPart)
# the request opens a public tunnel to this machine
_NEVER = (_messages.ShareUrlRequest,)
_TYPES = {".html": "text/html; charset=utf-8", ".png": "image/png", ".webp": "image/webp", ".gif": "image/gif"}
_TYPES |= {
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript",
    ".json": "application/json",
    ".jpg": "image/jpeg",
}
_SERVING = threading.Lock()


class GuardedServer:
    """viser behind a gate."""

    def __init__(self, gate: AccessControl, *, host: str, port: int, upload_limit: int) -> None:
        """Start to listen; at once, or at the next free port.

        Raises: OSError where the gate does not hold.
        """
        self.seat = EditLock()
        self.on_seat: Callable[[], None] = lambda: None
        self.on_large_upload: Callable[[str, int], None] = lambda name, size: None
        self.files: Callable[[str], Path | None] = lambda name: None
        self._gate, self._limit = gate, upload_limit
        self._uploads: dict[str, int] = {}
        with _SERVING:
            # viser asks websockets to serve with no regard to who asks; it is asked here with the gate in front
            original = websockets.asyncio.server.serve
            websockets.asyncio.server.serve = partial(self._serve, original)  # pyright: ignore
            try:
                # its banner names an address without the token, on a stream that is for results
                with contextlib.redirect_stdout(io.StringIO()):
                    self.viser = viser.ViserServer(host=host, port=port, verbose=False)
            finally:
                websockets.asyncio.server.serve = original
        inner = self.viser._websock_server
        # pyright would have viser's parameter names
        setattr(inner, "_handle_incoming_message", partial(self._filtered, inner._handle_incoming_message))  # noqa: B010
        inner.on_client_connect(lambda connection: self._seated(self.seat.joined(connection.client_id)))
        inner.on_client_disconnect(lambda connection: self._seated(self.seat.left(connection.client_id)))
        self._check(host)

    @property
    def port(self) -> int:
        """Where it listens."""
        return self.viser.get_port()

    def take_seat(self, window: int) -> None:
        """Let that window edit."""
        self._seated(self.seat.taken(window))

    def close(self) -> None:
        """Stop to listen."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.viser.stop()

    def _seated(self, seat: EditLock) -> None:
        self.seat = seat
        self.on_seat()

    def _serve(self, original: Callable[..., Any], *args: Any, **options: Any) -> Any:
        inner = options["process_request"]
        return original(*args, **options | {"process_request": partial(self._answer, inner)})

    def _answer(self, inner: Callable[..., Response | None], connection: Any, request: Request) -> Response | None:
        answer = self._gate.ask(_plain(request.headers), request.path)
        if not answer.allowed:
            return _response(http.HTTPStatus.FORBIDDEN, f"splatgraft: {answer.reason}\n".encode(), "text/plain")
        path = request.path.partition("?")[0]
        if path.startswith(FILES_PREFIX):
            found = self.files(path.removeprefix(FILES_PREFIX))
            if found is None:
                return _response(http.HTTPStatus.NOT_FOUND, b"splatgraft: no such file\n", "text/plain")
            kind = _TYPES.get(found.suffix, "application/octet-stream")
            return _response(http.HTTPStatus.OK, found.read_bytes(), kind)
        response = inner(connection, request)
        if response is not None and answer.cookie is not None:
            response.headers["Set-Cookie"] = answer.cookie
        if response is not None:
            # no other page may show this one in a frame and lead clicks astray
            response.headers["X-Frame-Options"] = "DENY"
        return response

    async def _filtered(self, inner: Callable[..., Any], window: int, message: Any) -> None:
        """Pass on what may come in: the editing window's messages, the others' cameras, uploads of bearable size."""
        if isinstance(message, _NEVER) or (window != self.seat.holder and not isinstance(message, _LOOKING_ON)):
            return
        if isinstance(message, _UPLOAD) and not self._bearable(message):
            return
        await inner(window, message)

    def _bearable(self, message: Any) -> bool:
        if isinstance(message, _messages.FileTransferStartUpload):
            if message.size_bytes > self._limit:
                self.on_large_upload(message.filename, message.size_bytes)
                return False
            self._uploads[message.transfer_uuid] = message.size_bytes
            return True
        left = self._uploads.get(message.transfer_uuid, 0) - len(message.content)
        self._uploads[message.transfer_uuid] = left
        return left >= 0

    def _check(self, host: str) -> None:
        """Knock with a stranger's Origin: a viser that serves in another way must not go unnoticed."""
        reached = "127.0.0.1" if host in ("0.0.0.0", "") else "::1" if host == "::" else host
        knock = http.client.HTTPConnection(reached, self.port, timeout=10)
        try:
            knock.request("GET", "/", headers={"Origin": "http://stranger.invalid"})
            status = knock.getresponse().status
        finally:
            knock.close()
        if status != http.HTTPStatus.FORBIDDEN:
            self.close()
            raise OSError(f"viser {viser.__version__}: expected it to refuse other sites, found {status}; take 1.1.1")


def _plain(headers: Headers) -> dict[str, str]:
    names = ("Host", "Origin", "Upgrade", "Cookie")
    found = {name: headers.get_all(name) for name in names}
    # a header that comes twice is nobody's honest request: joined, it matches nothing
    return {name: ", ".join(values) for name, values in found.items() if values}


def _response(status: http.HTTPStatus, body: bytes, kind: str) -> Response:
    headers = Headers({"Content-Type": kind, "Content-Length": str(len(body)), "X-Content-Type-Options": "nosniff"})
    return Response(int(status), status.phrase, headers, body)
