"""A viser server behind access control, of whose windows the oldest edits and all others only watch.

What a client sends is bounded: the size of a message and of an upload, and the number of windows. A message that does
not fit the page is one line on standard error, where viser prints a traceback.
"""

import asyncio
import contextlib
import gzip
import http
import http.client
import io
import sys
import traceback
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, unquote

import viser
import websockets.asyncio.server
from viser import _messages
from websockets.datastructures import Headers
from websockets.frames import CloseCode
from websockets.http11 import Request, Response

from splatgraft.editor.access import allowed_query, cookie_name, why_refused

FILES_PREFIX = "files/"
"""First part of the addresses of files, below the page's own address."""
HAND_PREFIX, _ALIVE = "hand/", "alive"
"""First part of the addresses that the page's script asks, and the address at which it asks whether the server runs."""
_ASSETS = ("page.js", "page.css")
"""Files beside this one that viser's page is given."""
_HEAD = b'<link rel="stylesheet" href="page.css"><script src="page.js" defer></script></head>'
Answer = Callable[[Mapping[str, str]], bytes | None]
"""Takes the query of a request of the page's script, and gives a JPEG picture or nothing."""
_CAMERA_MESSAGES = (_messages.ViewerCameraMessage, _messages.GetRenderResponseMessage)
_PROTOCOL = f"viser-v{viser.__version__}"
"""What viser's page names in its handshake."""
_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript",
    ".json": "application/json",
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".webp": "image/webp",
    ".gif": "image/gif",
    ".mp4": "video/mp4",
}
_MAX_MESSAGE_BYTES = 1 << 20
"""Largest message of a client; viser's page sends a file in parts of 512 KiB."""
_MAX_UPLOAD_BYTES = 1 << 30
"""Of all uploads under way together: viser keeps them in memory, twice while it joins the parts."""
_MAX_UPLOADS = 8
"""Most uploads under way."""
_MAX_WINDOWS = 16
"""Most windows at once: each gets a copy of the scene of its own."""
_ANSWER_SECONDS = 60
"""Limit of an answer to the page's script, which may wait for a picture: to websockets it is part of a handshake."""
_PROBE_SECONDS = 300
"""Limit of the request to the own server at the start: against a hang, not for a busy machine."""


class GuardedServer:
    """A viser server with access control in front."""

    def __init__(self, token: str, *, host: str, port: int) -> None:
        """Start to listen at `port` or the next free one; each request must carry the token."""
        self.on_windows_changed: Callable[[], None] = lambda: None
        self.files: Callable[[str], Path | None] = lambda name: None
        """Gives the file that is served below FILES_PREFIX."""
        self.hands: dict[str, Answer] = {}
        """What answers the page's script below HAND_PREFIX, by name; each runs in a thread."""
        self._token = token
        self._windows: list[int] = []
        self._connections = 0
        # of what a client sends, which it quotes
        warnings.filterwarnings("ignore", r"\[viser\]")
        # a window may close while something is on its way to it
        warnings.filterwarnings("ignore", r"Queued a \w+ on a closed connection")
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
        inner.on_client_connect(self._connected)
        inner.on_client_disconnect(lambda connection: self._closed(connection.client_id))
        self._check(host)

    @property
    def port(self) -> int:
        """The port."""
        return self.viser.get_port()

    def editing(self) -> viser.ClientHandle | None:
        """The window that edits; None where none is open."""
        return self.viser.get_clients().get(self._windows[0]) if self._windows else None

    def watching(self) -> tuple[viser.ClientHandle, ...]:
        """The windows that only watch."""
        clients = self.viser.get_clients()
        return tuple(clients[number] for number in self._windows[1:] if number in clients)

    def close(self) -> None:
        """Stop the server."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.viser.stop()

    def _connected(self, connection: Any) -> None:
        # the messages of one window go to handlers of its own, too, such as that of its camera
        setattr(connection, "_handle_incoming_message", partial(self._handle, connection._handle_incoming_message))  # noqa: B010
        self._opened(connection.client_id)

    def _opened(self, window: int) -> None:
        self._windows.append(window)
        self.on_windows_changed()

    def _closed(self, window: int) -> None:
        self._windows.remove(window)
        self.on_windows_changed()

    def _serve(self, original: Callable[..., Any], handler: Callable[..., Any], *args: Any, **options: Any) -> Any:
        answer = partial(self._answer, options["process_request"])
        options |= {"process_request": answer, "max_size": _MAX_MESSAGE_BYTES, "open_timeout": _ANSWER_SECONDS}
        return original(partial(self._attend, handler), *args, **options)

    async def _attend(self, handler: Callable[..., Any], connection: Any) -> None:
        """Serve one window until it closes, or sends what cannot be decoded."""
        if self._connections >= _MAX_WINDOWS:
            reason = f"splatgraft: expected at most {_MAX_WINDOWS} windows, found one more; close another"
            await connection.close(CloseCode.TRY_AGAIN_LATER, reason)
            return
        self._connections += 1
        try:
            await handler(connection)
        except Exception as error:  # viser's decoder raises what it meets
            _say_malformed(error)
            await connection.close(CloseCode.INVALID_DATA)
        finally:
            self._connections -= 1

    async def _answer(
        self, inner: Callable[..., Response | None], connection: Any, request: Request
    ) -> Response | None:
        response = await self._checked(inner, connection, request)
        if response is not None:
            # websockets closes it behind each answer; a client that is not told sends its next request into it
            response.headers["Connection"] = "close"
        return response

    async def _checked(
        self, inner: Callable[..., Response | None], connection: Any, request: Request
    ) -> Response | None:
        # a repeated header is joined, so that it matches no accepted value
        found = {name: request.headers.get_all(name) for name in ("Host", "Origin", "Upgrade", "Cookie")}
        headers = {name: ("; " if name == "Cookie" else ", ").join(values) for name, values in found.items() if values}
        refused = why_refused(self._token, headers, request.path)
        if refused is not None:
            return _response(http.HTTPStatus.FORBIDDEN, f"splatgraft: {refused}\n".encode(), "text/plain")
        if "Upgrade" not in request.headers:
            own = await self._own(request.path)
            if own is not None:
                return own
        return self._page(inner, connection, request)

    def _page(self, inner: Callable[..., Response | None], connection: Any, request: Request) -> Response | None:
        """A file of viser's page; None where the request opens a websocket."""
        if "Upgrade" in request.headers and _PROTOCOL not in request.headers.get("Sec-WebSocket-Protocol", ""):
            # viser would print what the client says of itself
            return _response(http.HTTPStatus.BAD_REQUEST, f"splatgraft: expected {_PROTOCOL}\n".encode(), "text/plain")
        try:
            response = inner(connection, request)
        except (OSError, ValueError):  # a name that no file can have
            return _no_file()
        if response is not None:
            if response.headers.get("Content-Type", "").startswith("text/html"):
                self._add_assets(response)
            cookie = f"{cookie_name(request.headers['Host'])}={self._token}; HttpOnly; SameSite=Strict; Path=/"
            response.headers["Set-Cookie"] = cookie
            # no other site may embed this page in a frame (clickjacking), and the address holds the token
            response.headers["X-Frame-Options"] = "DENY"
            response.headers["Referrer-Policy"] = "no-referrer"
        return response

    async def _own(self, address: str) -> Response | None:
        """The answer to what is not part of viser's page; None for what is."""
        path, _, query = address.removeprefix("/").partition("?")
        if path.startswith(HAND_PREFIX):
            return await asyncio.to_thread(self._ask, path.removeprefix(HAND_PREFIX), query)
        allowed = allowed_query(address)
        if allowed is not None:
            moved = _response(http.HTTPStatus.FOUND, b"", "text/plain")
            moved.headers["Location"] = allowed
            return moved
        if path == _ALIVE:
            return _response(http.HTTPStatus.NO_CONTENT, b"", "text/plain")
        if path in _ASSETS:
            content = resources.files("splatgraft.editor.page").joinpath(path).read_bytes()
            return _response(http.HTTPStatus.OK, content, _TYPES[Path(path).suffix])
        return self._file(unquote(path.removeprefix(FILES_PREFIX))) if path.startswith(FILES_PREFIX) else None

    def _file(self, name: str) -> Response:
        """A file of the project."""
        try:
            file = self.files(name)
            if file is None:
                return _no_file()
            return _response(http.HTTPStatus.OK, file.read_bytes(), _TYPES.get(file.suffix, "application/octet-stream"))
        except (OSError, ValueError):  # a name that no file can have
            return _no_file()

    def _ask(self, name: str, query: str) -> Response:
        """Answer the page's script; only in the window that edits it is heard."""
        given, editing = dict(parse_qsl(query)), self.editing()
        answer = self.hands.get(name)
        if answer is None:
            return _response(http.HTTPStatus.NOT_FOUND, b"splatgraft: no such request\n", "text/plain")
        if editing is None or given.get("window") != str(editing.client_id):
            return _response(http.HTTPStatus.FORBIDDEN, b"splatgraft: another window edits\n", "text/plain")
        try:
            picture = answer(given)
        except (ValueError, KeyError) as error:
            return _response(http.HTTPStatus.BAD_REQUEST, f"splatgraft: {error}\n".encode(), "text/plain")
        except Exception as error:  # a programming error must be visible
            traceback.print_exception(error)
            return _response(http.HTTPStatus.INTERNAL_SERVER_ERROR, f"splatgraft: {error}\n".encode(), "text/plain")
        if picture is None:
            return _response(http.HTTPStatus.NO_CONTENT, b"", "text/plain")
        return _response(http.HTTPStatus.OK, picture, "image/jpeg")

    @staticmethod
    def _add_assets(response: Response) -> None:
        """Add the page's script and style to viser's page."""
        is_packed = response.headers.get("Content-Encoding") == "gzip"
        body = gzip.decompress(response.body) if is_packed else response.body
        body = body.replace(b"</head>", _HEAD, 1)
        response.body = gzip.compress(body, compresslevel=1) if is_packed else body
        del response.headers["Content-Length"]
        response.headers["Content-Length"] = str(len(response.body))

    async def _forward_allowed(self, inner: Callable[..., Any], window: int, message: Any) -> None:
        """Forward messages of the window that edits, and camera messages of all windows."""
        # viser's request for a public tunnel to this machine is never forwarded
        # the window may have closed since
        is_editing = self._windows[:1] == [window] and not isinstance(message, _messages.ShareUrlRequest)
        if is_editing or isinstance(message, _CAMERA_MESSAGES):
            await self._handle(partial(self._receive, inner), window, message)

    async def _handle(self, inner: Callable[..., Any], window: int, message: Any) -> None:
        try:
            await inner(window, message)
        except Exception as error:  # a value of another type than the control's, a property that it has not
            _say_malformed(error)

    async def _receive(self, inner: Callable[..., Any], window: int, message: Any) -> None:
        if isinstance(message, _messages.GuiUpdateMessage):
            control = self.viser.gui._gui_input_handle_from_uuid.get(message.uuid)
            if not _is_choosable(control, message.updates.get("value")):  # viser takes any value of the same type
                raise ValueError("expected a value that the control offers")
        if self._has_room(window, message):
            await inner(window, message)

    def _has_room(self, window: int, message: Any) -> bool:
        """Whether the server may keep what a message brings of an upload; a file too large is said in the window."""
        under_way = self.viser.gui._current_file_upload_states
        if isinstance(message, _messages.FileTransferPart):
            upload = under_way.get(message.transfer_uuid)
            return upload is not None and upload["transferred_bytes"] + len(message.content) <= upload["total_bytes"]
        if not isinstance(message, _messages.FileTransferStartUpload):
            return True
        size = message.size_bytes
        wanted = size + sum(upload["total_bytes"] for upload in under_way.values())
        if size >= 0 and wanted <= _MAX_UPLOAD_BYTES and len(under_way) < _MAX_UPLOADS:
            return True
        expected = f"expected an upload of at most {_MAX_UPLOAD_BYTES >> 30} GiB, found {size / 2**30:.1f} GiB"
        client = self.viser.get_clients().get(window)
        if client is not None:
            text = f"{message.filename:.100}: {expected}; write the path of the file instead, or make it smaller"
            client.add_notification("Upload refused", text, color="red")
        return False

    def _check(self, host: str) -> None:
        """Ask the own server for its page as a page of another site would: a viser that bypasses what stands before
        it must be detected."""
        probe = http.client.HTTPConnection(host, self.port, timeout=_PROBE_SECONDS)
        try:
            probe.request("GET", f"/?token={self._token}", headers={"Origin": "http://foreign.invalid"})
            status = probe.getresponse().status
        finally:
            probe.close()
        if status != http.HTTPStatus.FORBIDDEN:
            self.close()
            raise OSError(
                f"viser {viser.__version__}: expected it to refuse other sites, found status {status}; install 1.1.1"
            )


def _is_choosable(control: object, value: Any) -> bool:
    """Whether a value is one of a control's options and within its bounds, where it has any."""
    options, low, high = (getattr(control, name, None) for name in ("options", "min", "max"))
    if options is not None:
        return value in options
    is_above = not isinstance(low, int | float) or value >= low
    return is_above and (not isinstance(high, int | float) or value <= high)


def _say_malformed(error: Exception) -> None:
    # not the error's text, which may quote what was sent
    found = f"one that is not ({type(error).__name__})"
    sys.stderr.write(f"splatgraft: expected a message of the editor's own page, found {found}\n")


def _no_file() -> Response:
    return _response(http.HTTPStatus.NOT_FOUND, b"splatgraft: no such file\n", "text/plain")


def _response(status: http.HTTPStatus, body: bytes, kind: str) -> Response:
    headers = Headers({"Content-Type": kind, "Content-Length": str(len(body)), "X-Content-Type-Options": "nosniff"})
    return Response(int(status), status.phrase, headers, body)
