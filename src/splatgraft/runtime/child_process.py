"""Programs run to their end in a process of their own, with their output in a log file."""

import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path


def run_logged(
    command: Sequence[str],
    log: Path,
    *,
    folder: Path | None = None,
    stdin: str = "",
    on_line: Callable[[str], None] | None = None,
) -> int:
    """Run `command` and wait for it; an exception in the meantime, an interrupt included, kills the process.

    Args:
        command: Program and arguments; no shell is involved.
        log: File to which standard error is appended, and standard output where `on_line` is None.
        folder: Working directory of the process; this process's where None.
        stdin: Text for the standard input.
        on_line: Called with each line of the standard output, without its end, as soon as it is written.

    Returns:
        The exit code; negative where a signal ended the process.

    Raises:
        ValueError: Where the program cannot be started.
    """
    with log.open("ab") as stream, tempfile.TemporaryFile() as given:
        given.write(stdin.encode())
        given.seek(0)
        output = stream if on_line is None else subprocess.PIPE
        try:
            process = subprocess.Popen(list(command), stdin=given, stdout=output, stderr=stream, cwd=folder)
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


def last_line(log: Path) -> str:
    """The last line of `log` that is not blank; empty where there is none."""
    lines = log.read_text(errors="replace").strip().splitlines() if log.is_file() else []
    return lines[-1].strip() if lines else ""


def run_attached(command: Sequence[str], log: Path, *, on_line: Callable[[str], None]) -> int:
    """Run `command` with a standard input that stays open as long as this process lives, and wait for it.

    A program that reads its standard input to the end notices when this process is killed.

    Args:
        command: Program and arguments; no shell is involved.
        log: File to which standard error is appended.
        on_line: Called with each line of the standard output, without its end, as soon as it is written.

    Returns:
        The exit code; negative where a signal ended the process.
    """
    with (
        log.open("ab") as stream,
        subprocess.Popen(list(command), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stream) as process,
    ):
        try:
            assert process.stdout is not None
            for line in process.stdout:
                on_line(line.decode(errors="replace").rstrip("\r\n"))
            return process.wait()
        except BaseException:
            process.kill()
            raise
