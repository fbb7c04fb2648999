"""The command `edit`: the web editor on a project."""

import secrets
import signal
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from splatgraft.editor.access.access_control import LOOPBACK, AccessControl
from splatgraft.project.folder_lock import locked
from splatgraft.project.layout import PROJECT_FILE
from splatgraft.runtime.console import Console
from splatgraft.runtime.desktop import open_page


@dataclass(frozen=True)
class Edit:
    """Open a project in the browser, or create one there."""

    project: Annotated[Path, tyro.conf.Positional] = Path(PROJECT_FILE)
    """The project file or its folder; it need not exist."""
    out: Path | None = None
    """Folder of all results; the folder of the project file where not given."""
    host: str = "127.0.0.1"
    """Address to listen at; beyond loopback the page accepts no paths outside the project's folder."""
    port: int = 8080
    """Port to listen at; the next free one where it is taken."""
    keep_closed: bool = False
    """Only print the address, where there is a desktop to open it on."""
    budget: int = 300_000
    """Maximum number of Gaussians per scene that the browser shows; files keep all."""

    def execute(self, console: Console) -> int:
        """Serve until Ctrl-C."""
        from splatgraft.editor.page.opening import Opening
        from splatgraft.editor.page.server import GuardedServer

        is_file = self.project.suffix == ".toml"
        file = (self.project if is_file else self.project / PROJECT_FILE).absolute()
        file.parent.mkdir(parents=True, exist_ok=True)
        is_loopback = self.host in LOOPBACK
        token = secrets.token_urlsafe(16)
        out = None if self.out is None else self.out.absolute()
        # before the page is served: an interruption while torch is loaded ends the editor as one later does
        stop = threading.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: stop.set())
        with locked(file.parent / "edit"):
            access = AccessControl(hosts=LOOPBACK if is_loopback else (), token=token)
            guarded = GuardedServer(access, host=self.host, port=self.port)
            loading = guarded.viser.gui.add_markdown("Loading the project ...")
            address = f"http://{self.host}:{guarded.port}/?token={token}"
            console.result(address)
            is_opened = is_loopback and not self.keep_closed and open_page(address)
            wanted = "opened in the browser" if is_opened else "open this address, all of it, in a browser"
            console.say(f"{wanted}; Ctrl-C ends the editor, but not jobs that it started")
            # torch, numba and the scenes take seconds to load, and the browser shows a sample of the scene meanwhile
            opening = Opening(guarded.viser, file, file.parent if out is None else out)
            from splatgraft.commands.edit_project import FlowProject
            from splatgraft.editor.access.uploads import remove_remains
            from splatgraft.editor.page.page import Page, PageOptions

            remove_remains(file.parent)
            project = FlowProject(file, out, console)
            options = PageOptions(budget=self.budget, inside=None if is_loopback else file.parent)
            page = Page(guarded, project, options, opening=opening)
            loading.remove()
            stop.wait()
            page.close()
            guarded.close()
        return 0


COMMAND = Edit
