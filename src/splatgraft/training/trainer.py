"""The loop: one process or many through accelerate (its only importer), killed anywhere, gone on with to the bit.

Which pairs a step takes and what noise they get follows from the seed and the step alone: so a state holds weights,
optimiser and average, and the number of processes may change between two runs. Knows neither networks nor data.
"""

import json
import shutil
import time
from collections.abc import Callable, Sequence
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


@dataclass(frozen=True)
class TrainingRun:
    """All that one run is given."""

    objective: Objective
    mixture: Mixture
    held_out: Mixture | None
    """Pairs to validate on; none where there is one scene."""
    cache: LatentCache
    loop: LoopOptions
    folder: Path
    """Gets states/, model/, validation/, log.jsonl."""
    say: Callable[[str], None]
    progress: Progress

    def fingerprint(self) -> dict[str, Any]:
        """What must be the same for a state to be gone on from."""
        own = ("batch", "rate", "warm_up", "clip", "ema", "optimizer", "precision", "seed")
        data = [[source.name, len(indices)] for source, indices in zip(*self._data(), strict=True)]
        return {name: getattr(self.loop, name) for name in own} | {"data": data}

    def _data(self) -> tuple[Sequence[Any], Sequence[Any]]:
        return self.mixture.sources, self.mixture.indices


def train(run: TrainingRun) -> Path:
    """Train to the last step; returns the folder of the model.

    Raises: ValueError where the loss is no number, memory does not do, or an earlier run was another one.
    """
    with ThreadPoolExecutor(4) as readers:
        loop = _Loop(run, readers)
        try:
            return loop.run()
        except torch.OutOfMemoryError as error:
            raise ValueError(
                f"training: expected memory for {loop.each} pairs a pass, found too little at step {loop.step}; the "
                "last state is kept: try --accumulate, --optimizer adam8bit or --lora"
            ) from error


class _Loop:
    """What lives while a run runs."""

    def __init__(self, run: TrainingRun, readers: ThreadPoolExecutor) -> None:
        from accelerate import Accelerator

        self._training, self._readers, loop = run, readers, run.loop
        self._accelerator = Accelerator(
            mixed_precision=loop.precision, gradient_accumulation_steps=loop.accumulate, cpu=loop.cpu
        )
        self.each = loop.check(self._accelerator.num_processes)
        self.step = 0
        self._sharded = str(self._accelerator.distributed_type).endswith(("FSDP", "DEEPSPEED"))
        if self._sharded and loop.ema:
            raise ValueError("--ema: expected 0 with FSDP or DeepSpeed, whose parts cannot be averaged here")
        if (plugin := getattr(self._accelerator.state, "deepspeed_plugin", None)) is not None:
            plugin.deepspeed_config["train_micro_batch_size_per_gpu"] = self.each
        network = run.objective.network.train()
        self._learning = {name for name, p in network.named_parameters() if p.requires_grad}
        optimizer = make_optimizer(loop.optimizer, [p for p in network.parameters() if p.requires_grad], loop.rate)
        run.objective.to(self._accelerator.device)
        self._average = MovingAverage(network, loop.ema) if loop.ema else None
        self._network, self._optimizer = self._accelerator.prepare(network, optimizer)
        if self._average:
            self._accelerator.register_for_checkpointing(self._average)
        if len(self._learning) < len(list(network.named_parameters())) and not self._sharded:
            self._accelerator.register_save_state_pre_hook(self._keep_what_learns)
            self._accelerator.register_load_state_pre_hook(self._load_what_learns)

    def run(self) -> Path:
        """All steps that are left."""
        run, loop = self._training, self._training.loop
        self._resume()
        log = TrainingLog(run.folder, loop.tensorboard) if self._accelerator.is_main_process else None
        ahead = self._begin_reading(self.step)
        began, first = time.monotonic(), self.step
        for step in range(self.step, loop.steps):
            self.step = step
            batches, ahead = ahead, self._begin_reading(step + 1) if step + 1 < loop.steps else []
            loss = self._one_step(step, [[future.result() for future in part] for part in batches])
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

    def _one_step(self, step: int, parts: list[list[LoadedPair]]) -> float:
        run, loop, accelerator = self._training, self._training.loop, self._accelerator
        total = torch.zeros((), device=accelerator.device)
        for group in self._optimizer.param_groups:
            group["lr"] = loop.rate_at(step)
        for part, loaded in enumerate(parts):
            latents = run.cache.encode_missing(loaded, run.objective.roles)
            latents = {role: tensor.to(accelerator.device) for role, tensor in latents.items()}
            seeds = [sample_seed(loop.seed, position) for position in self._positions(step, part)]
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

    def _positions(self, step: int, part: int) -> range:
        """Places in the order that this process takes in a pass."""
        begin = step * self._training.loop.batch
        begin += (part * self._accelerator.num_processes + self._accelerator.process_index) * self.each
        return range(begin, begin + self.each)

    def _begin_reading(self, step: int) -> list[list[Any]]:
        run = self._training

        def read(position: int) -> LoadedPair:
            return run.cache.load(run.mixture.draw(position), run.objective.roles)

        parts = range(run.loop.accumulate)
        return [[self._readers.submit(read, at) for at in self._positions(step, part)] for part in parts]

    def _save(self) -> None:
        folder = self._training.folder / _STATES / f"{self.step:08d}"
        partial = folder.with_name(f".{folder.name}.partial")
        if self._accelerator.is_main_process:
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir(parents=True)
        self._accelerator.wait_for_everyone()
        self._accelerator.save_state(str(partial))
        self._accelerator.wait_for_everyone()
        if self._accelerator.is_main_process:
            with atomic_write(partial / _JOB_FILE) as stream:
                stream.write(json.dumps(self._training.fingerprint()).encode())
            shutil.rmtree(folder, ignore_errors=True)
            partial.rename(folder)
            for old in _states(self._training.folder)[:-_KEPT_STATES]:
                shutil.rmtree(old)
        self._accelerator.wait_for_everyone()

    def _resume(self) -> None:
        run, states = self._training, _states(self._training.folder)
        if self._accelerator.is_main_process:
            truncate_log(run.folder / LOG_FILE, int(states[-1].name) if states else 0)
        if not states:
            return
        path = states[-1] / _JOB_FILE
        try:
            before = json.loads(path.read_text())
        except (OSError, ValueError) as error:
            raise ValueError(f"{path}: expected the description of a training, found {error}") from error
        now = json.loads(json.dumps(run.fingerprint()))
        if other := [name for name in now if before.get(name) != now[name]]:
            raise ValueError(
                f"{run.folder}: expected the same training to go on with, found {other[0]} {before.get(other[0])} "
                f"instead of {now[other[0]]}; name another folder"
            )
        self._accelerator.load_state(str(states[-1]))
        self.step = int(states[-1].name)
        run.say(f"goes on from step {self.step}")

    def _validate(self, log: TrainingLog | None) -> None:
        run = self._training
        mixture = run.held_out or run.mixture
        asked = ValidationRun(
            run.objective,
            mixture.all()[: run.loop.validation_pairs],
            run.cache,
            self._accelerator.device,
            run.loop.seed,
        )
        if not asked.pairs:
            return
        self._network.eval()
        if self._average:
            with self._average.applied():
                found, sheet = validate(asked, self._network)
        else:
            found, sheet = validate(asked, self._network)
        self._network.train()
        if log:
            label = "held out" if run.held_out else "trained on: no scene is held out"
            run.say(f"step {self.step}: {found.sentence} ({label})")
            log.add_validation(self.step, found.numbers, sheet)

    def _finish(self) -> Path:
        run, folder = self._training, self._training.folder / MODEL_FOLDER
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

    def _keep_what_learns(self, models: list[Any], weights: list[Any], output: str) -> None:
        for i, state in enumerate(weights):
            weights[i] = {name: tensor for name, tensor in state.items() if name in self._learning}

    def _load_what_learns(self, models: list[Any], folder: str) -> None:
        from splatgraft.harmonization.flux.weights.tensor_file import read_tensors

        while models:
            network = self._accelerator.unwrap_model(models.pop())
            network.load_state_dict(read_tensors(Path(folder) / "model.safetensors"), strict=False)


def _states(folder: Path) -> list[Path]:
    """Whole states, oldest first."""
    return sorted(path for path in (folder / _STATES).glob("[0-9]*") if (path / _JOB_FILE).is_file())


def process_counts(*, cpu: bool) -> tuple[int, int]:
    """Processes that accelerate runs, and how many of them share one copy of the weights."""
    from accelerate import PartialState

    state = PartialState(cpu=cpu)
    sharded = str(state.distributed_type).endswith(("FSDP", "DEEPSPEED"))
    return state.num_processes, state.num_processes if sharded else 1


def is_first_process(*, cpu: bool) -> bool:
    """Whether this is the process that writes."""
    from accelerate import PartialState

    return PartialState(cpu=cpu).is_main_process
