"""The light of the edited scene, computed in a child process, so that pictures do not wait for it.

The editor sends states. The process returns the layers of the light transfer: first a draft, then, if requested, those
of the step `relight`.
"""

import contextlib
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import IO, Any, Literal, get_args

import torch

from splatgraft.editor.project import Project
from splatgraft.editor.relit_preview import Draft, RelitPreview
from splatgraft.editor.scene_cache import SceneCache
from splatgraft.editor.state import EditState, stamps_of
from splatgraft.editor.worker import LatestOnlyWorker
from splatgraft.relighting import Relit

Stage = Literal["draft", "final"]
"""Draft, or the step's result."""
Wanted = Literal["prepared", "draft", "final"]
"""Kinds of requests: prepare drafts when idle, compute a draft, or compute a draft and the final light."""
_NICE = 10  # priority below that of pictures, also while modules load
_START = (
    f"import os, sys; hasattr(os, 'nice') and os.nice({_NICE}); "
    "from splatgraft.editor import light_process; light_process.main(sys.argv[1:])"
)
"""Code that the process runs; `python -m` would pickle classes of `__main__`, which the editor cannot load."""
_FIELDS = ("objects", "erased", "light")
"""Fields of `EditState` on which the light depends."""
_SETTLE_SECONDS = 0.2  # time without a request before the light starts, which cannot be interrupted
_REMEMBERED = 500  # stored requests; each picture of a drag makes one, and a draft may take long


class LightProcess:
    """The editor's side, which requests the light of the newest state and receives the results."""

    def __init__(
        self,
        project: Project,
        on_lit: Callable[[EditState, Stage, Relit | Draft], None],
        on_error: Callable[[str], None],
    ) -> None:
        """Start no process yet; `on_lit` gets the layers of a draft without its Gaussians, those of the composite."""
        self._project, self._on_lit, self._on_error = project, on_lit, on_error
        self._child: subprocess.Popen[bytes] | None = None
        self._sent: dict[str, Any] = {}
        self._asked: dict[int, EditState] = {}
        self._number = 0
        self._wanted: Wanted | None = None
        self._lock = threading.Lock()

    @property
    def is_started(self) -> bool:
        """Whether the process was started, even if it has ended."""
        return self._child is not None

    def want(self, state: EditState, wanted: Wanted) -> None:
        """Request the light of a state in place of the last request, unless it was requested already."""
        with self._lock:
            if self._child is None or self._child.poll() is not None:
                self._start()
            assert self._child is not None
            assert self._child.stdin is not None
            # unchanged tensors are not sent again, because the process's memos compare inputs by identity
            changed = {
                name: getattr(state, name) for name in _FIELDS if self._sent.get(name, self) is not getattr(state, name)
            }
            order = get_args(Wanted)
            if not changed and self._wanted is not None and order.index(self._wanted) >= order.index(wanted):
                return
            self._number, self._wanted = self._number + 1, wanted
            self._asked.pop(self._number - _REMEMBERED, None)
            self._asked[self._number] = state
            try:
                _write(self._child.stdin, (self._number, changed, wanted))
                self._sent |= changed
            except OSError:
                self._child.kill()

    def close(self) -> None:
        """End the process."""
        with self._lock:
            child, self._child = self._child, None
        if child is not None:
            with contextlib.suppress(OSError):
                assert child.stdin is not None
                child.stdin.close()
            child.kill()
            child.wait()

    def _start(self) -> None:
        self._sent, self._asked, self._wanted = {}, {}, None
        out = "" if self._project.out is None else str(self._project.out)
        words = [sys.executable, "-c", _START, str(self._project.file), out]
        # a group of its own is not interrupted by Ctrl-C; in another session its priority would not count (autogroups)
        self._child = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, process_group=0)
        threading.Thread(target=self._listen, args=(self._child,), name="splatgraft light", daemon=True).start()

    def _listen(self, child: subprocess.Popen[bytes]) -> None:
        assert child.stdout is not None
        with child.stdout:
            while (answer := _read(child.stdout)) is not None:
                number, stage, result = answer
                with self._lock:
                    state, is_current = self._asked.get(number), child is self._child
                if not is_current or state is None:
                    continue
                if stage == "failed":
                    self._on_error(result)
                else:
                    self._on_lit(state, stage, result)
        with self._lock:
            if child is self._child:
                # the next `want` repeats the last request
                self._asked, self._wanted = {}, None


class _Computing:
    """The process's side: two threads, so that a draft does not wait for the light of an earlier state."""

    def __init__(self, project: Project, out: IO[bytes]) -> None:
        self._stamps = stamps_of(project.file)
        self._project, self._out = project, out
        self._lock = threading.Lock()
        self._scenes = SceneCache(project.files())
        self._relighting = RelitPreview(self._scenes)
        self._drafts = LatestOnlyWorker(self._failed)
        self._lights = LatestOnlyWorker(self._failed)
        self._number, self._state = 0, EditState()

    def take(self, number: int, changed: dict[str, Any], wanted: Wanted) -> None:
        stamps = stamps_of(self._project.file)
        if stamps != self._stamps:
            self._scenes.files, self._stamps = self._project.files(), stamps
        self._number, self._state = number, replace(self._state, **changed)
        self._drafts.submit(partial(self._draft, number, self._state, wanted))

    def _draft(self, number: int, state: EditState, wanted: Wanted) -> None:
        if wanted == "prepared":
            if self._drafts.wait_idle(_SETTLE_SECONDS):
                self._relighting.prepare_drafts(state)
            return
        if not self._relighting.is_relit(state):
            draft = self._relighting.draft(state)
            none = draft.relit.gaussians.select(torch.zeros(0, dtype=torch.int64))
            sent = replace(_without_evidence(draft.relit), gaussians=none, objects=())
            self._send(number, "draft", replace(draft, relit=sent))
        if wanted == "final":
            self._lights.submit(partial(self._light, number, state))

    def _light(self, number: int, state: EditState) -> None:
        if not self._lights.wait_idle(_SETTLE_SECONDS) or number != self._number:
            return
        self._send(number, "final", _without_evidence(self._relighting.relit(state)))
        if self._lights.wait_idle(_SETTLE_SECONDS) and number == self._number:
            self._relighting.prepare_drafts(state)

    def _send(self, number: int, stage: Stage | Literal["failed"], result: Relit | Draft | str) -> None:
        with self._lock:
            _write(self._out, (number, stage, result))

    def _failed(self, error: Exception) -> None:
        self._send(self._number, "failed", " ".join(str(error).split()) or type(error).__name__)


def _without_evidence(relit: Relit) -> Relit:
    """Drop the fields that only the step writes."""
    return replace(relit, estimate=None, received=(), prepared=())


def main(arguments: list[str]) -> None:
    """Answer requests until the input ends."""
    # printed text must not mix with the answers
    answers, sys.stdout = os.fdopen(os.dup(1), "wb"), sys.stderr
    os.dup2(2, 1)
    project = Project(Path(arguments[0]), Path(arguments[1]) if arguments[1] else None)
    computing = _Computing(project, answers)
    while (asked := _read(sys.stdin.buffer)) is not None:
        computing.take(*asked)
    os._exit(0)  # kernels may still run


def _write(stream: IO[bytes], message: object) -> None:
    pickle.dump(message, stream, protocol=5)
    stream.flush()


def _read(stream: IO[bytes]) -> Any:
    """Read the next message, which this program pickled itself; None at the end."""
    try:
        return pickle.load(stream)
    except (EOFError, pickle.UnpicklingError):  # the other process has ended, perhaps within a message
        return None
