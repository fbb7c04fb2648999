"""The command `edit`: the web editor on one project, for the browsers of this machine."""

import gc
import secrets
import signal
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from splatgraft.editor.access import LOOPBACK
from splatgraft.project.layout import PROJECT_FILE
from splatgraft.project.step import locked
from splatgraft.runtime.console import Console
from splatgraft.runtime.files import is_writable
from splatgraft.runtime.process import end_process, open_page


@dataclass(frozen=True)
class Edit:
    """Open a project in the browser, or create one there."""

    project: Annotated[Path, tyro.conf.Positional] = Path(PROJECT_FILE)
    """The project file or its folder, which need not exist."""
    out: Path | None = None
    """Folder of all results; the folder of the project file if not given."""
    port: int = 8080
    """Port to listen at, on this machine only; the next free one if it is taken."""
    keep_closed: bool = False
    """Print the address without opening it in the browser."""

    def execute(self, console: Console) -> int:
        """Serve until Ctrl-C."""
        # set before the page is served, so that Ctrl-C ends the editor cleanly even while torch is being loaded
        stop = threading.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: stop.set())
        self.serve(console, stop)
        end_process(0)

    def serve(self, console: Console, stop: threading.Event) -> None:
        """Serve until `stop` is set; raises ValueError if another editor has the project open."""
        from splatgraft.editor.server import Server

        path = self.project.absolute()
        file = path if path.suffix == ".toml" else path / PROJECT_FILE
        out = None if self.out is None else self.out.absolute()
        if out is not None and not is_writable(out):
            raise ValueError(f"{out}: expected a folder for the results, found a read-only one")
        with locked(file.parent / "edit"):
            token = secrets.token_urlsafe(16)
            server = Server(token, host=LOOPBACK[0], port=self.port)
            self._say_address(f"http://{LOOPBACK[0]}:{server.port}/?token={token}", console)
            # torch, numba and the scenes take seconds to load; the browser opens the page meanwhile
            gc.disable()  # while modules load, nothing becomes garbage, and the search for it takes a sixth of the time
            from splatgraft.editor.editor import Editor
            from splatgraft.editor.project import Project

            gc.freeze()
            gc.enable()
            editor = Editor(server, Project(file, out))
            stop.wait()
            editor.close()
            server.close()

    def _say_address(self, address: str, console: Console) -> None:
        console.result(address)
        is_opened = not self.keep_closed and open_page(address)
        wanted = "opened in the browser" if is_opened else "open this address, all of it, in a browser"
        console.say(f"{wanted}; Ctrl-C ends the editor, but not jobs that it started")


COMMAND = Edit
