"""A network in training: copied or split over the processes, in 16 or 32 bits, with its optimiser.

`copies`: every process holds all weights, and gradients are averaged (DistributedDataParallel). `shards`: weights,
gradients and the optimiser's moments are split over the processes, and a block's weights are gathered while it computes
(fully_shard, "FSDP 2"; Zhao et al. 2023).
"""

from collections.abc import Generator, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import torch
import torch.distributed as dist
from jaxtyping import Float
from torch import Tensor, nn

from splatgraft_paper.training.loop_options import LoopOptions
from splatgraft_paper.training.moving_average import MovingAverage
from splatgraft_paper.training.optimizers import make_optimizer
from splatgraft_paper.training.processes import Processes

_HALF = {"bf16": torch.bfloat16, "fp16": torch.float16}


class TrainedNetwork:
    """A network with its optimiser and, where wanted, the moving average of its weights."""

    def __init__(self, network: Any, loop: LoopOptions, processes: Processes) -> None:
        """Put a network onto the device and spread it over the processes.

        Args:
            network: a torch module; parameters without requires_grad stay as they are.
            loop: the options.
            processes: that train together.

        Raises:
            ValueError: an optimiser is not installed.
        """
        self.network: nn.Module = network.train().to(processes.device)
        self._loop, self._processes = loop, processes
        self.module: nn.Module = self.network
        """The network as it is called: with what exchanges its gradients."""
        if loop.parallel == "shards" and processes.count > 1:
            _shard(self.network, processes)
        elif processes.count > 1:
            where = [processes.device.index] if processes.device.type == "cuda" else None
            self.module = nn.parallel.DistributedDataParallel(self.network, device_ids=where)
        self.optimizer = make_optimizer(loop.optimizer, self.trained, loop.rate)
        self.average = MovingAverage(self.network, loop.ema) if loop.ema else None
        self.scaler = torch.amp.GradScaler(processes.device.type, enabled=loop.precision == "fp16")

    @property
    def trained(self) -> list[nn.Parameter]:
        """The parameters that are trained."""
        return [p for p in self.network.parameters() if p.requires_grad]

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """Call the network in the arithmetic of the options."""
        with self._arithmetic():
            return self.module(*arguments, **named)

    def backward(self, loss: Float[Tensor, ""], *, last: bool) -> None:
        """Add the gradient of a pass; processes exchange it in the last pass of a step."""
        with self._exchange(last):
            self.scaler.scale(loss / self._loop.accumulate).backward()

    def step(self, rate: float) -> bool:
        """Take the optimiser's step at a learning rate.

        Returns:
            Whether the gradient was finite; if not, the weights stay as they are.
        """
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.scaler.unscale_(self.optimizer)
        norm = torch.nn.utils.clip_grad_norm_(self.trained, self._loop.clip or float("inf"))
        finite = bool(torch.isfinite(_whole(norm)))
        # in fp16 an infinite gradient is usual at first: the scaler leaves the step out and lowers its factor
        if finite or self.scaler.is_enabled():
            self.scaler.step(self.optimizer)
            self.scaler.update()
            if self.average and finite:
                self.average.update()
        self.optimizer.zero_grad()
        return finite or self.scaler.is_enabled()

    @contextmanager
    def averaged(self) -> Generator[None]:
        """Within the context, the network has the resulting weights: the moving average where there is one."""
        self.network.eval()
        try:
            with self.average.applied() if self.average else nullcontext():
                yield
        finally:
            self.network.train()

    def _arithmetic(self) -> Any:
        """The context of the options' precision."""
        if self._loop.precision == "no":
            return nullcontext()
        return torch.autocast(self._processes.device.type, _HALF[self._loop.precision])

    def is_finite(self) -> bool:
        """Whether all trained weights are finite, on all processes."""
        broken = any(not bool(torch.isfinite(part).all()) for part in self._parts())
        return not self._processes.largest(int(broken))

    def _parts(self) -> Iterator[Tensor]:
        for parameter in self.trained:
            yield parameter.to_local() if hasattr(parameter, "to_local") else parameter  # pyright: ignore

    @contextmanager
    def _exchange(self, last: bool) -> Generator[None]:
        if isinstance(self.module, nn.parallel.DistributedDataParallel):
            with nullcontext() if last else self.module.no_sync():
                yield
            return
        if hasattr(self.module, "set_requires_gradient_sync"):
            self.module.set_requires_gradient_sync(last)  # pyright: ignore
        yield


def _shard(network: nn.Module, processes: Processes) -> None:
    """Split the network's blocks, each as one unit, and then the rest.

    Weights are gathered in their own precision, so that the arithmetic is that of `copies`.
    """
    from torch.distributed.device_mesh import init_device_mesh
    from torch.distributed.fsdp import fully_shard

    mesh = init_device_mesh(processes.device.type, (dist.get_world_size(),))
    for child in network.children():
        if isinstance(child, nn.ModuleList):
            for block in child:
                fully_shard(block, mesh=mesh, reshard_after_forward=True)
    # also the rest is split again after each pass: weights can then be exchanged for their averages at any time
    fully_shard(network, mesh=mesh, reshard_after_forward=True)


def _whole(value: Tensor) -> Tensor:
    return value.full_tensor() if hasattr(value, "full_tensor") else value  # pyright: ignore
