"""The front server: the start page, and all projects behind one port, one token and one cookie.

It reads a request's head with the websockets library, checks it, and answers it or passes it on to the process of a
project. Every connection carries one request.
"""

import asyncio
import contextlib
import errno
import http
import ssl
from collections.abc import Callable
from dataclasses import dataclass, replace
from urllib.parse import unquote, urlsplit

from websockets.http11 import Request

from splatgraft.editor.access.access_control import AccessControl, allowed_query, plain_headers
from splatgraft.editor.front import start_page
from splatgraft.editor.front.http_messages import MAX_HEAD_BYTES, Answer, moved, parse_request, refusal, with_cookie
from splatgraft.editor.front.project_folders import ProjectFolder
from splatgraft.editor.front.project_process import ProcessOptions, ProjectProcess
from splatgraft.editor.front.project_proxy import Streams, answer_from, ask, is_websocket
from splatgraft.editor.front.project_states import ProjectState, ProjectStates
from splatgraft.editor.front.start_page import LIST_PATH, PROJECTS_PATH, THUMBNAILS_PATH, ProjectCard
from splatgraft.editor.front.thumbnails import thumbnail

_HEAD_SECONDS = 20.0
"""In which a client must have sent its request."""
_OPEN_SECONDS = 4.0
"""How long a page waits for its project's process before it says that it starts."""
_WINDOW_SECONDS = 60.0
"""The same for a window that connects again."""
_IDLE_LOOK_SECONDS = 30.0
_PORTS = 1000
"""How many ports are tried."""
_HTML = "text/html; charset=utf-8"
_CLOSED = "expected a project that is open, found it closed: load its page again"
_NO_PAGE = "expected a page of the editor, found no such page"


@dataclass(frozen=True)
class FrontOptions:
    """Where the server listens and what it shows."""

    host: str
    """Address to listen at."""
    port: int
    """Port to listen at; the next free one where it is taken."""
    title: str
    """Of the start page."""
    is_single: bool
    """Whether there is one project, which is opened without the start page."""
    certificate: ssl.SSLContext | None = None
    """Of HTTPS; None: plain HTTP."""


class FrontServer:
    """The server; all methods run in one event loop."""

    def __init__(
        self,
        access: AccessControl,
        options: FrontOptions,
        *,
        find: Callable[[], tuple[ProjectFolder, ...]],
        states: ProjectStates,
        processes: ProcessOptions,
    ) -> None:
        """Listen at nothing yet.

        Args:
            access: Which requests are answered.
            options: Where the server listens.
            find: Looks for the projects.
            states: What is known about each.
            processes: How they are served.
        """
        self._access, self._options, self._find = access, options, find
        self._states, self._process_options = states, processes
        self._processes: dict[str, ProjectProcess] = {}
        self._projects = {project.key: project for project in find()}
        self._base = "" if access.public is None else access.public.path
        self._connections: set[asyncio.Task[None]] = set()
        self._thumbnails: dict[str, tuple[tuple[str, int], bytes | None]] = {}
        self.port = 0

    async def run(self, stop: asyncio.Event, started: Callable[[int], None]) -> None:
        """Serve until `stop`; then all processes are ended.

        Args:
            stop: Ends the server.
            started: Called with the port.

        Raises:
            OSError: If no port is free, or the address is none of this machine.
        """
        server = await self._listen()
        self.port = server.sockets[0].getsockname()[1]
        started(self.port)
        idle = asyncio.create_task(self._end_idle())
        try:
            await stop.wait()
        finally:
            idle.cancel()
            server.close()
            for task in self._connections:
                task.cancel()
            await asyncio.gather(idle, *self._connections, return_exceptions=True)
            await asyncio.gather(*(process.end() for process in self._processes.values()))

    async def _listen(self) -> asyncio.Server:
        options = self._options
        for port in range(options.port, options.port + _PORTS):
            try:
                return await asyncio.start_server(
                    self._accept, options.host or None, port, limit=MAX_HEAD_BYTES, ssl=options.certificate
                )
            except OSError as error:
                if error.errno != errno.EADDRINUSE or options.port == 0:
                    raise
        raise _no_port(options.port)

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._connections.add(task)
        try:
            # clients come and go
            with contextlib.suppress(OSError, EOFError, TimeoutError, asyncio.LimitOverrunError):
                await self._serve((reader, writer))
        finally:
            self._connections.discard(task)
            writer.close()

    async def _serve(self, streams: Streams) -> None:
        reader, writer = streams
        async with asyncio.timeout(_HEAD_SECONDS):
            head = await reader.readuntil(b"\r\n\r\n")
        try:
            request = parse_request(head)
        except ValueError:
            await _send(writer, refusal(http.HTTPStatus.BAD_REQUEST, "expected a GET request, found another"), None)
            return
        decision = self._access.check(plain_headers(request.headers), request.path)
        if not decision.allowed:
            await _send(writer, refusal(http.HTTPStatus.FORBIDDEN, decision.reason), None)
            return
        query = None if is_websocket(request) else allowed_query(request.path)
        if query is not None:
            await _send(writer, moved(query), decision.cookie)
            return
        process, inner = self._routed(request)
        if process is None:
            await _send(writer, await self._own_answer(request), decision.cookie)
            return
        answer = await self._opened(process, request, inner)
        if answer is not None:
            await _send(writer, answer, decision.cookie)
            return
        passed = Request(inner, request.headers)
        try:
            asked = await ask(passed, process)
        except (OSError, EOFError):
            # the process ended just now
            await _send(writer, refusal(http.HTTPStatus.SERVICE_UNAVAILABLE, _CLOSED), decision.cookie)
            return
        asked = replace(asked, head=with_cookie(asked.head, decision.cookie))
        await answer_from(asked, passed, streams, process)

    # which page

    def _parts(self, request: Request) -> list[str]:
        """The path below the start page, in parts; a proxy may have taken the public path away or not."""
        path = request.path.partition("?")[0]
        if self._base and (path == self._base or path.startswith(f"{self._base}/")):
            path = path.removeprefix(self._base)
        return path.removeprefix("/").split("/", 2)

    def _routed(self, request: Request) -> tuple[ProjectProcess | None, str]:
        """The process that answers a request and the path that it knows; None: the server itself answers."""
        parts = self._parts(request)
        project = self._projects.get(unquote(parts[1])) if parts[0] == PROJECTS_PATH and len(parts) > 1 else None
        if project is None or (len(parts) == 2 and not is_websocket(request)):
            return None, ""
        if project.key not in self._processes:
            self._processes[project.key] = ProjectProcess(project, self._process_options)
        # the query holds the token of this server
        return self._processes[project.key], "/" + (parts[2] if len(parts) > 2 else "")

    async def _opened(self, process: ProjectProcess, request: Request, inner: str) -> Answer | None:
        """Start a project's process where it is needed; an answer where it does not serve yet."""
        if inner != "/":
            found = process.port
        elif is_websocket(request):
            found = await process.reopen(_WINDOW_SECONDS)
        else:
            # a problem is shown once; opening the page again starts the process again
            problem, process.problem = process.problem, ""
            if problem and not process.is_running:
                return self._problem_answer(process, problem, request)
            found = await process.open(_OPEN_SECONDS)
        if found is not None:
            return None
        if process.problem and inner == "/" and not is_websocket(request):
            problem, process.problem = process.problem, ""
            return self._problem_answer(process, problem, request)
        if process.is_running and inner == "/" and not is_websocket(request):
            return Answer(start_page.waiting_page(process.project, base=self._root(request)), _HTML)
        return refusal(http.HTTPStatus.SERVICE_UNAVAILABLE, _CLOSED)

    def _problem_answer(self, process: ProjectProcess, problem: str, request: Request) -> Answer:
        others = "" if self._options.is_single else "All projects"
        page = start_page.problem_page(process.project, problem, others, base=self._root(request))
        return Answer(page, _HTML, http.HTTPStatus.SERVICE_UNAVAILABLE)

    def _root(self, request: Request) -> str:
        """The address of the start page in a page's `base`: as a path where it is known, else relative."""
        if self._base:
            return f"{self._base}/"
        return "../" * (len(self._parts(request)) - 1) or "./"

    # the server's own pages

    async def _own_answer(self, request: Request) -> Answer:
        parts = self._parts(request)
        query = urlsplit(request.path).query
        if parts == [""]:
            return await self._start_answer(request, query)
        if len(parts) == 1 and parts[0] in start_page.ASSETS:
            return Answer(start_page.asset(parts[0]), start_page.ASSETS[parts[0]])
        if parts == [LIST_PATH]:
            return Answer(start_page.project_list(await self._cards()), _HTML)
        project = self._projects.get(unquote(parts[1])) if len(parts) > 1 else None
        if project is not None and parts[0] == PROJECTS_PATH and len(parts) == 2:
            return moved(f"{project.key}/" + (f"?{query}" if query else ""))
        if project is not None and parts[0] == THUMBNAILS_PATH:
            found = await asyncio.to_thread(self._thumbnail, project)
            if found is not None:
                return Answer(found, "image/jpeg")
        return refusal(http.HTTPStatus.NOT_FOUND, _NO_PAGE)

    async def _start_answer(self, request: Request, query: str) -> Answer:
        if self._options.is_single:
            key = next(iter(self._projects))
            # the cookie does not come along on a redirection that began on another site
            return moved(f"{self._root(request)}{PROJECTS_PATH}/{key}/" + (f"?{query}" if query else ""))
        page = start_page.start_page(await self._cards(), title=self._options.title, base=self._root(request))
        return Answer(page, _HTML)

    async def _cards(self) -> list[ProjectCard]:
        projects, states = await asyncio.to_thread(self._look)
        windows = {key: process.windows for key, process in self._processes.items()}
        return [
            ProjectCard(project, state, windows.get(project.key, 0))
            for project, state in zip(projects, states, strict=True)
        ]

    def _look(self) -> tuple[list[ProjectFolder], list[ProjectState]]:
        """The projects of now with their states, from the disk."""
        # a folder that is away for a moment leaves the list as it was
        with contextlib.suppress(ValueError, OSError):
            self._projects = {project.key: project for project in self._find()}
        projects = list(self._projects.values())
        self._states.want(projects)
        return projects, [self._states.state(project) for project in projects]

    def _thumbnail(self, project: ProjectFolder) -> bytes | None:
        picture = self._states.state(project).picture
        if picture is None:
            return None
        stamp = (str(picture), picture.stat().st_mtime_ns)
        known = self._thumbnails.get(project.key)
        if known is None or known[0] != stamp:
            known = self._thumbnails[project.key] = (stamp, thumbnail(picture))
        return known[1]

    async def _end_idle(self) -> None:
        while True:
            await asyncio.sleep(_IDLE_LOOK_SECONDS)
            for process in tuple(self._processes.values()):
                await process.end_if_idle()


def _no_port(first: int) -> OSError:
    return OSError(f"--port: expected a free one from {first} on, found none")


async def _send(writer: asyncio.StreamWriter, answer: Answer, cookie: str | None) -> None:
    writer.write(answer.serialized(cookie))
    await writer.drain()
