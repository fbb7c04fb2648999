"""The training loop of the compact harmoniser, on one process; a killed run resumes bit for bit.

The pairs of a step and their augmentation follow from the seed and the step alone. A saved state holds weights,
optimiser and moving average.
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
from splatgraft_paper.training.compact.augmentation import augment, batch_inputs
from splatgraft_paper.training.compact.loss import compact_loss
from splatgraft_paper.training.compact.pairs import CompactPairs
from splatgraft_paper.training.moving_average import MovingAverage
from splatgraft_paper.training.training_log import LOG_FILE, TrainingLog, truncate_log

STATE_FILE = "state.pt"
_BETAS = (0.9, 0.99)
"""Of AdamW."""
_MAX_GRADIENT_NORM = 1.0
_FINAL_RATE = 0.02
"""Learning rate at the last step over the largest."""
_SHEET_ROWS = 12


@dataclass(frozen=True)
class CompactLoopOptions:
    """Options of the training loop."""

    steps: int = 2000
    batch: int = 8
    rate: float = 1e-3
    """Learning rate of AdamW; rises over the first hundredth of the steps, then falls as a cosine."""
    decay: float = 0.05
    """Weight decay."""
    ema: float = 0.998
    """Decay of the averaged weights, which are the result."""
    size: tuple[int, int] = (128, 192)
    """Height and width of a training view, multiples of 16."""
    seed: int = 0
    save_every: int = 200
    validate_every: int = 500
    validation_pairs: int = 96
    bf16: bool = False
    """Compute the network in bfloat16; halves the time on processors that support it."""
    threads: int = 0
    """Threads of torch; 0 keeps its default."""
    network: CompactSize = field(default_factory=CompactSize)


@dataclass(frozen=True)
class CompactTraining:
    """Everything that one run needs."""

    pairs: CompactPairs
    loop: CompactLoopOptions
    folder: Path
    """Receives state.pt, log.jsonl and validation/."""
    device: torch.device
    say: Callable[[str], None]
    progress: Progress
    begin: dict[str, Tensor] | None = None
    """Initial weights; random where None."""


def train_compact(run: CompactTraining) -> tuple[CompactSize, dict[str, Tensor]]:
    """Train to the last step, resuming from the folder's state.

    Returns:
        The network's size and its averaged weights.

    Raises:
        ValueError: the loss is not finite, or the folder holds another training.
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
    optimizer = torch.optim.AdamW(groups, lr=loop.rate, betas=_BETAS)
    average = MovingAverage(network, loop.ema)
    first = _resumed(run, network, optimizer, average)
    truncate_log(run.folder / LOG_FILE, first)
    with closing(TrainingLog(run.folder, tensorboard=False)) as log:
        for step in range(first, loop.steps):
            for group in optimizer.param_groups:
                group["lr"] = loop.rate * _schedule(step, loop.steps)
            loss = _batch_loss(run, network, step)
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), _MAX_GRADIENT_NORM)
            optimizer.step()
            average.update()
            value = float(loss.detach())
            if not math.isfinite(value):
                raise ValueError(
                    f"training: expected a finite loss at step {step + 1}, found {value}; the last state is kept"
                )
            log.add(step + 1, value, optimizer.param_groups[0]["lr"])
            run.progress(step + 1, loop.steps, f"loss {log.smooth:.4f}")
            last = step + 1 == loop.steps
            if last or (step + 1) % loop.validate_every == 0:
                with average.applied():
                    metrics, sheet = validate_compact(run, network)
                words = ", ".join(f"{name} {value:.4f}" for name, value in metrics.items())
                run.say(f"step {step + 1}, held out: {words}")
                log.add_validation(step + 1, metrics, sheet)
            if last or (step + 1) % loop.save_every == 0:
                _save(run, network, optimizer, average, step + 1)
    with average.applied():
        return loop.network, {name: tensor.detach().cpu().clone() for name, tensor in network.state_dict().items()}


def _schedule(step: int, steps: int) -> float:
    rise = min(1.0, (step + 1) / max(1, steps // 100))
    return rise * (_FINAL_RATE + (1 - _FINAL_RATE) * 0.5 * (1 + math.cos(math.pi * step / steps)))


def _batch_loss(run: CompactTraining, network: CompactNetwork, step: int) -> Tensor:
    pairs, loop = run.pairs, run.loop
    views, truths = [], []
    for position in range(step * loop.batch, (step + 1) * loop.batch):
        epoch, place = divmod(position, len(pairs.training))
        order = torch.randperm(len(pairs.training), generator=torch.Generator().manual_seed(loop.seed * 7919 + epoch))
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
    """Errors by region on the held-out pairs, of the network and of the prior, and a contact sheet.

    A row of the sheet shows the composite, the prior, the network's result and the ground truth.
    """
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
        _, errors, prior_errors = compact_loss(view, output, truth)
        for region in ("object", "shadow", "rest"):
            for suffix, regions in (("", errors), ("_prior", prior_errors)):
                key = f"{region}{suffix}"
                totals[key] = totals.get(key, 0.0) + float(getattr(regions, region).mean()) / len(chosen)
        if number < _SHEET_ROWS:
            pictures = (view.composite, view.prior(), apply_output(view, output), truth)
            images = [srgb_from_linear(p[0].clamp(0, 1)).permute(1, 2, 0).cpu() for p in pictures]
            rows.append(torch.cat(images, 1))
    return totals, torch.cat(rows)


def _fingerprint(run: CompactTraining) -> dict[str, Any]:
    options = asdict(run.loop)
    for name in ("save_every", "validate_every", "validation_pairs", "threads"):
        options.pop(name)
    begin = 0.0 if run.begin is None else sum(float(tensor.double().abs().sum()) for tensor in run.begin.values())
    return json.loads(json.dumps(options | {"pairs": run.pairs.fingerprint(), "begin": begin}))


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
    saved, current = json.loads(state["job"]), _fingerprint(run)
    if changed := [name for name in current if saved.get(name) != current[name]]:
        raise ValueError(
            f"{path}: expected the same training to go on with, found {changed[0]} {saved.get(changed[0])} instead "
            f"of {current[changed[0]]}; name another folder"
        )
    network.load_state_dict(state["network"])
    optimizer.load_state_dict(state["optimizer"])
    average.load_state_dict(state["average"])
    run.say(f"resumed from step {state['step']}")
    return int(state["step"])
