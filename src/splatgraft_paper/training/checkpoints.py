"""States of a training on disk, from which any number of processes goes on (torch.distributed.checkpoint).

    STATES/00001000/job.json                 what is trained: options and data that must stay equal
    STATES/00001000/.metadata, __0_0.distcp  weights, optimiser and moving average, one file per process

A state is written into a partial folder and renamed, so that a folder with a number is whole. Frozen weights are not
saved; they are the base model's.
"""

import json
import pickle
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor
from torch.distributed.checkpoint.api import CheckpointException
from torch.distributed.checkpoint.state_dict import (
    StateDictOptions,
    get_model_state_dict,
    get_optimizer_state_dict,
    set_model_state_dict,
    set_optimizer_state_dict,
)
from torch.distributed.checkpoint.state_dict_loader import load
from torch.distributed.checkpoint.state_dict_saver import save

from splatgraft.runtime.atomic_file import atomic_write
from splatgraft_paper.training.processes import Processes
from splatgraft_paper.training.trained_network import TrainedNetwork

STATES = "states"
_JOB_FILE = "job.json"
_KEPT = 2
"""States that are kept; one more than needed, so that a damaged file does not end a training."""
_BROKEN = (CheckpointException, OSError, RuntimeError, ValueError, KeyError, EOFError, pickle.UnpicklingError)


def list_states(folder: Path) -> list[Path]:
    """Whole states of a training's folder, oldest first."""
    return sorted(path for path in (folder / STATES).glob("[0-9]*") if (path / _JOB_FILE).is_file())


def save_state(folder: Path, step: int, network: TrainedNetwork, job: Mapping[str, Any], processes: Processes) -> None:
    """Write the state after `step` steps and remove all but the newest two.

    Args:
        folder: of the training; all processes must see it.
        step: number of finished steps.
        network: what is saved.
        job: options and data, see `read_job`.
        processes: all of which call this.
    """
    path = folder / STATES / f"{step:08d}"
    partial = path.with_name(f".{path.name}.partial")
    if processes.is_first:
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
    processes.wait()
    save(_state(network), checkpoint_id=partial, no_dist=processes.count == 1)
    if processes.is_first:
        with atomic_write(partial / _JOB_FILE) as stream:
            stream.write(json.dumps(job).encode())
        shutil.rmtree(path, ignore_errors=True)
        partial.rename(path)
        for old in list_states(folder)[:-_KEPT]:
            shutil.rmtree(old)
    processes.wait()


def load_state(path: Path, network: TrainedNetwork, processes: Processes) -> str | None:
    """Read a state into a network, whatever the number of processes that wrote it.

    Returns:
        None, or in one line why the state cannot be read; the network's weights are then undefined.
    """
    state = _state(network)
    try:
        load(state, checkpoint_id=path, no_dist=processes.count == 1)
    except _BROKEN as error:
        found = " ".join(str(error).split()) or type(error).__name__
        return found[-200:]
    options = StateDictOptions(ignore_frozen_params=True, strict=False)
    set_model_state_dict(network.network, state["network"], options=options)
    set_optimizer_state_dict(network.network, network.optimizer, state["optimizer"], options=options)
    if network.scaler.is_enabled():
        network.scaler.load_state_dict(state["scaler"])
    return None


def read_job(path: Path) -> dict[str, Any]:
    """Read what a state was trained on.

    Raises:
        ValueError: the file is missing or broken.
    """
    file = path / _JOB_FILE
    try:
        return json.loads(file.read_text())
    except (OSError, ValueError) as error:
        raise ValueError(f"{file}: expected the description of a training, found {error}") from error


def whole_weights(network: TrainedNetwork) -> dict[str, Tensor]:
    """The trained weights with all their parts, on the CPU; only the first of several processes gets them."""
    options = StateDictOptions(full_state_dict=True, cpu_offload=True, ignore_frozen_params=True)
    state: dict[str, Any] = get_model_state_dict(network.network, options=options)
    return {name: tensor.detach().clone() for name, tensor in state.items()}


def _state(network: TrainedNetwork) -> dict[str, Any]:
    """What a state holds; tensors share their memory with the network's."""
    options = StateDictOptions(ignore_frozen_params=True)
    state: dict[str, Any] = {
        "network": get_model_state_dict(network.network, options=options),
        "optimizer": get_optimizer_state_dict(network.network, network.optimizer, options=options),
    }
    if network.average:
        state["average"] = network.average.state_dict()
    if network.scaler.is_enabled():
        state["scaler"] = network.scaler.state_dict()
    return state
