"""`splatgraft reconstruct` interrupted and killed at random moments ends with the scene of an uninterrupted run."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from tiny_project import ball, photograph, plane

ITERATIONS = 5000
"""Lines of progress come once a second at most: with fewer steps a run could end before its first line."""


def start(capture: Path, out: Path) -> subprocess.Popen[str]:
    words = ["reconstruct", str(capture), "--out", str(out), "--iterations", str(ITERATIONS), "--budget", "400"]
    source = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2] / "src")}
    words = [sys.executable, "-m", "splatgraft", *words, "--sh-degree", "1"]
    return subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=source)


def steps_saved(out: Path) -> int:
    path = out.with_name(f".{out.name}.checkpoint") / "state.pt"
    return torch.load(path, weights_only=True)["iteration"] if path.is_file() else 0


def at_work(run: subprocess.Popen[str], lines: list[str]) -> None:
    """Wait until the first steps of the fit are reported."""
    assert run.stderr is not None
    for line in run.stderr:
        lines.append(line)
        if "Gaussians" in line:
            return


@pytest.mark.long
def test_stopped_at_random_times_the_scene_is_that_of_one_run(tmp_path: Path) -> None:
    photograph(tmp_path / "photos", plane((0.3, 0.5, 0.3)), ball())
    whole = start(tmp_path / "photos", tmp_path / "whole")
    assert whole.communicate()[1]
    assert whole.returncode == 0
    generator, out = random.Random(0), tmp_path / "cut"
    saved, stops, lines = 0, 0, []
    for number in (signal.SIGINT, signal.SIGKILL, signal.SIGINT, signal.SIGTERM, signal.SIGINT):
        run = start(tmp_path / "photos", out)
        at_work(run, lines)
        time.sleep(generator.uniform(0.0, 0.3))
        run.send_signal(number)
        rest = run.communicate()[1]
        if run.returncode == 0:
            break
        stops += 1
        if number == signal.SIGINT:
            assert run.returncode == 130
            assert "the same command continues from here" in rest
            # what was done before Ctrl-C is not done again
            assert steps_saved(out) > saved
        assert steps_saved(out) >= saved
        saved = steps_saved(out)
        assert not (out / "scene.ply").exists()
    assert stops >= 2
    assert start(tmp_path / "photos", out).communicate()
    assert (out / "scene.ply").read_bytes() == (tmp_path / "whole" / "scene.ply").read_bytes()
