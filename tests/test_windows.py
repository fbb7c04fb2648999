"""A tiny project, from photographs to the report, on a Linux without what Windows lacks. A real Windows is unproven."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from tiny_project import write_project

AS_WINDOWS = '''
"""Runs at the start of each Python: removes what Windows lacks, and refuses what Windows refuses."""

import contextlib, os, shutil, signal, sys, tempfile, warnings

for name in ("resource", "fcntl", "pwd", "grp", "termios", "tty", "pty", "syslog", "readline"):
    sys.modules[name] = None  # import raises ModuleNotFoundError
for name in ("fork", "forkpty", "killpg", "getpgid", "setsid", "getuid", "geteuid", "getgid", "sysconf",
             "sched_getaffinity", "getloadavg", "wait3", "mkfifo", "chown", "fchmod", "O_DIRECTORY", "O_NOFOLLOW"):
    delattr(os, name)
for name in ("SIGKILL", "SIGHUP", "SIGUSR1", "SIGALRM", "SIGCHLD", "SIGPIPE", "setitimer", "pthread_kill"):
    delattr(signal, name)
shutil._use_fd_functions = False
tempfile.TemporaryFile = tempfile.NamedTemporaryFile
# text without a named encoding would be read and written in the one of the country
warnings.filterwarnings("ignore", category=EncodingWarning)
warnings.filterwarnings("error", category=EncodingWarning, module="splatgraft")

rename = os.rename


def rename_to_new(source, target, **options):
    if os.path.isfile(target):
        raise FileExistsError(17, "Cannot create a file when that file already exists", str(target))
    rename(source, target, **options)


def in_use(path):
    """Return whether this process has a file open or mapped that is `path` or lies below it."""
    opened = []
    for number in os.listdir("/proc/self/fd"):
        with contextlib.suppress(FileNotFoundError):  # closed by another thread
            opened.append(os.readlink(f"/proc/self/fd/{number}"))
    with open("/proc/self/maps", encoding="utf-8") as maps:
        opened += [line[line.index("/"):].rstrip() for line in maps if "/" in line]
    path = os.path.realpath(path)
    return any(name == path or name.startswith(path + os.sep) for name in opened)


def refuse(event, arguments):
    # os.open gives no mode; open() refuses folders on every system, but tempfile names one to it
    if event == "open" and arguments[1] is None and os.path.isdir(arguments[0]):
        raise PermissionError(13, "Permission denied", str(arguments[0]))
    if event in ("os.rename", "os.remove", "os.rmdir"):
        for path in arguments[: 2 if event == "os.rename" else 1]:
            if in_use(path):
                raise PermissionError(13, "The file is being used by another process", str(path))


os.rename = rename_to_new
sys.addaudithook(refuse)
'''

RUN = """
import json, os, sys
assert not hasattr(os, "fork") and os.rename.__name__ == "rename_to_new"
from splatgraft.cli import main
sys.exit(max(main(words) for words in json.loads(sys.argv[1])))
"""


@pytest.mark.long
def test_a_project_is_done_without_what_windows_lacks(tmp_path: Path) -> None:
    (tmp_path / "start").mkdir()
    (tmp_path / "start" / "sitecustomize.py").write_text(AS_WINDOWS)
    root = tmp_path / "Möbel 猫"
    root.mkdir()
    project, photos = write_project(root), root / "photos" / "source"
    # one step more than once: a result is replaced, not only made
    again = ["run", str(project), "--force", "segment", "--to", "segment"]
    light = ["light", str(project), "--height", "16", "--out", str(root / "light.hdr")]
    page = ["export", str(project), "--to", str(root / "page.html")]
    path = os.pathsep.join([str(tmp_path / "start"), *filter(None, [os.environ.get("PYTHONPATH")])])
    # the encoding of a pipe on a western Windows
    given = os.environ | {"PYTHONPATH": path, "PYTHONWARNDEFAULTENCODING": "1", "PYTHONIOENCODING": "cp1252"}
    words = json.dumps([["check", str(photos)], ["run", str(project)], again, light, page, ["doctor"]])
    done = subprocess.run([sys.executable, "-c", RUN, words], capture_output=True, env=given, check=False)
    said = done.stderr.decode("cp1252", errors="replace")
    assert done.returncode == 0, said
    for made in ("project/report/index.html", "light.hdr", "light.json", "page.html"):
        assert (root / made).is_file(), made
    # a letter that the pipe's encoding lacks is written as its number
    assert "M\xf6bel \\u732b" in done.stdout.decode("cp1252")
