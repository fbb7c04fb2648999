"""A page is opened where there is a desktop, and nowhere else."""

import sys
import time
from pathlib import Path

import pytest

from splatgraft.runtime.process import open_page


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
