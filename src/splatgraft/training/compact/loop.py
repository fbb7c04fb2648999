"""The loop of the compact harmoniser: one process, killed anywhere, gone on with to the bit. Knows no files of pairs.

What a step is given follows from the seed and the step alone. A state holds weights, optimiser and average.
"""

import json
import math
import random
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from splatgraft.core.images import srgb_from_linear
from splatgraft.harmonization.compact.features import apply_output
from splatgraft.harmonization.compact.network import CompactNetwork, CompactSize
from splatgraft.runtime.atomic_file import atomic_write
from splatgraft.runtime.progress import Progress
from splatgraft.training.compact.augmentation import augment, batch_inputs
from splatgraft.training.compact.loss import compact_loss
from splatgraft.training.compact.pairs import CompactPairs
from splatgraft.training.moving_average import MovingAverage
from splatgraft.training.training_log import LOG_FILE, TrainingLog, truncate_log

STATE_FILE = "state.pt"


@dataclass(frozen=True)
class CompactLoopOptions:
    """Length and rhythm."""

    steps: int = 2000
    batch: int = 8
    rate: float = 1e-3
    """Of AdamW; rises over the first hundredth, falls as a cosine."""
    decay: float = 0.05
    """Of weights."""
    ema: float = 0.998
    """Decay of the averaged weights, which are what is kept."""
    size: tuple[int, int] = (128, 192)
    """Height and width of a training view, multiples of 16."""
    seed: int = 0
    save_every: int = 200
    validate_every: int = 500
    validation_pairs: int = 96
    bf16: bool = False
    """Compute the network in bfloat16; half the time where the processor knows it."""
    threads: int = 0
    """Of torch; 0 leaves it as it is."""
    network: CompactSize = field(default_factory=CompactSize)


@dataclass(frozen=True)
class CompactTraining:
    """All that one run is given."""

    pairs: CompactPairs
    loop: CompactLoopOptions
    folder: Path
    """Gets state.pt, log.jsonl, validation/."""
    device: torch.device
    say: Callable[[str], None]
    progress: Progress
    begin: dict[str, Tensor] | None = None
    """Weights to begin from; random ones where not given."""


def train_compact(run: CompactTraining) -> tuple[CompactSize, dict[str, Tensor]]:
    """Train to the last step; the averaged weights.

    Raises: ValueError where the loss is no number, or the folder holds another training.
    """
    loop = run.loop
    if loop.threads:
        torch.set_num_threads(loop.threads)
    torch.manual_seed(loop.seed)
    network = CompactNetwork(loop.network).to(run.device)
    if run.begin is not None:
        network.load_state_dict(run.begin)
    decayed = [p for p in network.parameters() if p.ndim > 1]
    others = [p for p in network.parameters() if p.ndim <= 1]
    groups = [{"params": decayed, "weight_decay": loop.decay}, {"params": others, "weight_decay": 0.0}]
    optimizer = torch.optim.AdamW(groups, lr=loop.rate, betas=(0.9, 0.99))
    average = MovingAverage(network, loop.ema)
    first = _resumed(run, network, optimizer, average)
    truncate_log(run.folder / LOG_FILE, first)
    with closing(TrainingLog(run.folder, tensorboard=False)) as curve:
        for step in range(first, loop.steps):
            for group in optimizer.param_groups:
                group["lr"] = loop.rate * _schedule(step, loop.steps)
            loss = _one_step(run, network, step)
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimizer.step()
            average.update()
            value = float(loss.detach())
            if not math.isfinite(value):
                raise ValueError(
                    f"training: expected a finite loss at step {step + 1}, found {value}; the last state is kept"
                )
            curve.add(step + 1, value, optimizer.param_groups[0]["lr"])
            run.progress(step + 1, loop.steps, f"loss {curve.smooth:.4f}")
            last = step + 1 == loop.steps
            if last or (step + 1) % loop.validate_every == 0:
                with average.applied():
                    numbers, sheet = validate_compact(run, network)
                words = ", ".join(f"{name} {value:.4f}" for name, value in numbers.items())
                run.say(f"step {step + 1}, held out: {words}")
                curve.add_validation(step + 1, numbers, sheet)
            if last or (step + 1) % loop.save_every == 0:
                _save(run, network, optimizer, average, step + 1)
    with average.applied():
        return loop.network, {name: tensor.detach().cpu().clone() for name, tensor in network.state_dict().items()}


def _schedule(step: int, steps: int) -> float:
    rise = min(1.0, (step + 1) / max(1, steps // 100))
    return rise * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * step / steps)))


def _one_step(run: CompactTraining, network: CompactNetwork, step: int) -> Tensor:
    pairs, loop = run.pairs, run.loop
    views, truths = [], []
    for position in range(step * loop.batch, (step + 1) * loop.batch):
        turn, place = divmod(position, len(pairs.training))
        order = torch.randperm(len(pairs.training), generator=torch.Generator().manual_seed(loop.seed * 7919 + turn))
        name = f"compact-{loop.seed}-{position}"
        variant = random.Random(name).randrange(pairs.variants)
        view, truth = pairs.read(pairs.training[int(order[place])], variant)
        view, truth = augment(view, truth, loop.size, name)
        views.append(view)
        truths.append(truth)
    view, truth = batch_inputs(views).to(run.device), torch.cat(truths).to(run.device)
    with torch.autocast(run.device.type, torch.bfloat16, enabled=loop.bf16):
        output = network(view.channels())
    return compact_loss(view, output.float(), truth)[0]


@torch.no_grad()
def validate_compact(run: CompactTraining, network: CompactNetwork) -> tuple[dict[str, float], Tensor]:
    """Errors on the families held out, of the network and of the prior, and a sheet: pasted, prior, ours, truth."""
    pairs, loop = run.pairs, run.loop
    chosen = pairs.validation or pairs.training
    chosen = chosen[:: max(1, len(chosen) // loop.validation_pairs)][: loop.validation_pairs]
    totals: dict[str, float] = {}
    rows = []
    for number, index in enumerate(chosen):
        view, truth = pairs.read(index, number % pairs.variants)
        view, truth = augment(view, truth, loop.size, f"validation-{number}")
        view, truth = view.to(run.device), truth.to(run.device)
        output = network(view.channels())
        _, found, before = compact_loss(view, output, truth)
        for region in ("object", "shadow", "rest"):
            for who, errors in (("", found), ("_prior", before)):
                key = f"{region}{who}"
                totals[key] = totals.get(key, 0.0) + float(getattr(errors, region).mean()) / len(chosen)
        if number < 12:
            pictures = (view.composite, view.prior(), apply_output(view, output), truth)
            line = [srgb_from_linear(p[0].clamp(0, 1)).permute(1, 2, 0).cpu() for p in pictures]
            rows.append(torch.cat(line, 1))
    return totals, torch.cat(rows)


def _fingerprint(run: CompactTraining) -> dict[str, Any]:
    own = asdict(run.loop)
    for name in ("save_every", "validate_every", "validation_pairs", "threads"):
        own.pop(name)
    begin = 0.0 if run.begin is None else sum(float(tensor.double().abs().sum()) for tensor in run.begin.values())
    return json.loads(json.dumps(own | {"pairs": run.pairs.fingerprint(), "begin": begin}))


def _save(run: CompactTraining, network: CompactNetwork, optimizer: Any, average: MovingAverage, step: int) -> None:
    state = {
        "step": step,
        "job": json.dumps(_fingerprint(run)),
        "network": network.state_dict(),
        "optimizer": optimizer.state_dict(),
        "average": average.state_dict(),
    }
    with atomic_write(run.folder / STATE_FILE) as stream:
        torch.save(state, stream)


def _resumed(run: CompactTraining, network: CompactNetwork, optimizer: Any, average: MovingAverage) -> int:
    path = run.folder / STATE_FILE
    if not path.is_file():
        return 0
    state = torch.load(path, map_location=run.device, weights_only=True)
    before, now = json.loads(state["job"]), _fingerprint(run)
    if other := [name for name in now if before.get(name) != now[name]]:
        raise ValueError(
            f"{path}: expected the same training to go on with, found {other[0]} {before.get(other[0])} instead of "
            f"{now[other[0]]}; name another folder"
        )
    network.load_state_dict(state["network"])
    optimizer.load_state_dict(state["optimizer"])
    average.load_state_dict(state["average"])
    run.say(f"goes on from step {state['step']}")
    return int(state["step"])
