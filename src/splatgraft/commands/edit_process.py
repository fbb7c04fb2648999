"""The editor on one project, and the child process that serves it behind the front server of `edit`.

The child reads its token from the first line of its input, prints one JSON object with the port or with the error that
ended it, and ends with its input. Not a command.
"""

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NoReturn

from splatgraft.editor.access.access_control import LOOPBACK, AccessControl
from splatgraft.project.step import locked
from splatgraft.runtime.console import Console
from splatgraft.runtime.process import end_process

_END_SECONDS = 3.0
"""How long the child may take to end by itself."""


@dataclass(frozen=True)
class EditOptions:
    """The editor on one project."""

    file: str
    """project.toml, absolute; it need not exist."""
    out: str | None
    """Folder of all results, absolute; None: that of the project file."""
    budget: int
    """Maximum number of Gaussians per scene that the browser shows."""
    is_remote: bool
    """Whether windows on other machines can open it: typed paths are then restricted to the project's folder."""
    start_page: str | None = None
    """Address of the start page relative to the project's page; None: there is none."""


def edit_project(
    options: EditOptions,
    token: str,
    *,
    host: str,
    port: int,
    started: Callable[[int], None],
    stop: threading.Event,
) -> None:
    """Serve the editor on this machine until `stop` is set.

    Args:
        options: The project.
        token: What each request must carry.
        host: One of the names of loopback.
        port: Port to listen at, the next free one where it is taken; 0: any.
        started: Called with the port.
        stop: Ends the editor.

    Raises:
        ValueError: If another editor has the project open.
    """
    from splatgraft.editor.page.opening import Opening
    from splatgraft.editor.page.server import GuardedServer

    file = Path(options.file)
    file.parent.mkdir(parents=True, exist_ok=True)
    with locked(file.parent / "edit"):
        guarded = GuardedServer(AccessControl(token), host=host, port=port)
        loading = guarded.viser.gui.add_markdown("Loading the project ...")
        started(guarded.port)
        # torch, numba and the scenes take seconds to load, and the browser shows a sample of the scene meanwhile
        out = None if options.out is None else Path(options.out)
        opening = Opening(guarded.viser, file, file.parent if out is None else out)
        from splatgraft.commands.edit_project import FlowProject
        from splatgraft.editor.page.page import Page, PageOptions
        from splatgraft.editor.uploads.incoming_upload import remove_old_uploads

        removed = remove_old_uploads(file.parent, now=time.time())
        project = FlowProject(file, out, Console())
        inside = file.parent if options.is_remote else None
        page_options = PageOptions(options.budget, inside, start_page=options.start_page)
        page = Page(guarded, project, page_options, opening=opening)
        loading.remove()
        if removed and page.problem is None:
            page.say("; ".join(removed))
        stop.wait()
        page.close()
        guarded.close()


def child_command(options: EditOptions) -> tuple[str, ...]:
    """The command line of the child process that serves a project."""
    return sys.executable, "-m", "splatgraft.commands.edit_process", json.dumps(asdict(options))


def stop_at_signals(stop: Callable[[], object]) -> None:
    """Call `stop` at Ctrl-C and SIGTERM."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop())


def main(arguments: Sequence[str]) -> NoReturn:
    """Serve until the input ends, and end the process."""
    options = EditOptions(**json.loads(arguments[0]))
    stop = threading.Event()
    stop_at_signals(stop.set)
    token = sys.stdin.readline().strip()

    def wait_for_the_end() -> None:
        sys.stdin.read()
        stop.set()
        # torch or a scene may be loading; whatever was decided is in the project's files
        time.sleep(_END_SECONDS)
        os._exit(0)

    threading.Thread(target=wait_for_the_end, daemon=True).start()
    answer = sys.stdout
    # other prints would be taken for the answer
    sys.stdout = sys.stderr

    def started(port: int) -> None:
        print(json.dumps({"port": port}), file=answer, flush=True)

    try:
        edit_project(options, token, host=LOOPBACK[0], port=0, started=started, stop=stop)
    except (ValueError, OSError) as error:
        print(json.dumps({"error": " ".join(str(error).split())}), file=answer, flush=True)
        end_process(2)
    end_process(0)


if __name__ == "__main__":
    main(sys.argv[1:])
