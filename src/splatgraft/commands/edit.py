"""The command `edit`: the web editor on one project, or on several behind a start page."""

import asyncio
import secrets
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from splatgraft.commands.edit_process import EditOptions, child_command, edit_project, stop_at_signals
from splatgraft.editor.access.access_control import LOOPBACK, AccessControl, parse_public_address
from splatgraft.editor.access.tls import read_certificate
from splatgraft.editor.front.front_server import FrontOptions, FrontServer
from splatgraft.editor.front.project_folders import ProjectFolder, find_projects, project_folder, projects_inside
from splatgraft.editor.front.project_process import ProcessOptions
from splatgraft.editor.front.project_states import ProjectStates
from splatgraft.project.layout import PROJECT_FILE
from splatgraft.runtime.console import Console
from splatgraft.runtime.process import end_process, open_page


@dataclass(frozen=True)
class Edit:
    """Open projects in the browser, or create one there."""

    projects: Annotated[tuple[Path, ...], tyro.conf.Positional] = (Path(PROJECT_FILE),)
    """A project file or its folder, which need not exist; or several, or a folder that holds projects: a start page
    then lists them."""
    out: Path | None = None
    """Folder of all results of one project; the folder of the project file where not given."""
    host: str = LOOPBACK[0]
    """Address to listen at; beyond loopback the page accepts no paths outside the project's folder."""
    port: int = 8080
    """Port to listen at; the next free one where it is taken."""
    public_url: str | None = None
    """Address under which a reverse proxy shows the editor, such as https://studio.example/splat."""
    tls_certificate: Path | None = None
    """Certificate for HTTPS, with those of its issuers behind it, in PEM."""
    tls_key: Path | None = None
    """Private key of the certificate, in PEM, without a password."""
    keep_closed: bool = False
    """Only print the address, where there is a desktop to open it on."""
    budget: int = 300_000
    """Maximum number of Gaussians per scene that the browser shows; files keep all."""

    def execute(self, console: Console) -> int:
        """Serve until Ctrl-C."""
        single = self._single()
        if single is None and self.out is not None:
            raise ValueError("--out: expected one project, found several")
        is_direct = self.host in LOOPBACK and not (self.public_url or self.tls_certificate or self.tls_key)
        if single is not None and is_direct:
            self._edit_one(single, console)
            end_process(0)
        else:
            self._serve(single, console)
        return 0

    def _single(self) -> Path | None:
        """The one project file that is meant; None where there are several, or a folder of them."""
        if len(self.projects) != 1:
            return None
        path = self.projects[0]
        if path.suffix == ".toml":
            return path.absolute()
        file = path / PROJECT_FILE
        return file.absolute() if file.is_file() or not projects_inside(path) else None

    def _options(self, file: Path, *, is_remote: bool, start_page: str | None = None) -> EditOptions:
        out = None if self.out is None else str(self.out.absolute())
        return EditOptions(str(file), out, self.budget, is_remote, start_page)

    def _edit_one(self, file: Path, console: Console) -> None:
        """Serve one project to this machine, in this process."""
        # before the page is served: an interruption while torch is loaded ends the editor as one later does
        stop, token = threading.Event(), secrets.token_urlsafe(16)
        stop_at_signals(stop.set)

        def started(port: int) -> None:
            self._say_address(f"http://{self._host_name()}:{port}", token, console)

        edit_project(
            self._options(file, is_remote=False), token, host=self.host, port=self.port, started=started, stop=stop
        )

    def _serve(self, single: Path | None, console: Console) -> None:
        """Serve projects by processes of their own, behind one server."""
        is_loopback = self.host in LOOPBACK
        public = None if self.public_url is None else parse_public_address(self.public_url)
        certificate = read_certificate(self.tls_certificate, self.tls_key)
        token = secrets.token_urlsafe(16)
        access = AccessControl(
            token, LOOPBACK if is_loopback else (), public=public, is_encrypted=certificate is not None
        )
        options = FrontOptions(
            host=self.host,
            port=self.port,
            title=self._title(),
            is_single=single is not None,
            certificate=certificate,
        )

        def command(file: Path) -> tuple[str, ...]:
            is_remote = not is_loopback or public is not None
            return child_command(self._options(file, is_remote=is_remote, start_page=None if single else "../../"))

        def find() -> tuple[ProjectFolder, ...]:
            return find_projects(self.projects) if single is None else (project_folder(single),)

        def started(port: int) -> None:
            address = f"{'http' if certificate is None else 'https'}://{self._host_name()}:{port}"
            self._say_address(address if public is None else f"{public.origin}{public.path}", token, console)

        out = () if self.out is None else (str(self.out.absolute()),)
        states = ProjectStates((sys.executable, "-m", "splatgraft.commands.edit_states", *out), out=self.out)
        try:
            front = FrontServer(access, options, find=find, states=states, processes=ProcessOptions(command))
            asyncio.run(_until_interrupted(front, started))
        finally:
            states.close()

    def _title(self) -> str:
        """The name of the folder that holds the projects."""
        return self.projects[0].absolute().name if len(self.projects) == 1 else "Projects"

    def _host_name(self) -> str:
        """The host in an address."""
        return f"[{self.host}]" if ":" in self.host else self.host

    def _say_address(self, address: str, token: str, console: Console) -> None:
        complete = f"{address}/?token={token}"
        console.result(complete)
        is_here = self.host in LOOPBACK and self.public_url is None
        is_opened = is_here and not self.keep_closed and open_page(complete)
        wanted = "opened in the browser" if is_opened else "open this address, all of it, in a browser"
        console.say(f"{wanted}; Ctrl-C ends the editor, but not jobs that it started")


async def _until_interrupted(front: FrontServer, started: Callable[[int], None]) -> None:
    stop, loop = asyncio.Event(), asyncio.get_running_loop()
    stop_at_signals(lambda: loop.call_soon_threadsafe(stop.set))
    await front.run(stop, started)


COMMAND = Edit
