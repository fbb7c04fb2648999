"""Every part of benchmarks/gpu.py runs at toy size on the CPU, and a finished part is not run again."""

import json
import subprocess
import sys

import gpu
import pytest
import torch

QUICK = ("lora",)
TOY = gpu.Setting(torch.device("cpu"), toy=True)


@pytest.mark.parametrize(
    "name", [pytest.param(part, marks=pytest.mark.long if part not in QUICK else ()) for part in gpu.PARTS]
)
def test_every_part_runs_at_toy_size(name, tmp_path):
    if name.startswith("harmonize") or name == "lora":
        pytest.importorskip("diffusers")
    gpu.run_part(name, TOY, tmp_path)
    record = json.loads((tmp_path / f"{name}.json").read_text())
    assert record["rows"]
    assert all(value == value for row in record["rows"] for value in row.values())  # noqa: PLR0124 - no nan
    if name == "paper-size":
        # the ball's shadow has an edge, and relight splits the Gaussians across it
        assert record["rows"][0]["gaussians_relit"] > record["rows"][0]["gaussians"] == 600
    assert gpu.is_finished(tmp_path / f"{name}.json", toy=True)
    assert not gpu.is_finished(tmp_path / f"{name}.json", toy=False)


@pytest.mark.long
def test_finished_parts_are_kept_failures_are_said_and_all_is_in_one_table(tmp_path):
    done = {"part": "renderer", "toy": True, "seconds": 1.0, "rows": [{"gaussians": 300, "forward_ms": 1.25}]}
    (tmp_path / "renderer.json").write_text(json.dumps(done))
    command = [sys.executable, gpu.__file__, "--toy", "--out", str(tmp_path), "--parts", "renderer", "lora"]
    # a part that cannot finish in a hundredth of a second
    found = subprocess.run([*command, "--limit", "0.01"], capture_output=True, text=True, check=False)
    assert found.returncode == 1
    assert "renderer: finished earlier" in found.stdout
    assert "lora: stopped after 0 s" in found.stdout
    record = json.loads((tmp_path / "gpu.json").read_text())
    assert record["card"] == "cpu, toy size"
    assert record["parts"] == [done]
    assert "lora" in record["failures"]
    text = (tmp_path / "gpu.md").read_text()
    assert "| gaussians | forward_ms |" in text
    assert "| 300 | 1.25 |" in text
