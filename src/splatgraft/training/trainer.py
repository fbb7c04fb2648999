"""The training loop, on one process or several through accelerate; a killed run resumes bit for bit.

The pairs of a step and their noise follow from the seed and the step alone. A saved state therefore holds only weights,
optimiser and moving average, and the number of processes may change between runs.
"""

import json
import shutil
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from splatgraft.runtime.atomic_file import atomic_write
from splatgraft.runtime.progress import Progress
from splatgraft.training.latent_cache import LatentCache, LoadedPair
from splatgraft.training.loop_options import LoopOptions
from splatgraft.training.moving_average import MovingAverage
from splatgraft.training.objective import Objective
from splatgraft.training.optimizers import make_optimizer
from splatgraft.training.sources.pair_source import Mixture, sample_seed
from splatgraft.training.training_log import LOG_FILE, TrainingLog, truncate_log
from splatgraft.training.validation import ValidationRun, validate

MODEL_FOLDER = "model"
_STATES = "states"
_JOB_FILE = "job.json"
_KEPT_STATES = 2
_READERS = 4


@dataclass(frozen=True)
class TrainingRun:
    """Everything that one run needs."""

    objective: Objective
    mixture: Mixture
    held_out: Mixture | None
    """Pairs for validation; None where no scene is held out."""
    cache: LatentCache
    loop: LoopOptions
    folder: Path
    """Receives states/, model/, validation/ and log.jsonl."""
    say: Callable[[str], None]
    progress: Progress

    def fingerprint(self) -> dict[str, Any]:
        """Options and data that must be equal for a state to be resumed."""
        names = ("batch", "rate", "warm_up", "clip", "ema", "optimizer", "precision", "seed")
        sources = zip(self.mixture.sources, self.mixture.indices, strict=True)
        data = [[source.name, len(indices)] for source, indices in sources]
        return {name: getattr(self.loop, name) for name in names} | {"data": data}


def train(run: TrainingRun) -> Path:
    """Train to the last step, resuming from the folder's last state.

    Returns:
        The folder of the model.

    Raises:
        ValueError: the loss is not finite, memory does not suffice, or the folder's state is of another training.
    """
    with ThreadPoolExecutor(_READERS) as readers:
        loop = _RunningLoop(run, readers)
        try:
            return loop.run()
        except torch.OutOfMemoryError as error:
            raise ValueError(
                f"training: expected memory for {loop.pairs_per_pass} pairs a pass, found too little at step "
                f"{loop.step}; the last state is kept: try --accumulate, --optimizer adam8bit or --lora"
            ) from error


class _RunningLoop:
    """The state of a running training."""

    def __init__(self, run: TrainingRun, readers: ThreadPoolExecutor) -> None:
        from accelerate import Accelerator

        self._run, self._readers, loop = run, readers, run.loop
        self._accelerator = Accelerator(
            mixed_precision=loop.precision, gradient_accumulation_steps=loop.accumulate, cpu=loop.cpu
        )
        self.pairs_per_pass = loop.check(self._accelerator.num_processes)
        self.step = 0
        self._sharded = str(self._accelerator.distributed_type).endswith(("FSDP", "DEEPSPEED"))
        if self._sharded and loop.ema:
            raise ValueError("--ema: expected 0 with FSDP or DeepSpeed, whose parts cannot be averaged here")
        if (plugin := getattr(self._accelerator.state, "deepspeed_plugin", None)) is not None:
            plugin.deepspeed_config["train_micro_batch_size_per_gpu"] = self.pairs_per_pass
        network = run.objective.network.train()
        self._trained = {name for name, p in network.named_parameters() if p.requires_grad}
        optimizer = make_optimizer(loop.optimizer, [p for p in network.parameters() if p.requires_grad], loop.rate)
        run.objective.to(self._accelerator.device)
        self._average = MovingAverage(network, loop.ema) if loop.ema else None
        self._network, self._optimizer = self._accelerator.prepare(network, optimizer)
        if self._average:
            self._accelerator.register_for_checkpointing(self._average)
        if len(self._trained) < len(list(network.named_parameters())) and not self._sharded:
            self._accelerator.register_save_state_pre_hook(self._save_trained_parameters)
            self._accelerator.register_load_state_pre_hook(self._load_trained_parameters)

    def run(self) -> Path:
        """Run all remaining steps and write the model."""
        run, loop = self._run, self._run.loop
        self._resume()
        log = TrainingLog(run.folder, loop.tensorboard) if self._accelerator.is_main_process else None
        next_batches = self._begin_reading(self.step)
        began, first = time.monotonic(), self.step
        for step in range(self.step, loop.steps):
            self.step = step
            batches = next_batches
            next_batches = self._begin_reading(step + 1) if step + 1 < loop.steps else []
            loss = self._train_step(step, [[future.result() for future in batch] for batch in batches])
            self.step = step + 1
            if log:
                log.add(self.step, loss, loop.rate_at(step))
                speed = (self.step - first) * loop.batch / max(time.monotonic() - began, 1e-9)
                run.progress(self.step, loop.steps, f"loss {log.smooth:.4f}, {speed:.2f} pairs/s")
            if self.step % loop.save_every == 0 or self.step == loop.steps:
                self._save()
            if self.step % loop.validate_every == 0 or self.step == loop.steps:
                self._validate(log)
        if log:
            log.close()
        return self._finish()

    def _train_step(self, step: int, batches: list[list[LoadedPair]]) -> float:
        run, loop, accelerator = self._run, self._run.loop, self._accelerator
        total = torch.zeros((), device=accelerator.device)
        for group in self._optimizer.param_groups:
            group["lr"] = loop.rate_at(step)
        for number, loaded in enumerate(batches):
            latents = run.cache.encode_missing(loaded, run.objective.roles)
            latents = {role: tensor.to(accelerator.device) for role, tensor in latents.items()}
            seeds = [sample_seed(loop.seed, position) for position in self._positions(step, number)]
            with accelerator.accumulate(self._network):
                loss = run.objective.loss(self._network, latents, seeds)
                accelerator.backward(loss)
                if accelerator.sync_gradients and loop.clip:
                    accelerator.clip_grad_norm_(self._network.parameters(), loop.clip)
                self._optimizer.step()
                self._optimizer.zero_grad()
            total += loss.detach() / loop.accumulate
        value = float(accelerator.reduce(total, "mean"))  # pyright: ignore
        if not value < float("inf"):
            raise ValueError(
                f"training: expected a finite loss at step {step + 1}, found {value}; the last state is kept"
            )
        if self._average:
            self._average.update()
        return value

    def _positions(self, step: int, number: int) -> range:
        """Positions in the order of the mixture that this process takes in pass `number` of a step."""
        begin = step * self._run.loop.batch
        begin += (number * self._accelerator.num_processes + self._accelerator.process_index) * self.pairs_per_pass
        return range(begin, begin + self.pairs_per_pass)

    def _begin_reading(self, step: int) -> list[list[Any]]:
        run = self._run

        def read(position: int) -> LoadedPair:
            return run.cache.load(run.mixture.draw(position), run.objective.roles)

        passes = range(run.loop.accumulate)
        return [[self._readers.submit(read, at) for at in self._positions(step, number)] for number in passes]

    def _save(self) -> None:
        folder = self._run.folder / _STATES / f"{self.step:08d}"
        partial = folder.with_name(f".{folder.name}.partial")
        if self._accelerator.is_main_process:
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir(parents=True)
        self._accelerator.wait_for_everyone()
        self._accelerator.save_state(str(partial))
        self._accelerator.wait_for_everyone()
        if self._accelerator.is_main_process:
            with atomic_write(partial / _JOB_FILE) as stream:
                stream.write(json.dumps(self._run.fingerprint()).encode())
            shutil.rmtree(folder, ignore_errors=True)
            partial.rename(folder)
            for old in _states(self._run.folder)[:-_KEPT_STATES]:
                shutil.rmtree(old)
        self._accelerator.wait_for_everyone()

    def _resume(self) -> None:
        run, states = self._run, _states(self._run.folder)
        if self._accelerator.is_main_process:
            truncate_log(run.folder / LOG_FILE, int(states[-1].name) if states else 0)
        if not states:
            return
        path = states[-1] / _JOB_FILE
        try:
            saved = json.loads(path.read_text())
        except (OSError, ValueError) as error:
            raise ValueError(f"{path}: expected the description of a training, found {error}") from error
        current = json.loads(json.dumps(run.fingerprint()))
        if changed := [name for name in current if saved.get(name) != current[name]]:
            raise ValueError(
                f"{run.folder}: expected the same training to go on with, found {changed[0]} "
                f"{saved.get(changed[0])} instead of {current[changed[0]]}; name another folder"
            )
        self._accelerator.load_state(str(states[-1]))
        self.step = int(states[-1].name)
        run.say(f"resumed from step {self.step}")

    def _validate(self, log: TrainingLog | None) -> None:
        run = self._run
        mixture = run.held_out or run.mixture
        validation = ValidationRun(
            run.objective,
            mixture.all()[: run.loop.validation_pairs],
            run.cache,
            self._accelerator.device,
            run.loop.seed,
        )
        if not validation.pairs:
            return
        self._network.eval()
        if self._average:
            with self._average.applied():
                result, sheet = validate(validation, self._network)
        else:
            result, sheet = validate(validation, self._network)
        self._network.train()
        if log:
            label = "held out" if run.held_out else "training pairs: no scene is held out"
            run.say(f"step {self.step}: {result.sentence} ({label})")
            log.add_validation(self.step, result.metrics, sheet)

    def _finish(self) -> Path:
        run, folder = self._run, self._run.folder / MODEL_FOLDER
        if self._average:
            with self._average.applied():
                state = self._weights()
        else:
            state = self._weights()
        if self._accelerator.is_main_process:
            run.objective.save(state, folder)
        self._accelerator.wait_for_everyone()
        return folder

    def _weights(self) -> dict[str, Tensor]:
        state: Any = self._accelerator.get_state_dict(self._network)
        return {name: tensor.detach().cpu().clone() for name, tensor in state.items()}

    def _save_trained_parameters(self, models: list[Any], weights: list[Any], output: str) -> None:
        for i, state in enumerate(weights):
            weights[i] = {name: tensor for name, tensor in state.items() if name in self._trained}

    def _load_trained_parameters(self, models: list[Any], folder: str) -> None:
        from splatgraft.harmonization.flux.weights.tensor_file import read_tensors

        while models:
            network = self._accelerator.unwrap_model(models.pop())
            network.load_state_dict(read_tensors(Path(folder) / "model.safetensors"), strict=False)


def _states(folder: Path) -> list[Path]:
    """Complete states, oldest first."""
    return sorted(path for path in (folder / _STATES).glob("[0-9]*") if (path / _JOB_FILE).is_file())


def process_counts(*, cpu: bool) -> tuple[int, int]:
    """Number of processes that accelerate runs, and how many of them share one copy of the weights."""
    from accelerate import PartialState

    state = PartialState(cpu=cpu)
    sharded = str(state.distributed_type).endswith(("FSDP", "DEEPSPEED"))
    return state.num_processes, state.num_processes if sharded else 1


def is_first_process(*, cpu: bool) -> bool:
    """Whether this is the process that writes files and messages."""
    from accelerate import PartialState

    return PartialState(cpu=cpu).is_main_process
