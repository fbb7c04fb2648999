"""A small reverse proxy, as nginx or Caddy is configured: one path of a host leads to another server."""

import asyncio
import contextlib
import threading
from collections.abc import Iterator
from dataclasses import dataclass


@dataclass(frozen=True)
class ProxyRules:
    """How requests are passed on."""

    path: str
    """Path that leads to the other server, without a slash at its end."""
    is_stripped: bool
    """Whether the other server gets the path without it (nginx: proxy_pass with a slash; Caddy: handle_path)."""
    keeps_host: bool
    """Whether the other server gets the Host header of the browser; nginx sends the name of the server."""


async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with contextlib.suppress(OSError):
        while piece := await reader.read(1 << 16):
            writer.write(piece)
            await writer.drain()
    writer.close()


def _passed_on(head: bytes, rules: ProxyRules, upstream: str) -> bytes | None:
    """The head for the other server; None where the path is not passed on."""
    first, *lines = head.decode("latin-1").removesuffix("\r\n\r\n").split("\r\n")
    method, path, version = first.split(" ")
    # as `location /splat/`: the path itself is not passed on
    if not path.startswith(f"{rules.path}/"):
        return None
    path = path.removeprefix(rules.path) if rules.is_stripped else path
    kept = [line for line in lines if rules.keeps_host or not line.lower().startswith("host:")]
    if not rules.keeps_host:
        kept.append(f"Host: {upstream}")
    kept += ["X-Forwarded-For: 203.0.113.7", "X-Forwarded-Proto: https", "X-Forwarded-Host: elsewhere.example"]
    return "\r\n".join([f"{method} {path} {version}", *kept, "", ""]).encode("latin-1")


@contextlib.contextmanager
def reverse_proxy(rules: ProxyRules, upstream: list[str], port: int) -> Iterator[None]:
    """Pass requests at 127.0.0.1 on.

    Args:
        rules: Which and how.
        upstream: Name and port of the other server, once it is known.
        port: Where to listen.
    """
    ready, stops = threading.Event(), []
    tasks: set[asyncio.Task[None]] = set()

    async def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        tasks.add(task)
        try:
            await _pass_on((reader, writer), rules, upstream[0])
        finally:
            tasks.discard(task)
            await _close(writer)

    async def serve() -> None:
        stop, loop = asyncio.Event(), asyncio.get_running_loop()
        stops.append(lambda: loop.call_soon_threadsafe(stop.set))
        server = await asyncio.start_server(accept, "127.0.0.1", port)
        ready.set()
        await stop.wait()
        server.close()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    thread = threading.Thread(target=lambda: asyncio.run(serve()), daemon=True)
    thread.start()
    ready.wait()
    try:
        yield
    finally:
        stops[0]()
        thread.join()


async def _pass_on(outer: tuple[asyncio.StreamReader, asyncio.StreamWriter], rules: ProxyRules, upstream: str) -> None:
    head = _passed_on(await outer[0].readuntil(b"\r\n\r\n"), rules, upstream)
    if head is None:
        outer[1].write(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
        return
    name, _, number = upstream.partition(":")
    reader, writer = await asyncio.open_connection(name, int(number))
    try:
        writer.write(head)
        await asyncio.gather(_copy(outer[0], writer), _copy(reader, outer[1]))
    finally:
        await _close(writer)


async def _close(writer: asyncio.StreamWriter) -> None:
    writer.close()
    with contextlib.suppress(OSError):
        await writer.wait_closed()
