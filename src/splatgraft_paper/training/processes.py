"""The processes of one training: this one's number and device, and the few messages that they exchange.

A launcher (torchrun, `accelerate launch --multi_gpu`, SLURM's srun with the same variables) starts them and sets RANK,
WORLD_SIZE, LOCAL_RANK, MASTER_ADDR and MASTER_PORT. GPUs talk through NCCL, CPUs through gloo.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

_OTHER_LAUNCHERS = {
    "ACCELERATE_USE_FSDP": "--parallel shards instead of accelerate's FSDP settings",
    "ACCELERATE_USE_DEEPSPEED": "--parallel shards instead of DeepSpeed, which is not supported",
}


@dataclass(frozen=True)
class Processes:
    """This process among those that train together."""

    rank: int
    """Number of this process, from 0."""
    count: int
    """Number of processes."""
    device: torch.device
    """Where this process computes."""

    @staticmethod
    def join(*, cpu: bool) -> "Processes":
        """Meet the other processes that the launcher started; a process without a launcher is alone.

        Args:
            cpu: compute on the CPU although there is a GPU.

        Raises:
            ValueError: the launcher asks for another way to split the weights.
        """
        return Processes.from_environment(os.environ, cpu=cpu)

    @staticmethod
    def from_environment(environment: Mapping[str, str], *, cpu: bool) -> "Processes":
        """The same from the variables of a launcher, see `join`."""
        for name, instead in _OTHER_LAUNCHERS.items():
            if environment.get(name, "").lower() in ("1", "true"):
                raise ValueError(f"{name}: expected {instead}, found {environment[name]}")
        count = int(environment.get("WORLD_SIZE", "1"))
        use_gpu = torch.cuda.is_available() and not cpu
        device = torch.device("cuda", int(environment.get("LOCAL_RANK", "0"))) if use_gpu else torch.device("cpu")
        if use_gpu:
            torch.cuda.set_device(device)
        if count == 1:
            return Processes(0, 1, device)
        if not dist.is_initialized():
            # gloo beside NCCL: states are saved from the CPU
            dist.init_process_group("cpu:gloo,cuda:nccl" if use_gpu else "gloo")
        return Processes(dist.get_rank(), dist.get_world_size(), device)

    @property
    def is_first(self) -> bool:
        """Whether this is the process that writes files and messages."""
        return self.rank == 0

    def mean(self, value: Tensor) -> Tensor:
        """The mean of a tensor over all processes."""
        if self.count == 1:
            return value
        total = value.clone()
        dist.all_reduce(total)
        return total / self.count

    def largest(self, value: int) -> int:
        """The largest of a number over all processes."""
        if self.count == 1:
            return value
        found = torch.tensor(value, device=self.device)
        dist.all_reduce(found, dist.ReduceOp.MAX)
        return int(found)

    def gather(self, value: Any) -> list[Any]:
        """The values of all processes, by rank; any object that pickle takes."""
        if self.count == 1:
            return [value]
        found: list[Any] = [None] * self.count
        dist.all_gather_object(found, value)
        return found

    def wait(self) -> None:
        """Wait until all processes are here."""
        if self.count > 1:
            dist.barrier()
