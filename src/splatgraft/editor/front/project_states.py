"""What the start page says about each project: up to date, out of date, running or broken, and when it was changed.

Which steps are stale is found out by a process of its own: it needs the steps, which load torch, and whatever is in a
project's files cannot end the server with it.
"""

import json
import subprocess
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from splatgraft.editor.front.project_folders import ProjectFolder
from splatgraft.editor.front.thumbnails import newest_picture
from splatgraft.editor.jobs.jobs import STATE_FILE, Jobs
from splatgraft.project.layout import EDITOR_FOLDER, PLACEMENT_FILE, PROJECT_FILE, RESULTS_IN_ORDER

StateKind = Literal["unknown", "running", "fresh", "stale", "part", "new", "bad"]
_NOT_MADE = "not made yet"
_REST_SHARE = 20
"""Seconds between two looks at the steps over the seconds that a look took."""
_REST_SECONDS = (2.0, 10.0)
"""Least and longest time between two looks."""
_KEEP_SECONDS = 60.0
"""How long the process waits for the next look."""
_CHANGED = (
    *(PROJECT_FILE, PLACEMENT_FILE, "light.json", "erased.npy", "corrections.npy", "prompts.json"),
    *(f"{EDITOR_FOLDER}/{name}" for name in ("history.json", STATE_FILE)),
    *(f"{folder}/step.json" for folder in RESULTS_IN_ORDER),
)
"""Files whose newest time is that of the project."""


@dataclass(frozen=True)
class ProjectState:
    """The state of one project."""

    kind: StateKind
    """`unknown`: not looked at yet; `part`: some steps were run; `new`: none was; `bad`: it cannot be read."""
    text: str
    """In words for the user, one line."""
    changed: float
    """When its files were last changed, seconds since 1970; 0 where there are none."""
    picture: Path | None
    """The newest picture of its result or preview."""


class ProjectStates:
    """The states of all projects, kept up to date in a thread while they are asked for."""

    def __init__(self, command: Sequence[str], *, out: Path | None) -> None:
        """Look at nothing yet.

        Args:
            command: Command line of the process that reads a project file's path per line and answers with a JSON
                object per line: the reason why each step is stale, null where it is not.
            out: Folder of the results; None: that of each project file.
        """
        self._command, self._out = tuple(command), out
        self._process: subprocess.Popen[str] | None = None
        self._reasons: dict[Path, dict[str, str | None]] = {}
        self._wanted: tuple[ProjectFolder, ...] = ()
        self._wake, self._open = threading.Event(), True
        self._thread = threading.Thread(target=self._loop, daemon=True)
        self._thread.start()

    def state(self, project: ProjectFolder) -> ProjectState:
        """The state of one project as far as it is known; returns at once."""
        root = self._out or project.file.parent
        times = [path.stat().st_mtime for path in _files(project.file, root) if path.is_file()]
        kind, text = self._kind(project, root)
        return ProjectState(kind, " ".join(text.split()), max(times, default=0.0), newest_picture(root))

    def want(self, projects: Sequence[ProjectFolder]) -> None:
        """Look at the steps of these projects soon."""
        self._wanted = tuple(projects)
        self._wake.set()

    def close(self) -> None:
        """End the thread and its process."""
        self._open = False
        self._wake.set()
        process = self._process
        if process is not None:
            process.kill()
        self._thread.join()

    def _kind(self, project: ProjectFolder, root: Path) -> tuple[StateKind, str]:
        try:
            job = Jobs(root / EDITOR_FOLDER).state()
        except ValueError:
            job = None  # a damaged state of a job is replaced by the next job
        if job is not None and job.live:
            share = f", {100 * job.fraction:.0f}% of {job.step}" if job.step and job.total else ""
            return "running", f"{job.title}{share}"
        if not project.file.is_file():
            return "new", "no project yet"
        reasons = self._reasons.get(project.file)
        return ("unknown", "") if reasons is None else _summary(reasons, project.file.parent)

    def _loop(self) -> None:
        while self._open:
            if not self._wake.wait(_KEEP_SECONDS):
                # nobody looks: its memory is given back
                self._end()
                continue
            self._wake.clear()
            start = time.monotonic()
            for project in self._wanted:
                if self._open and project.file.is_file():
                    self._reasons[project.file] = self._ask(project.file)
            spent = time.monotonic() - start
            least, longest = _REST_SECONDS
            self._rest(min(longest, max(least, _REST_SHARE * spent)))
        self._end()

    def _rest(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while self._open and time.monotonic() < end:
            time.sleep(0.1)

    def _ask(self, file: Path) -> dict[str, str | None]:
        """The answer of the process on one project; its own end is an answer too."""
        try:
            process = self._process
            if process is None or process.poll() is not None:
                self._end()
                process = self._process = subprocess.Popen(
                    self._command,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    text=True,
                    encoding="utf-8",
                    # Ctrl-C is for the server, which then ends the process
                    start_new_session=True,
                )
            assert process.stdin is not None
            assert process.stdout is not None
            process.stdin.write(json.dumps(str(file)) + "\n")
            process.stdin.flush()
            return dict(json.loads(process.stdout.readline()))
        except (OSError, ValueError):
            self._end()
            return {"error": f"{file}: expected its steps to be looked at, found that the process for it ended"}

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            with process:
                pass


def _summary(reasons: Mapping[str, str | None], folder: Path) -> tuple[StateKind, str]:
    """The steps of a project in one line."""
    if "error" in reasons:
        # the name of the project stands above it
        return "bad", str(reasons["error"]).replace(f"{folder}/", "")
    stale = {step: reason for step, reason in reasons.items() if reason is not None}
    if not stale:
        return "fresh", ""
    step, reason = next(iter(stale.items()))
    if len(stale) == len(reasons) and reason == _NOT_MADE:
        return "new", "nothing was run yet"
    return ("part", f"next: {step}") if reason == _NOT_MADE else ("stale", f"{step}: {reason}")


def _files(file: Path, root: Path) -> list[Path]:
    beside = [file.parent / name for name in _CHANGED]
    return beside if root == file.parent else [*beside, *(root / name for name in _CHANGED)]
