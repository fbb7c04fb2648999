"""The process that serves one project, on a port of its own on loopback, with a token of its own."""

import asyncio
import contextlib
import json
import secrets
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from splatgraft.editor.front.project_folders import ProjectFolder

_END_SECONDS = 20.0
"""After which a process that was asked to end is killed."""
_AGAIN_SECONDS = 60.0
"""Least time between two starts that a window causes by itself; opening the page starts at once."""


@dataclass(frozen=True)
class ProcessOptions:
    """What the processes of all projects have in common."""

    command: Callable[[Path], Sequence[str]]
    """The command line that serves a project file. It reads the token from its first line of input, prints one JSON
    object with `port` or `error`, and ends with its input."""
    idle_seconds: float = 900.0
    """A process without a window is ended after this time; edits are saved at once, and jobs are not its children."""


class ProjectProcess:
    """One project: its process, started when it is opened, and again after its end."""

    def __init__(self, project: ProjectFolder, options: ProcessOptions) -> None:
        """Start nothing yet."""
        self.project, self._options = project, options
        self.token = secrets.token_urlsafe(16)
        self.port: int | None = None
        """Where the process listens; None while it does not."""
        self.problem = ""
        """Why the last process ended, in one line; empty where none ended by itself."""
        self.windows = 0
        """Open windows."""
        self._websockets = 0
        self._process: asyncio.subprocess.Process | None = None
        self._watch: asyncio.Task[None] | None = None
        self._answered = asyncio.Event()
        self._started, self._used = -_AGAIN_SECONDS, time.monotonic()

    @property
    def is_running(self) -> bool:
        """Whether its process is starting or serves."""
        return self._watch is not None and not self._watch.done()

    async def open(self, wait_seconds: float) -> int | None:
        """Start the process where it does not run; its port, None where it has none after the given time."""
        self._used = time.monotonic()
        if not self.is_running:
            self.problem, self.port = "", None
            self._answered.clear()
            self._started = time.monotonic()
            self._watch = asyncio.create_task(self._run())
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._answered.wait(), wait_seconds)
        return self.port

    async def reopen(self, wait_seconds: float) -> int | None:
        """As `open`, for a window that connects again by itself: a process that keeps ending is not started again."""
        if not self.is_running and time.monotonic() - self._started < _AGAIN_SECONDS:
            return None
        return await self.open(wait_seconds)

    @contextlib.contextmanager
    def websocket(self, *, is_window: bool) -> Iterator[None]:
        """Keep the process meanwhile, for a window or for an upload, which has a websocket of its own."""
        self._websockets += 1
        self.windows += is_window
        try:
            yield
        finally:
            self.windows -= is_window
            self._websockets -= 1
            self._used = time.monotonic()

    async def end_if_idle(self) -> None:
        """End the process where no window has been open for long."""
        if self.is_running and not self._websockets and time.monotonic() - self._used > self._options.idle_seconds:
            await self.end()

    async def end(self) -> None:
        """End the process."""
        process, watch = self._process, self._watch
        if process is None or watch is None:
            return
        if process.stdin is not None:
            process.stdin.close()
        try:
            await asyncio.wait_for(asyncio.shield(watch), _END_SECONDS)
        except TimeoutError:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await watch
        self.problem = ""

    async def _run(self) -> None:
        """Start the process and wait for its end."""
        try:
            await self._serve()
        except (OSError, ValueError) as error:
            self.problem = " ".join(str(error).split())
        finally:
            self.port, self._process = None, None
            self._answered.set()

    async def _serve(self) -> None:
        pipe = asyncio.subprocess.PIPE
        process = await asyncio.create_subprocess_exec(
            *self._options.command(self.project.file),
            stdin=pipe,
            stdout=pipe,
            # Ctrl-C is for the server, which then ends the process
            start_new_session=True,
        )
        self._process = process
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(f"{self.token}\n".encode())
        error = ""
        while line := await process.stdout.readline():
            found = json.loads(line)
            self.port, error = found.get("port"), found.get("error", "")
            self._answered.set()
        status = await process.wait()
        if error or status:
            self.problem = error or _ended(self.project.name, status)


def _ended(name: str, status: int) -> str:
    return f"{name}: expected its editor to go on, found that it ended ({status})"
