"""The command `train light`: examples of known light become the networks that correct the estimated light."""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch

from splatgraft.project.step import Positional
from splatgraft.relighting.light.learned.ensemble import WEIGHTS_FILE, write_ensemble
from splatgraft.runtime.console import Console
from splatgraft.training.light_examples import LightExample, read_examples
from splatgraft.training.light_training import LightTrainingOptions, TrainedLight, train_light


@dataclass(frozen=True)
class TrainLight:
    """Train the correction of the light at a place, on the CPU, in minutes."""

    examples: Positional
    """Folder of .npz files that `splatgraft synth lights` wrote, or one such file."""
    out: Path = Path("light")
    """Folder for light.safetensors and held_out.json, the errors on scenes that were left out."""
    training: LightTrainingOptions = field(default_factory=LightTrainingOptions)

    def execute(self, console: Console) -> int:
        """Train, write the weights, and say what they are worth on scenes that were left out."""
        files = [self.examples] if self.examples.is_file() else sorted(self.examples.glob("*.npz"))
        if not files:
            raise ValueError(f"{self.examples}: expected .npz files as `splatgraft synth lights` writes, found none")
        examples = [example for file in files for example in read_examples(file)]
        with console.bar("train") as progress:
            trained = train_light(examples, self.training, say=console.say, progress=progress)
        self.out.mkdir(parents=True, exist_ok=True)
        found = _held_out(examples, trained)
        (self.out / "held_out.json").write_text(json.dumps(found, indent=1) + "\n")
        notes = {
            "scenes": str(len({one.scene for one in examples})),
            "examples": str(len(examples)),
            "steps": str(self.training.steps),
            "seed": str(self.training.seed),
        }
        path = self.out / WEIGHTS_FILE
        write_ensemble(path, trained.ensemble, notes)
        for name, values in found.items():
            console.say(f"{name}: " + ", ".join(f"{key} {value:.3f}" for key, value in values.items()))
        console.result(path)
        return 0


def _held_out(examples: list[LightExample], trained: TrainedLight) -> dict[str, dict[str, float]]:
    """Mean errors in stops of scenes left out, by the network that left them out, for new and old places."""
    found = {}
    for side in ("new", "old"):
        which = torch.tensor([one.side.endswith(side) for one in examples])
        for name, errors in (("uncorrected", trained.before), ("corrected", trained.after)):
            found[f"{side} places, {name}"] = {
                "irradiance": float(errors.total[which].mean()),
                "level": float(errors.level[which].abs().mean()),
                "tint": float(errors.tint[which].norm(dim=1).mean()),
            }
    factors = zip(("level", "change", "tint"), trained.ensemble.sd_factors, strict=True)
    found["error over what the networks claimed, by which their claims are multiplied"] = dict(factors)
    found["share of a correction that is applied"] = {"share": trained.ensemble.applied}
    for name, shares in (("uncorrected", trained.shares_before), ("corrected", trained.ensemble.shares)):
        found[f"share of ratios between places that is applied, {name}"] = asdict(shares)
    return found


COMMAND = TrainLight
