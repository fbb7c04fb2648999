"""Progress without a terminal: every step has a line at its start, per tenth and at its end."""

import re

import pytest

from splatgraft.runtime import console
from splatgraft.runtime.console import Console


def test_without_a_terminal_there_is_a_line_per_step_and_per_tenth(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console, "_LINE_SECONDS", 0.0)
    with Console().bar("source/reconstruct") as progress:
        assert "source/reconstruct   begins" in capsys.readouterr().err  # not only at the end
        for done in range(1, 301):
            progress(done, 300, "loss 0.1")
    lines = capsys.readouterr().err.splitlines()
    assert [line.split("%")[0].split()[-1] for line in lines[:-1]] == [str(10 * k) for k in range(1, 11)]
    assert lines[2].endswith("30%  90/300 loss 0.1")
    assert re.fullmatch(r"source/reconstruct   done in \d+\.\d s", lines[-1])


def test_a_step_that_counts_twice_shows_both_counts(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console, "_LINE_SECONDS", 0.0)
    with Console().bar("capture") as progress:
        for done in (1, 2):
            progress(done, 2, "reading")
        for done in (1, 2, 3):
            progress(done, 3, "writing")
    lines = capsys.readouterr().err.splitlines()
    assert len([line for line in lines if "reading" in line]) == 2
    assert len([line for line in lines if "writing" in line]) == 3


def test_quick_steps_say_little_and_a_failed_one_is_not_said_to_be_done(capsys: pytest.CaptureFixture[str]) -> None:
    with Console().bar("harmonize") as progress:
        for done in range(1, 101):
            progress(done, 100, "view")
    assert len(capsys.readouterr().err.splitlines()) < 12
    with pytest.raises(ValueError, match="broken"), Console().bar("compose"):
        raise ValueError("broken")
    assert "done" not in capsys.readouterr().err
