"""The training loop, on one process or several; a killed run resumes bit for bit on as many processes as before.

The pairs of a step and their noise follow from the seed and the step alone. A saved state therefore holds only weights,
optimiser and moving average, and the number of processes may change between runs.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from splatgraft.runtime.interruption import interruption_held
from splatgraft.runtime.progress import Progress
from splatgraft_paper.training.checkpoints import list_states, load_state, read_job, save_state, whole_weights
from splatgraft_paper.training.latent_cache import LatentCache, LoadedPair
from splatgraft_paper.training.loop_options import LoopOptions
from splatgraft_paper.training.objective import Objective
from splatgraft_paper.training.pair_loader import PairLoader
from splatgraft_paper.training.processes import Processes
from splatgraft_paper.training.sources.pair_source import Mixture, sample_seed
from splatgraft_paper.training.trained_network import TrainedNetwork
from splatgraft_paper.training.training_log import LOG_FILE, TrainingLog, truncate_log
from splatgraft_paper.training.validation import ValidationRun, validate

MODEL_FOLDER = "model"
_STOP, _UNREADABLE = 1, 2


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
        ValueError: the loss is not finite, a pair cannot be read, memory does not suffice, or the folder's state is of
            another training. The last state is kept.
        KeyboardInterrupt: Ctrl-C, or SIGTERM as cluster schedulers send it; the state of the finished steps is saved.
    """
    with interruption_held(terminate=True) as interrupted:
        loop = _RunningLoop(run, interrupted)
        try:
            return loop.run()
        except torch.OutOfMemoryError as error:
            raise ValueError(
                f"training: expected memory for {loop.loader.pairs_per_pass} pairs a pass, found too little at step "
                f"{loop.step}; the last state is kept: try --accumulate, --optimizer adam8bit or --lora"
            ) from error
        finally:
            loop.loader.close()


class _RunningLoop:
    """The state of a running training."""

    def __init__(self, run: TrainingRun, interrupted: Callable[[], bool]) -> None:
        self._run, self._interrupted = run, interrupted
        self._processes = Processes.join(cpu=run.loop.cpu)
        run.loop.check(self._processes.count)
        self.step = 0
        run.objective.to(self._processes.device)
        self._network = TrainedNetwork(run.objective.network, run.loop, self._processes)
        rank, count = self._processes.rank, self._processes.count
        roles = run.objective.roles
        self.loader = PairLoader(run.mixture, run.cache, roles, loop=run.loop, rank=rank, count=count)

    def run(self) -> Path:
        """Run all remaining steps and write the model."""
        run, loop = self._run, self._run.loop
        self._resume()
        log = TrainingLog(run.folder, loop.tensorboard) if self._processes.is_first else None
        began, first = time.monotonic(), self.step
        while self.step < loop.steps:
            batches = self._next_batches()
            loss = self._train_step(batches)
            self.step += 1
            if log:
                log.add(self.step, loss, loop.rate_at(self.step - 1))
                spent = max(time.monotonic() - began, 1e-9)
                speed, waiting = (self.step - first) * loop.batch / spent, self.loader.waited / spent
                words = f"loss {log.smooth:.4f}, {speed:.2f} pairs/s, {waiting:.0%} of it waiting for pictures"
                run.progress(self.step, loop.steps, words)
            if self.step % loop.save_every == 0 or self.step == loop.steps:
                self._save()
            if self.step % loop.validate_every == 0 or self.step == loop.steps:
                self._validate(log)
        if log:
            log.close()
            if self.step > first:
                spent = max(time.monotonic() - began, 1e-9)
                speed, waiting = (self.step - first) * loop.batch / spent, self.loader.waited / spent
                run.say(f"throughput: {speed:.2f} pairs/s; {waiting:.0%} of the time waited for pictures")
        return self._finish()

    def _next_batches(self) -> list[list[LoadedPair]]:
        """The pairs of this process in this step, pass by pass; the following steps are read meanwhile."""
        problem, batches = "", []
        try:
            batches = self.loader.batches(self.step)
        except ValueError as error:
            problem = str(error)
        signal = self._processes.largest(_UNREADABLE if problem else _STOP if self._interrupted() else 0)
        if signal == _UNREADABLE:
            # all processes stop together: one alone would leave the others waiting for it
            self._save()
            raise ValueError(next(found for found in self._processes.gather(problem) if found))
        if signal == _STOP:
            self._save()
            self._run.say(f"stopped after step {self.step}{': its state is saved' if self.step else ''}")
            raise KeyboardInterrupt
        return batches

    def _train_step(self, batches: list[list[LoadedPair]]) -> float:
        run, loop = self._run, self._run.loop
        total = torch.zeros((), device=self._processes.device)
        passes = []
        for number, loaded in enumerate(batches):
            latents = run.cache.encode_missing(loaded, run.objective.roles)
            latents = {role: tensor.to(self._processes.device) for role, tensor in latents.items()}
            seeds = [sample_seed(loop.seed, position) for position in self.loader.positions(self.step, number)]
            passes.append((latents, seeds))
            loss = run.objective.loss(self._network, latents, seeds)
            self._network.backward(loss, last=number == len(batches) - 1)
            total += loss.detach() / loop.accumulate
        value = float(self._processes.mean(total))
        if not abs(value) < float("inf"):
            self._stop_at_broken_loss(passes, f"a finite loss at step {self.step + 1}, found {value}")
        if not self._network.step(loop.rate_at(self.step)):
            self._stop_at_broken_loss(passes, f"a finite gradient at step {self.step + 1}, found none")
        return value

    @torch.no_grad()
    def _stop_at_broken_loss(self, passes: list[tuple[dict[str, Tensor], list[int]]], wrong: str) -> None:
        """Name the pairs at fault, and save the weights where they are whole: they are those of the step before."""
        broken = []
        for number, (latents, seeds) in enumerate(passes):
            for i, position in enumerate(self.loader.positions(self.step, number)):
                one = {role: tensor[i : i + 1] for role, tensor in latents.items()}
                loss = float(self._run.objective.loss(self._network, one, seeds[i : i + 1]))
                if not abs(loss) < float("inf"):
                    drawn = self._run.mixture.draw(position)
                    broken.append(drawn.source.location(drawn.index))
        names = list(dict.fromkeys(name for found in self._processes.gather(broken) for name in found))
        cause = f"for {', '.join(names)}" if names else "from pairs that are finite one by one"
        if self._network.is_finite():
            self._network.optimizer.zero_grad()
            self._save()
        else:
            cause = "for all pairs, as the weights had diverged before"
        raise ValueError(f"training: expected {wrong} {cause}; {self._kept_state()}")

    def _kept_state(self) -> str:
        states = list_states(self._run.folder)
        return f"the state of step {int(states[-1].name)} is kept" if states else "no state was saved before"

    def _save(self) -> None:
        if self.step == 0:
            return
        if not self._network.is_finite():
            raise ValueError(
                f"training: expected finite weights after step {self.step}, found others; {self._kept_state()}"
            )
        save_state(self._run.folder, self.step, self._network, self._run.fingerprint(), self._processes)

    def _resume(self) -> None:
        run, states = self._run, list_states(self._run.folder)
        self._processes.wait()  # all have listed the states before one changes them
        if states and run.loop.resume == "never":
            raise ValueError(f"{run.folder}: expected no states (--resume never), found {states[-1]}")
        for path in reversed(states):
            self._check_job(path)
            problem = load_state(path, self._network, self._processes)
            if problem is None:
                self.step = int(path.name)
                run.say(f"resumed from step {self.step}")
                break
            run.say(f"{path}: expected a whole state, found {problem}; the one before it is tried")
        if states and not self.step:
            raise ValueError(f"{run.folder / 'states'}: expected a state that can be read, found none; another folder?")
        if self._processes.is_first:
            truncate_log(run.folder / LOG_FILE, self.step)

    def _check_job(self, path: Path) -> None:
        saved, current = read_job(path), self._run.fingerprint()
        if changed := [name for name in current if saved.get(name) != current[name]]:
            raise ValueError(
                f"{self._run.folder}: expected the same training to go on with, found {changed[0]} "
                f"{saved.get(changed[0])} instead of {current[changed[0]]}; name another folder"
            )

    def _validate(self, log: TrainingLog | None) -> None:
        run = self._run
        mixture = run.held_out or run.mixture
        pairs = mixture.all()[: run.loop.validation_pairs]
        if not pairs:
            return
        validation = ValidationRun(run.objective, pairs, run.cache, self._processes.device, run.loop.seed)
        try:
            with self._network.averaged():
                result, sheet = validate(validation, self._network)
        except ValueError:  # a picture that vanished; all processes read the same ones
            self._save()
            raise
        if log:
            label = "held out" if run.held_out else "training pairs: no scene is held out"
            run.say(f"step {self.step}: {result.sentence} ({label})")
            log.add_validation(self.step, result.metrics, sheet)

    def _finish(self) -> Path:
        folder = self._run.folder / MODEL_FOLDER
        with self._network.averaged():
            state = whole_weights(self._network)
        if self._processes.is_first:
            self._run.objective.save(state, folder)
        self._processes.wait()
        return folder
