"""Passes requests on to the process of a project: an answer as a whole, a websocket byte by byte in both directions."""

import asyncio
import contextlib
import tempfile
from dataclasses import dataclass

from websockets.datastructures import Headers
from websockets.http11 import Request

from splatgraft.editor.access.access_control import cookie_name
from splatgraft.editor.front.http_messages import MAX_HEAD_BYTES
from splatgraft.editor.front.project_process import ProjectProcess

_KEPT = ("Accept-Encoding", *(f"Sec-WebSocket-{name}" for name in ("Key", "Version", "Protocol", "Extensions")))
"""Headers that the process gets as they are; all others, also X-Forwarded ones and cookies, stay behind."""
_PIECE = 64 << 10
_IN_MEMORY = 16 << 20
"""Bytes of an answer that are held in memory; the rest waits on the disk until the browser has taken it."""

Streams = tuple[asyncio.StreamReader, asyncio.StreamWriter]


@dataclass(frozen=True)
class Asked:
    """The beginning of a process's answer."""

    head: bytes
    """Status and headers."""
    streams: Streams
    """Of the process; the rest of the answer follows."""


async def ask(request: Request, process: ProjectProcess) -> Asked:
    """Pass a request on.

    Args:
        request: The request, with the path that the process knows.
        process: The process, which has a port.

    Raises:
        OSError, EOFError: If the process is gone.
    """
    port = process.port or 0
    reader, writer = await asyncio.open_connection("127.0.0.1", port, limit=MAX_HEAD_BYTES)
    try:
        writer.write(_inner_request(request, port, process.token).serialize())
        await writer.drain()
        return Asked(await reader.readuntil(b"\r\n\r\n"), (reader, writer))
    except BaseException:
        writer.close()
        raise


async def answer_from(asked: Asked, request: Request, streams: Streams, process: ProjectProcess) -> None:
    """Pass an answer back, and a websocket's bytes in both directions until one side ends.

    Args:
        asked: The beginning of the answer.
        request: The request, with the path that the process knows.
        streams: Of the browser.
        process: The process that answers.

    Raises:
        OSError: If the browser is gone.
    """
    try:
        if is_websocket(request):
            with process.websocket(is_window=request.path == "/"):
                await _pass_websocket(asked.head, streams, asked.streams)
        else:
            await _pass_answer(asked.head, streams[1], asked.streams[0])
    finally:
        asked.streams[1].close()


def is_websocket(request: Request) -> bool:
    """Whether a request asks for a websocket."""
    return [value.lower() for value in request.headers.get_all("Upgrade")] == ["websocket"]


def _inner_request(request: Request, port: int, token: str) -> Request:
    host = f"127.0.0.1:{port}"
    headers = Headers({"Host": host, "Cookie": f"{cookie_name(host)}={token}"})
    if is_websocket(request):
        headers.update({"Origin": f"http://{host}", "Upgrade": "websocket", "Connection": "Upgrade"})
    for name in _KEPT:
        for value in request.headers.get_all(name):
            headers[name] = value
    return Request(request.path, headers)


async def _pass_answer(head: bytes, writer: asyncio.StreamWriter, reader: asyncio.StreamReader) -> None:
    """Take the whole answer first: the process closes a connection that takes it slowly."""
    with tempfile.SpooledTemporaryFile(_IN_MEMORY) as held:
        while piece := await reader.read(_PIECE):
            held.write(piece)
        held.seek(0)
        writer.write(head)
        while piece := held.read(_PIECE):
            writer.write(piece)
            await writer.drain()


async def _pass_websocket(head: bytes, outer: Streams, inner: Streams) -> None:
    outer[1].write(head)
    ways = {asyncio.create_task(_copy(outer[0], inner[1])), asyncio.create_task(_copy(inner[0], outer[1]))}
    try:
        await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for way in ways:
            way.cancel()
        await asyncio.gather(*ways, return_exceptions=True)


async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with contextlib.suppress(OSError):
        while piece := await reader.read(_PIECE):
            writer.write(piece)
            await writer.drain()
