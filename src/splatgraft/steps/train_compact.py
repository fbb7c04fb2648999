"""The command `train compact`: rendered pairs become the small harmoniser that is shipped."""

import json
from dataclasses import dataclass, field
from pathlib import Path

from splatgraft.steps.step import Device, Positional, choose_device
from splatgraft.steps.terminal import Terminal
from splatgraft.synth.pairs import read_manifest
from splatgraft.train.compact.loop import CompactLoop, CompactTraining, train_compact
from splatgraft.train.compact.pairs import CompactPairs, HeldOut
from splatgraft.train.compact.priors import write_priors


@dataclass(frozen=True)
class TrainCompact:
    """Train the compact harmoniser; goes on where it was killed."""

    out: Positional
    """Folder for compact.safetensors, priors/, state, log and validation pictures."""
    pairs: Path
    """Folder that `splatgraft synth pairs` rendered."""
    loop: CompactLoop = field(default_factory=CompactLoop)
    held_out: HeldOut = field(default_factory=HeldOut)
    device: Device = "auto"

    def execute(self, terminal: Terminal) -> int:
        """Make the priors that are missing, train, write the weights."""
        from splatgraft.harmonize.compact.registered import SHIPPED
        from splatgraft.harmonize.compact.weights import write_weights

        device = choose_device(self.device, terminal)
        samples = read_manifest(self.pairs)
        folders = sorted({sample.folder for sample in samples})
        self.out.mkdir(parents=True, exist_ok=True)
        with terminal.bar("light") as progress:
            write_priors(folders, self.out / "priors", seed=self.loop.seed, progress=progress)
        with terminal.bar("read") as progress:
            pairs = CompactPairs(self.pairs, self.out / "priors", self.held_out, progress)
        terminal.say(f"{len(pairs.training)} pairs to learn from, {len(pairs.validation)} held out")
        with terminal.bar("train") as progress:
            run = CompactTraining(pairs, self.loop, self.out, device, terminal.say, progress)
            size, state = train_compact(run)
        notes = {
            "pairs": json.dumps({"folders": [folder.name for folder in folders], **pairs.fingerprint()}),
            "steps": str(self.loop.steps),
            "seed": str(self.loop.seed),
        }
        write_weights(self.out / SHIPPED.name, size, state, notes)
        terminal.say(f"{self.out / SHIPPED.name}")
        return 0
