"""A network between browser and server that a test can make slow, and break."""

import asyncio
import contextlib
import threading
from collections.abc import Iterator


class Relay:
    """Passes connections at a port of 127.0.0.1 on to another one."""

    def __init__(self, port: int, to: int, *, rate: float = float("inf")) -> None:
        """Pass nothing on yet.

        Args:
            port: Where browsers connect.
            to: Where the server listens.
            rate: Bytes a second from the browser to the server.
        """
        self._port, self._to, self._rate = port, to, rate
        self._writers: set[asyncio.StreamWriter] = set()
        self._loop: asyncio.AbstractEventLoop | None = None
        self.is_cut = False

    def cut(self) -> None:
        """Break all connections, and refuse new ones until `restore`."""
        self.is_cut = True
        assert self._loop is not None
        self._loop.call_soon_threadsafe(self._break)

    def restore(self) -> None:
        """Pass connections on again."""
        self.is_cut = False

    def _break(self) -> None:
        for writer in tuple(self._writers):
            writer.transport.abort()

    async def serve(self, stop: asyncio.Event, ready: threading.Event) -> None:
        """Pass connections on until `stop`."""
        self._loop = asyncio.get_running_loop()
        tasks: set[asyncio.Task[None]] = set()

        async def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            task = asyncio.current_task()
            assert task is not None
            tasks.add(task)
            try:
                with contextlib.suppress(OSError, asyncio.CancelledError):
                    await self._pass_on(reader, writer)
            finally:
                tasks.discard(task)
                writer.transport.abort()

        server = await asyncio.start_server(accept, "127.0.0.1", self._port)
        ready.set()
        await stop.wait()
        server.close()
        self._break()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _pass_on(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self.is_cut:
            return
        inner, outer = await asyncio.open_connection("127.0.0.1", self._to)
        self._writers |= {writer, outer}
        ways = {asyncio.create_task(self._copy(reader, outer, self._rate))}
        ways.add(asyncio.create_task(self._copy(inner, writer, float("inf"))))
        try:
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for way in ways:
                way.cancel()
            await asyncio.gather(*ways, return_exceptions=True)
            self._writers -= {writer, outer}
            outer.transport.abort()

    async def _copy(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, rate: float) -> None:
        with contextlib.suppress(OSError):
            while piece := await reader.read(1 << 16):
                writer.write(piece)
                await writer.drain()
                await asyncio.sleep(len(piece) / rate)


@contextlib.contextmanager
def relayed(port: int, to: int, *, rate: float = float("inf")) -> Iterator[Relay]:
    """A relay at work."""
    relay, ready, stops = Relay(port, to, rate=rate), threading.Event(), []

    async def serve() -> None:
        stop, loop = asyncio.Event(), asyncio.get_running_loop()
        stops.append(lambda: loop.call_soon_threadsafe(stop.set))
        await relay.serve(stop, ready)

    thread = threading.Thread(target=lambda: asyncio.run(serve()), daemon=True)
    thread.start()
    ready.wait()
    try:
        yield relay
    finally:
        stops[0]()
        thread.join()
