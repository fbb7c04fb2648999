"""Processes: children with a log, delayed Ctrl-C, exit while threads compute, peak memory, opening a page."""

import logging
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


_OPENERS = {"darwin": "open", "linux": "xdg-open"}


def run_logged(
    command: Sequence[str],
    log: Path,
    *,
    folder: Path | None = None,
    stdin: str | None = "",
    on_line: Callable[[str], None] | None = None,
) -> int:
    """Run a program, wait for it, and return its exit code, negative for a signal.

    Any exception while waiting, an interrupt included, kills the program. Standard error is appended to `log`; so is
    standard output unless `on_line` takes its lines. `stdin` is the text for the standard input. With None the input
    stays open while this process lives: a program that reads it to the end then notices when this process is killed.
    """
    with log.open("ab") as stream, tempfile.TemporaryFile() as given:
        given.write((stdin or "").encode())
        given.seek(0)
        source = subprocess.PIPE if stdin is None else given
        output = stream if on_line is None else subprocess.PIPE
        try:
            process = subprocess.Popen(list(command), stdin=source, stdout=output, stderr=stream, cwd=folder)
        except OSError as error:
            raise ValueError(f"{command[0]}: expected a program that starts, found {error.strerror}") from error
        with process:
            try:
                if on_line is not None and process.stdout is not None:
                    for line in process.stdout:
                        on_line(line.decode(errors="replace").rstrip("\r\n"))
                return process.wait()
            except BaseException:
                process.kill()
                raise


def source_commit() -> str:
    """Return the git commit of this package's source, with `-dirty` if it was changed; `unknown` outside a checkout."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--exclude=*"]
    try:
        done = subprocess.run(command, capture_output=True, encoding="utf-8", check=False)
    except OSError:
        return "unknown"
    return done.stdout.strip() or "unknown"


def last_line(log: Path) -> str:
    """Return the last line of `log` that is not blank, or an empty text."""
    lines = log.read_text(errors="replace", encoding="utf-8").strip().splitlines() if log.is_file() else []
    return lines[-1].strip() if lines else ""


@contextmanager
def interruption_held(*, terminate: bool = False) -> Generator[Callable[[], bool]]:
    """Delay the first Ctrl-C within the block, and with `terminate` a SIGTERM that has no handler.

    Yields a function that returns whether there was one; the block then saves its state and raises KeyboardInterrupt.
    The second Ctrl-C acts at once. Signals with another handler than Python's own, and blocks outside the main thread,
    are not affected.
    """
    requested = False

    def hold(number: int, frame: FrameType | None) -> None:
        nonlocal requested
        if requested:
            raise KeyboardInterrupt
        requested = True

    held: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        for number in _SIGNALS:
            before = signal.getsignal(number)
            unhandled = terminate and number == signal.SIGTERM and before is signal.SIG_DFL
            if before is signal.default_int_handler or unhandled:
                held[number] = before
    for number in held:
        signal.signal(number, hold)
    try:
        yield lambda: requested
    finally:
        for number, before in held.items():
            signal.signal(number, before)
    if requested:  # after the block's last look
        raise KeyboardInterrupt


def end_process(status: int) -> NoReturn:
    """Write out all output and end the process at once with this status.

    During Python's own shutdown a thread that returns from torch to Python is unwound through C++ code that forbids
    it, and the process aborts. Programs that compute in threads therefore end here, with all files closed.
    """
    logging.shutdown()
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(status)


def reset_peak_memory() -> None:
    """Reset the peak of resident memory; only Linux can, elsewhere it counts from the start of the process."""
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="utf-8")  # man proc: 5 resets VmHWM
    except OSError:
        return


def peak_memory_bytes() -> int:
    """Return the peak of resident memory since the last reset, in bytes; 0 on Windows, which has no such count."""
    status = Path("/proc/self/status")
    if status.is_file():
        for line in status.read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    try:
        import resource  # absent on Windows
    except ModuleNotFoundError:
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def open_page(page: Path | str) -> bool:
    """Open a local page or an address and return at once; returns False without a desktop or a program for pages.

    Text browsers are not used, because they would take over the terminal.
    """
    if sys.platform == "win32":
        try:
            os.startfile(page)
        except OSError:
            return False
        return True
    has_display = sys.platform == "darwin" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    opener = _OPENERS.get(sys.platform)
    if not has_display or opener is None:
        return False
    quiet = subprocess.DEVNULL
    try:
        opened = subprocess.Popen([opener, str(page)], stdin=quiet, stdout=quiet, stderr=quiet, start_new_session=True)
    except OSError:
        return False
    # some openers last as long as the browser's window
    threading.Thread(target=opened.wait, daemon=True).start()
    return True
