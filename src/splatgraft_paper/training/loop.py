"""The training loop, on one or several processes.

Seed and step determine the items of a step, so a state has only weights, optimiser and moving average. A killed run
resumes bit for bit on the same number of processes; that number may also change between runs.

accelerate starts processes, exchanges and clips gradients, and accumulates passes. Three parts do not use it:

- torch's `fully_shard` splits weights, because accelerate ignores FSDP on a CPU, where the loop is tested.
- torch.distributed.checkpoint writes states, because accelerate's contain frozen weights, 24 GB for FLUX with LoRA.
- Threads read items ahead, because a scheduler's SIGTERM kills DataLoader's processes before the state is saved.

    STATES/00001000/job.json                 options and data that must be equal in a resumed run
    STATES/00001000/.metadata, __0_0.distcp  weights, optimiser and moving average, one file per process
"""

import json
import math
import os
import pickle
import shutil
import time
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Literal, Protocol, TextIO, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn
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

from splatgraft.core.images import write_image
from splatgraft.runtime.files import atomic_write
from splatgraft.runtime.process import interruption_held
from splatgraft.runtime.progress import Progress

LOG_FILE = "log.jsonl"
STATES = "states"
_JOB_FILE = "job.json"
_KEPT_STATES = 2  # one is spare, in case a file of the newest is damaged
_BROKEN_STATE = (CheckpointException, OSError, RuntimeError, ValueError, KeyError, EOFError, pickle.UnpicklingError)
_STEPS_AHEAD = 4  # steps whose items are read while the network computes
_SMOOTHING_STEPS = 50  # steps over which the displayed loss is averaged
_STOP, _UNREADABLE = 1, 2  # signals among processes: interrupted, or an item cannot be read


@dataclass(frozen=True)
class LoopOptions:
    """Options of the training loop."""

    steps: int = 50_000
    """Optimiser steps."""
    batch: int = 4
    """Pairs per optimiser step, over all processes."""
    accumulate: int = 1
    """Passes per process and optimiser step; more need less memory."""
    rate: float = 3e-5
    """Learning rate of Adam."""
    warm_up: int = 0
    """Steps over which the rate rises from zero."""
    clip: float = 1.0
    """Maximum norm of the gradient; 0 does not clip."""
    ema: float = 0.0
    """Decay of the moving average of the weights, which is then the result; 0 for none."""
    precision: Literal["no", "bf16"] = "bf16"
    """Arithmetic of the network; the optimiser's weights are float32."""
    parallel: Literal["copies", "shards"] = "copies"
    """Distribution over processes: each has all weights, or a share of weights, gradients and optimiser (FSDP 2)."""
    save_every: int = 1000
    """Steps between saved states; a killed run resumes from the newest."""
    validate_every: int = 1000
    """Steps between validations."""
    validation_pairs: int = 8
    """Pairs per validation."""
    seed: int = 0
    """Seed of the order of pairs, the noise and initial values."""
    readers: int = 4
    """Number of threads per process that read pictures and latents ahead."""
    cpu: bool = False
    """Train on the CPU even if a GPU is available."""

    def check(self, processes: int) -> int:
        """Check the options, and return the number of pairs per process and pass."""
        for name in ("steps", "batch", "accumulate", "save_every", "validate_every", "readers"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name.replace('_', '-')}: expected at least 1, found {getattr(self, name)}")
        if not 0 <= self.ema < 1:
            raise ValueError(f"--ema: expected a decay from 0 to below 1, found {self.ema}")
        passes = processes * self.accumulate
        if self.batch % passes:
            raise ValueError(
                f"--batch: expected a multiple of {passes} ({processes} processes x --accumulate {self.accumulate}), "
                f"found {self.batch}"
            )
        return self.batch // passes


@dataclass(frozen=True)
class Validation:
    """Metrics on validation pairs."""

    metrics: Mapping[str, float]
    sentence: str
    """Metrics in one line of text."""
    sheet: Float[Tensor, "h w 3"]
    """Pictures, one row per pair, sRGB in [0, 1]."""


@runtime_checkable
class Task(Protocol):
    """A network with its items and its loss. Reading and validating raise ValueError for broken files."""

    network: nn.Module
    """Network; requires_grad is off for frozen parameters."""
    fingerprint: Mapping[str, Any]
    """Data and settings besides `LoopOptions` that must be equal in a resumed run; JSON values."""

    def optimizer(self) -> torch.optim.Optimizer:
        """Make the optimiser of the trained parameters."""
        ...

    def rate_at(self, step: int) -> float:
        """Return the learning rate at a step, counted from 0."""
        ...

    def read(self, position: int) -> Any:
        """Read the item at a position of the infinite sequence; called in a thread."""
        ...

    def loss(self, network: Callable[..., Any], items: Sequence[Any]) -> Float[Tensor, ""]:
        """Compute the mean loss of items; `network` is `self.network` with exchange of gradients."""
        ...

    def name(self, position: int) -> str:
        """Return the name of the item at a position, for messages."""
        ...

    def validate(self, network: Callable[..., Any]) -> Validation | None:
        """Measure the network on validation pairs."""
        ...


def join_processes(options: LoopOptions) -> Any:
    """Return accelerate's Accelerator, which connects the processes that a launcher (torchrun or srun) started."""
    from accelerate import Accelerator

    accelerator = Accelerator(cpu=options.cpu, gradient_accumulation_steps=options.accumulate)
    found = accelerator.distributed_type.name
    if found in ("FSDP", "DEEPSPEED", "MEGATRON_LM"):
        raise ValueError(f"accelerate: expected --parallel shards instead of {found}, which is not supported")
    return accelerator


def train(
    task: Task, options: LoopOptions, folder: Path, *, say: Callable[[str], None], progress: Progress
) -> dict[str, Tensor]:
    """Train to the last step, from the folder's newest state if there is one.

    The folder receives states/, validation/ and log.jsonl. After Ctrl-C, a cluster scheduler's SIGTERM or an error, the
    state of the finished steps is saved.

    Returns:
        The trained weights by name, or their moving average, on the CPU; empty in all but the first process.
    """
    with interruption_held(terminate=True) as interrupted:
        loop = _Loop(task, options, folder)
        loop.resume(say)
        first, began, waited, smooth = loop.step, time.monotonic(), 0.0, None
        with loop.log() as log, closing(loop.batches()) as batches:
            while loop.step < options.steps:
                asked = time.monotonic()
                passes = loop.next_passes(batches, interrupted, say)
                waited += time.monotonic() - asked
                try:
                    loss = loop.take_step(passes)
                except torch.OutOfMemoryError as error:
                    raise ValueError(
                        f"training: expected memory for {loop.pairs_per_pass} pairs a pass, found too little at step "
                        f"{loop.step}; the last state is kept; try --accumulate or --lora"
                    ) from error
                smooth = loss if smooth is None else smooth + (loss - smooth) / _SMOOTHING_STEPS
                _log(log, {"step": loop.step, "loss": loss, "rate": task.rate_at(loop.step - 1)})
                spent = max(time.monotonic() - began, 1e-9)
                speed = f"{(loop.step - first) * options.batch / spent:.2f} pairs/s"
                speed += f"; {waited / spent:.0%} of the time spent waiting for pictures"
                if loop.is_first:
                    progress(loop.step, options.steps, f"loss {smooth:.4f}, {speed}")
                last = loop.step == options.steps
                if last or loop.step % options.save_every == 0:
                    loop.save()
                if last or loop.step % options.validate_every == 0:
                    loop.validate(log, say)
            if loop.step > first:
                say(f"throughput: {speed}")
        return loop.result()


def list_states(folder: Path) -> list[Path]:
    """List the complete states of a training's folder, oldest first."""
    return sorted(path for path in (folder / STATES).glob("[0-9]*") if (path / _JOB_FILE).is_file())


@dataclass(frozen=True)
class _Called:
    """A network that computes in the precision of the options."""

    module: Any
    device: torch.device
    half: bool

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.half):
            return self.module(*arguments, **named)


class _Loop:
    """State of a running training."""

    def __init__(self, task: Task, options: LoopOptions, folder: Path) -> None:
        self._task, self._options, self._folder = task, options, folder
        self._processes = join_processes(options)
        self.pairs_per_pass = options.check(self._processes.num_processes)
        self.is_first: bool = self._processes.is_main_process
        self.step = 0
        self._network = task.network.train().to(self._processes.device)
        is_split = options.parallel == "shards" and self._processes.num_processes > 1
        if is_split:
            _shard(self._network, self._processes.device)
        self._trained = {name: p for name, p in self._network.named_parameters() if p.requires_grad}
        module: Any = self._network if is_split else self._processes.prepare_model(self._network)
        self._call = _Called(module, self._device, options.precision == "bf16")
        self._optimizer = task.optimizer()
        self._average = {name: p.detach().float().clone() for name, p in self._trained.items()} if options.ema else {}

    def _positions(self, step: int) -> list[list[int]]:
        """List this process's positions in a step, by pass."""
        size, count, rank = self.pairs_per_pass, self._processes.num_processes, self._processes.process_index
        begins = (step * self._options.batch + (i * count + rank) * size for i in range(self._options.accumulate))
        return [list(range(begin, begin + size)) for begin in begins]

    def batches(self) -> Generator[list[list[Any]]]:
        """Yield the items of this process by step and pass, while threads read the items of the following steps."""
        with ThreadPoolExecutor(self._options.readers) as threads:
            reading: deque[list[list[Any]]] = deque()
            coming = iter(range(self.step, self._options.steps))
            try:
                while True:
                    for step in islice(coming, _STEPS_AHEAD - len(reading)):
                        passes = self._positions(step)
                        reading.append([[threads.submit(self._task.read, at) for at in own] for own in passes])
                    if not reading:
                        return
                    yield [[future.result() for future in own] for own in reading.popleft()]
            finally:
                threads.shutdown(wait=True, cancel_futures=True)

    def next_passes(
        self, batches: Iterator[list[list[Any]]], interrupted: Callable[[], bool], say: Callable[[str], None]
    ) -> list[list[Any]]:
        """Return the items of this step; if one process stops, all do, because the others would wait for it forever."""
        from accelerate.utils import gather_object

        problem, passes = "", []
        try:
            passes = next(batches)
        except ValueError as error:
            problem = str(error)
        signal = torch.tensor([_UNREADABLE if problem else _STOP if interrupted() else 0], device=self._device)
        signal = int(self._processes.gather(signal).max())
        if not signal:
            return passes
        self.save()
        if signal == _UNREADABLE:
            raise ValueError(next(found for found in gather_object([problem]) if found))
        say(f"stopped after step {self.step}{': its state is saved' if self.step else ''}")
        raise KeyboardInterrupt

    def take_step(self, passes: list[list[Any]]) -> float:
        """Train on the items of a step, and return their mean loss over all processes."""
        for group in self._optimizer.param_groups:
            group["lr"] = self._task.rate_at(self.step)
        total = torch.zeros((), device=self._device)
        for items in passes:
            with self._processes.accumulate(self._call.module):
                loss = self._task.loss(self._call, items)
                self._processes.backward(loss)
            total += loss.detach() / len(passes)
        norm = self._processes.clip_grad_norm_(list(self._trained.values()), self._options.clip or float("inf"))
        norm = norm.full_tensor() if hasattr(norm, "full_tensor") else norm  # pyright: ignore
        value = float(self._processes.reduce(total, "mean"))
        if not (math.isfinite(value) and bool(torch.isfinite(norm))):
            self._stop_at_broken_loss(passes)
        self._optimizer.step()
        self._optimizer.zero_grad()
        for name, average in self._average.items():
            average.lerp_(self._trained[name].detach().float(), 1 - self._options.ema)
        self.step += 1
        return value

    @property
    def _device(self) -> torch.device:
        return self._processes.device

    @torch.no_grad()
    def _stop_at_broken_loss(self, passes: list[list[Any]]) -> None:
        """Save the weights of the previous step, and raise an error that names the items without a finite loss."""
        from accelerate.utils import gather_object

        items = [item for own in passes for item in own]
        drawn = zip(items, (at for own in self._positions(self.step) for at in own), strict=True)
        broken = [self._task.name(at) for item, at in drawn if not self._task.loss(self._call, [item]).isfinite()]
        names = ", ".join(dict.fromkeys(gather_object(broken))) or "pairs that are finite one by one"
        self._optimizer.zero_grad()
        self.save()
        raise ValueError(
            f"training: expected a finite loss and gradient at step {self.step + 1}, found others for {names}; "
            f"{self._kept_state()}"
        )

    def _is_finite(self) -> bool:
        parts = (p.to_local() if hasattr(p, "to_local") else p for p in self._trained.values())  # pyright: ignore
        broken = any(not bool(torch.isfinite(part).all()) for part in parts)
        return not bool(self._processes.gather(torch.tensor([int(broken)], device=self._device)).any())

    def validate(self, log: TextIO, say: Callable[[str], None]) -> None:
        """Measure the resulting weights, and log the metrics."""
        try:
            with self._averaged():
                found = self._task.validate(self._call)
        except ValueError:  # a picture that vanished; all processes read the same ones
            self.save()
            raise
        if found is None or not self.is_first:
            return
        say(f"step {self.step}: {found.sentence}")
        _log(log, {"step": self.step, "validation": dict(found.metrics)})
        write_image(self._folder / "validation" / f"{self.step:08d}.png", found.sheet)

    def result(self) -> dict[str, Tensor]:
        """Gather the resulting weights on the CPU of the first process; empty in the others."""
        options = StateDictOptions(full_state_dict=True, cpu_offload=True, ignore_frozen_params=True)
        with self._averaged():
            state: dict[str, Any] = get_model_state_dict(self._network, options=options)
            # one at a time, because FLUX's weights twice are 95 GB
            state = {name: state.pop(name).detach().clone() for name in list(state)}
        self._processes.wait_for_everyone()
        return state if self.is_first else {}

    @contextmanager
    def _averaged(self) -> Generator[None]:
        """Give the network the resulting weights, the moving average if there is one, within the context."""
        self._network.eval()
        self._exchange()
        try:
            yield
        finally:
            self._exchange()
            self._network.train()

    @torch.no_grad()
    def _exchange(self) -> None:
        """Exchange weights and averages one parameter at a time, which needs no third copy of the weights."""
        for name, average in self._average.items():
            current = self._trained[name].detach().clone()
            self._trained[name].copy_(average)
            average.copy_(current)

    @contextmanager
    def log(self) -> Generator[TextIO]:
        """Open the log with the lines of the steps so far; the other processes log to nowhere."""
        if not self.is_first:
            with open(os.devnull, "a", encoding="utf-8") as stream:
                yield stream
            return
        (self._folder / "validation").mkdir(parents=True, exist_ok=True)
        path, remaining = self._folder / LOG_FILE, []
        for line in path.read_text(encoding="utf-8").splitlines() if path.is_file() else []:
            try:
                if json.loads(line)["step"] <= self.step:
                    remaining.append(line)
            except (ValueError, KeyError, TypeError):
                continue  # a killed run may leave an incomplete line
        with atomic_write(path) as whole:
            whole.write("".join(f"{line}\n" for line in remaining).encode())
        with path.open("a", encoding="utf-8") as stream:
            yield stream

    def _job(self) -> dict[str, Any]:
        """Return the options and data that must be equal in a resumed run."""
        names = ("batch", "rate", "warm_up", "clip", "ema", "precision", "seed")
        found = {name: asdict(self._options)[name] for name in names} | dict(self._task.fingerprint)
        return json.loads(json.dumps(found))

    def _state(self) -> dict[str, Any]:
        """Collect the contents of a state; tensors share their memory with the network's."""
        options = StateDictOptions(ignore_frozen_params=True)
        state: dict[str, Any] = {
            "network": get_model_state_dict(self._network, options=options),
            "optimizer": get_optimizer_state_dict(self._network, self._optimizer, options=options),
        }
        return state | ({"average": self._average} if self._average else {})

    def save(self) -> None:
        """Write the state into a partial folder, rename it when it is complete, and remove all but the newest two."""
        if self.step == 0:
            return
        if not self._is_finite():
            problem = f"expected finite weights after step {self.step}, found others"
            raise ValueError(f"training: {problem}; {self._kept_state()}")
        path = self._folder / STATES / f"{self.step:08d}"
        partial = path.with_name(f".{path.name}.partial")
        if self.is_first:
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir(parents=True)
        self._processes.wait_for_everyone()
        with _quiet():
            save(self._state(), checkpoint_id=partial, no_dist=self._processes.num_processes == 1)
        if self.is_first:
            (partial / _JOB_FILE).write_text(json.dumps(self._job()), encoding="utf-8")
            shutil.rmtree(path, ignore_errors=True)
            partial.rename(path)
            for old in list_states(self._folder)[:-_KEPT_STATES]:
                shutil.rmtree(old)
        self._processes.wait_for_everyone()

    def resume(self, say: Callable[[str], None]) -> None:
        """Resume from the newest readable state, which any number of processes may have written."""
        states = list_states(self._folder)
        self._processes.wait_for_everyone()  # no process may change the states before all have listed them
        for path in reversed(states):
            saved, current = json.loads((path / _JOB_FILE).read_text(encoding="utf-8")), self._job()
            if changed := [name for name in current if saved.get(name) != current[name]]:
                raise ValueError(
                    f"{self._folder}: expected the same training to resume, found {changed[0]} "
                    f"{saved.get(changed[0])} instead of {current[changed[0]]}; name another folder"
                )
            state = self._state()
            try:
                with _quiet():
                    load(state, checkpoint_id=path, no_dist=self._processes.num_processes == 1)
            except _BROKEN_STATE as error:
                found = (" ".join(str(error).split()) or type(error).__name__)[-200:]
                say(f"{path}: expected a complete state, found {found}; the previous one is tried")
                continue
            options = StateDictOptions(ignore_frozen_params=True, strict=False)
            set_model_state_dict(self._network, state["network"], options=options)
            set_optimizer_state_dict(self._network, self._optimizer, state["optimizer"], options=options)
            self.step = int(path.name)
            say(f"resumed from step {self.step}")
            return
        if states:
            raise ValueError(f"{self._folder / STATES}: expected a readable state, found none; name another folder")

    def _kept_state(self) -> str:
        states = list_states(self._folder)
        return f"the state of step {int(states[-1].name)} is kept" if states else "no state was saved before"


@contextmanager
def _quiet() -> Generator[None]:
    """Suppress torch's warning that a single process saves or loads."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "torch.distributed is disabled", UserWarning)
        yield


def _log(stream: TextIO, entry: dict[str, Any]) -> None:
    stream.write(json.dumps(entry) + "\n")
    stream.flush()


def _shard(network: nn.Module, device: torch.device) -> None:
    """Split the network's blocks over the processes, each as one unit, and then the rest.

    Weights are gathered in their own precision, so that the arithmetic is that of `copies`. All are split again after
    each pass, so that weights can be exchanged for their averages at any time.
    """
    from torch.distributed.device_mesh import init_device_mesh
    from torch.distributed.fsdp import fully_shard

    mesh = init_device_mesh(device.type, (torch.distributed.get_world_size(),))
    for child in network.children():
        if isinstance(child, nn.ModuleList):
            for block in child:
                fully_shard(block, mesh=mesh, reshard_after_forward=True)
    fully_shard(network, mesh=mesh, reshard_after_forward=True)
