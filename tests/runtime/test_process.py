"""Child processes leave nothing behind; a process ends with threads at work; a page opens if there is a desktop."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from splatgraft.runtime import process
from splatgraft.runtime.process import interruption_held, last_line, open_page, run_logged


def python(program: str) -> list[str]:
    return [sys.executable, "-c", program]


def test_both_streams_are_appended_to_the_log(tmp_path):
    log = tmp_path / "log"
    log.write_text("before\n")
    code = run_logged(python("import os; os.write(1, b'out\\n'); os.write(2, b'err\\n'); raise SystemExit(3)"), log)
    assert code == 3
    assert log.read_text().splitlines() == ["before", "out", "err"]
    assert last_line(log) == "err"


def test_lines_of_the_output_are_handed_over_and_stay_out_of_the_log(tmp_path):
    lines = []
    program = "import sys; print('one'); print('two', end=''); sys.stderr.write('warning\\n\\n')"
    assert run_logged(python(program), tmp_path / "log", on_line=lines.append) == 0
    assert lines == ["one", "two"]
    assert last_line(tmp_path / "log") == "warning"


def test_a_line_arrives_while_the_process_runs(tmp_path):
    # the process ends only after the file exists that its line causes
    program = "import os, sys, time; print(1, flush=True)\nwhile not os.path.exists('seen'): time.sleep(0.01)"
    seen = tmp_path / "seen"
    assert run_logged(python(program), tmp_path / "log", folder=tmp_path, on_line=lambda line: seen.touch()) == 0


def test_standard_input_and_folder(tmp_path):
    text = "line\n" * 100_000  # more than a pipe holds
    program = "import sys; open('copy', 'w').write(sys.stdin.read())"
    assert run_logged(python(program), tmp_path / "log", folder=tmp_path, stdin=text) == 0
    assert (tmp_path / "copy").read_text() == text


def test_a_failing_listener_kills_the_process(tmp_path):
    ids = []

    def fail(line: str) -> None:
        ids.append(int(line))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_logged(
            python("import os, time; print(os.getpid(), flush=True); time.sleep(3600)"), tmp_path / "log", on_line=fail
        )
    # killed and waited for, so that the id is free
    with pytest.raises(ProcessLookupError):
        os.kill(ids[0], 0)


def test_a_program_that_does_not_exist_is_named(tmp_path):
    assert last_line(tmp_path / "log") == ""
    with pytest.raises(ValueError, match=r"no-such-program: expected a program that starts, found No such file"):
        run_logged([str(tmp_path / "no-such-program")], tmp_path / "log")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_interruption_is_held_and_the_second_acts_at_once(number: int):
    def interrupted(times: int) -> list[bool]:
        with interruption_held(terminate=True) as interrupted:
            for _ in range(times):
                signal.raise_signal(number)
                held.append(interrupted())
        return held

    held: list[bool] = []
    before = signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    try:
        assert interrupted(0) == []
        for times in (1, 2):
            with pytest.raises(KeyboardInterrupt):
                interrupted(times)
        assert held == [True, True]
    finally:
        signal.signal(number, before)


@pytest.mark.skipif(sys.platform != "linux", reason="xdg-open is of Linux desktops")
def test_a_page_is_opened_by_the_desktop_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opener = tmp_path / "xdg-open"
    opener.write_text(f'#!/bin/sh\necho "$1" > {tmp_path}/part && mv {tmp_path}/part {tmp_path}/opened\n')
    opener.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.delenv("DISPLAY", raising=False)
    assert not open_page(tmp_path / "index.html")
    monkeypatch.setenv("DISPLAY", ":0")
    assert open_page(tmp_path / "index.html")
    while not (tmp_path / "opened").exists():
        time.sleep(0.01)
    assert (tmp_path / "opened").read_text() == f"{tmp_path / 'index.html'}\n"
    opener.unlink()
    monkeypatch.setenv("PATH", str(tmp_path))
    assert not open_page(tmp_path / "index.html")


def test_a_page_is_opened_by_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python has `os.startfile` on Windows alone; here the call is checked, not what it opens."""

    def refuse(page: str) -> None:
        raise OSError("no program for pages")

    opened: list[str] = []
    monkeypatch.setattr(process, "sys", SimpleNamespace(platform="win32"))
    monkeypatch.setattr(process.os, "startfile", opened.append, raising=False)
    assert open_page("index.html")
    assert opened == ["index.html"]
    monkeypatch.setattr(process.os, "startfile", refuse)
    assert not open_page("index.html")


PROGRAM = """
import sys, threading, torch
from splatgraft.runtime.process import end_process

begun = threading.Event()

def compute():
    while True:
        a = torch.rand(300, 300, requires_grad=True)
        torch.linalg.svd((a @ a).detach())
        begun.set()

threading.Thread(target=compute, daemon=True).start()
begun.wait()
sys.stdout.write("the last words")
end_process(3)
"""


def test_a_process_ends_with_its_status_while_a_thread_is_in_torch() -> None:
    ended = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False)
    assert ended.returncode == 3, ended.stderr
    assert ended.stdout == "the last words"
    assert ended.stderr == ""
