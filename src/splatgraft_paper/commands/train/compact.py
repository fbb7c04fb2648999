"""The command `train compact`: rendered pairs become the compact harmoniser that is shipped."""

import json
from dataclasses import dataclass, field, replace
from pathlib import Path

from splatgraft.project.step import Device, Positional, choose_device
from splatgraft.runtime.console import Console
from splatgraft_paper.synthesis.pairs import read_manifest
from splatgraft_paper.training.compact.loop import CompactLoopOptions, CompactTraining, train_compact
from splatgraft_paper.training.compact.pairs import CompactPairs, HeldOutOptions
from splatgraft_paper.training.compact.priors import write_priors


@dataclass(frozen=True)
class TrainCompact:
    """Train the compact harmoniser; a killed run is continued."""

    out: Positional
    """Folder for compact.safetensors, priors/, state, log and validation pictures."""
    pairs: Path
    """Folder that `splatgraft synth pairs` rendered."""
    loop: CompactLoopOptions = field(default_factory=CompactLoopOptions)
    held_out: HeldOutOptions = field(default_factory=HeldOutOptions)
    variants: int = 1
    """Perturbed lights per pair; each adds 0.25 MB per pair at 240x160."""
    start: Path | None = None
    """Initial weights, a compact.safetensors, to continue the training with other pairs."""
    device: Device = "auto"
    """Where to compute."""

    def execute(self, console: Console) -> int:
        """Write the missing priors, train, write the weights."""
        from splatgraft.harmonization.compact.factory import SHIPPED
        from splatgraft.harmonization.compact.weights import read_weights, write_weights

        device = choose_device(self.device, console)
        samples = read_manifest(self.pairs)
        folders = sorted({sample.folder for sample in samples})
        self.out.mkdir(parents=True, exist_ok=True)
        begin = None if self.start is None else read_weights(self.start)
        loop = self.loop if begin is None else replace(self.loop, network=begin.size)
        priors = [self.out / "priors" / str(variant) for variant in range(self.variants)]
        for variant, folder in enumerate(priors):
            with console.bar(f"light {variant + 1}") as progress:
                write_priors(folders, folder, seed=loop.seed + variant, progress=progress)
        with console.bar("read") as progress:
            pairs = CompactPairs(self.pairs, priors, self.held_out, progress)
        console.say(f"{len(pairs.training)} pairs to train on, {len(pairs.validation)} held out")
        with console.bar("train") as progress:
            run = CompactTraining(pairs, loop, self.out, device, console.say, progress)
            run = run if begin is None else replace(run, begin=begin.state_dict())
            size, state = train_compact(run)
        notes = {
            "pairs": json.dumps({"folders": [folder.name for folder in folders], **pairs.fingerprint()}),
            "steps": str(loop.steps),
            "seed": str(loop.seed),
        }
        write_weights(self.out / SHIPPED.name, size, state, notes)
        console.say(f"{self.out / SHIPPED.name}")
        return 0


COMMAND = TrainCompact
