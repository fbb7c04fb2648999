"""Several real processes (torchrun, gloo, CPU) train as one, sharded or not; any number of them resumes a state."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

pytest.importorskip("diffusers")

from safetensors.torch import load_file
from tiny_models import flux_folder, quiet
from tiny_pairs import relit_folder
from tiny_training import read_losses

from splatgraft_paper.training.loop import LOG_FILE, list_states

pytestmark = [*quiet, pytest.mark.long, pytest.mark.filterwarnings("ignore::UserWarning")]
PROGRAM = Path(__file__).with_name("tiny_training.py")
MODEL = "model/transformer/diffusion_pytorch_model.safetensors"
LAUNCH = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node"]


def environment():
    return {**os.environ, "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive"}


def run(folder, processes, *runs):
    start = [sys.executable] if processes == 1 else [*LAUNCH, str(processes)]
    words = [*start, str(PROGRAM), str(folder), json.dumps(runs)]
    done = subprocess.run(words, capture_output=True, text=True, check=False, env=environment())
    assert done.returncode == 0, done.stderr[-3000:]


def seen(folder, name, processes):
    """Return what each process recorded, and check their number and that they exchanged gradients."""
    found = [json.loads((folder / name / f"process_{rank}.json").read_text()) for rank in range(processes)]
    assert [one["processes"] for one in found] == [processes] * processes
    assert {one["backend"] for one in found} == ({"gloo"} if processes > 1 else {None})
    return found


def losses(folder, name):
    return torch.tensor(read_losses(folder / name / LOG_FILE))


def assert_near(folder, one, other):
    # the same pairs and noise, sums in another order: float32 rounds at 6e-8, and Adam's division by the root of small
    # second moments enlarges it, up to a share of a step of 1e-3
    assert torch.allclose(losses(folder, one), losses(folder, other), rtol=1e-4)
    first, second = load_file(folder / one / MODEL), load_file(folder / other / MODEL)
    assert set(first) == set(second)
    assert max(float((first[name] - second[name]).abs().max()) for name in first) < 1e-4


WHOLE = {"loop": {"ema": 0.9, "batch": 6}}
SPLIT = {"loop": {**WHOLE["loop"], "parallel": "shards"}}
LORA = {"lora": 2, "loop": {"precision": "bf16"}}


def until(step):
    return {"loop": {**SPLIT["loop"], "steps": step}}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Run trainings in one, two and three processes; loading the libraries takes most of their time."""
    folder = tmp_path_factory.mktemp("processes")
    for inside in ("", "vanishing"):
        flux_folder(folder / inside / "base")
        relit_folder(folder / inside / "pairs", 2)
    run(folder, 1, ["one", WHOLE], ["lora one", LORA])
    lora = {**LORA, "loop": {**LORA["loop"], "parallel": "shards"}}
    vanishing = {"inside": "vanishing", "remove": "*/relit_1.png", "loop": {"save_every": 99}}
    trainings = [["split", SPLIT], ["copies", WHOLE], ["lora split", lora], ["changing", until(2)]]
    run(folder, 2, *trainings, ["out", vanishing])
    run(folder, 3, ["changing", until(4)])
    run(folder, 1, ["changing", until(6)])
    return folder


def test_the_variables_of_a_scheduler_start_the_processes_without_torchrun(folder):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    place = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    words = [sys.executable, str(PROGRAM), str(folder), json.dumps([["scheduled", WHOLE]])]
    started = [
        subprocess.Popen(words, env={**environment(), **place, "RANK": rank, "LOCAL_RANK": rank}) for rank in "01"
    ]
    assert [process.wait(timeout=600) for process in started] == [0, 0]
    seen(folder, "scheduled", 2)
    assert_near(folder, "one", "scheduled")


def test_split_over_two_processes_the_average_that_was_measured_is_saved(folder):
    assert all(one["split"] for one in seen(folder, "split", 2))
    saved, measured = load_file(folder / "split" / MODEL), load_file(folder / "split" / "measured.safetensors")
    assert set(saved) == set(measured)
    assert all(torch.equal(saved[name], measured[name]) for name in saved)
    assert_near(folder, "one", "split")


def test_copies_in_two_processes_train_as_one(folder):
    assert not any(one["split"] for one in seen(folder, "copies", 2))
    assert_near(folder, "one", "copies")


def test_a_state_of_two_processes_goes_on_in_three_and_then_in_one(folder):
    states = [len(list(path.glob("*.distcp"))) for path in list_states(folder / "changing")]
    assert states == [3, 1]
    assert_near(folder, "one", "changing")


def test_a_low_rank_adaptation_of_frozen_halves_is_split(folder):
    assert all(one["split"] for one in seen(folder, "lora split", 2))
    # bf16 has 8 bits
    assert torch.allclose(losses(folder, "lora one"), losses(folder, "lora split"), rtol=0.02)
    one, split = (load_file(folder / name / "model/lora.safetensors") for name in ("lora one", "lora split"))
    assert set(one) == set(split)
    assert {tensor.dtype for tensor in split.values()} == {torch.float32}


def test_a_picture_that_vanished_ends_all_processes_with_the_same_line(folder):
    found = seen(folder / "vanishing", "out", 2)
    assert {one["problem"] for one in found} == {found[0]["problem"]}
    assert "relit_1.png: expected a picture of a pair, found No such file or directory" in found[0]["problem"]
    assert list_states(folder / "vanishing" / "out")


@pytest.mark.parametrize("processes", [1, 2])
def test_sigterm_saves_the_state_and_the_same_command_goes_on(folder, processes):
    """End a process like SLURM ends a preempted job."""
    out = folder / f"ended{processes}"
    words = ["paper", "train", "flux", str(out), "--base", str(folder / "base"), "--generated", str(folder / "pairs")]
    words += ["--size", "32x32", "--batch", "2", "--precision", "no", "--cpu", "--save-every", "100000"]
    words += ["--validate-every", "100000", "--steps"]
    start = [sys.executable, "-m", "splatgraft"] if processes == 1 else [*LAUNCH, str(processes), "-m", "splatgraft"]
    with subprocess.Popen(
        [*start, *words, "100000"], stderr=subprocess.PIPE, text=True, env=environment(), start_new_session=True
    ) as training:
        while (training.poll() is None and not (out / LOG_FILE).is_file()) or (out / LOG_FILE).stat().st_size < 300:
            time.sleep(0.1)
        training.send_signal(signal.SIGTERM)
        printed = training.communicate()[1]
    (state,) = list_states(out)
    reached = int(state.name)
    assert f"stopped after step {reached}: its state is saved" in printed
    if processes == 1:
        assert training.returncode == 130
        assert "Traceback" not in printed
    assert len(read_losses(out / LOG_FILE)) == reached
    again = subprocess.run(
        [*start, *words, str(reached + 1)], capture_output=True, text=True, env=environment(), check=False
    )
    assert again.returncode == 0, again.stderr[-2000:]
    assert f"resumed from step {reached}" in again.stderr
    assert len(read_losses(out / LOG_FILE)) == reached + 1
