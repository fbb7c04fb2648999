"""Options of the training loop: length, optimiser, precision, and intervals of saving and validation."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class LoopOptions:
    """Options of the training loop."""

    steps: int = 50_000
    """Optimiser steps."""
    batch: int = 4
    """Pairs per optimiser step, over all processes together."""
    accumulate: int = 1
    """Passes that a process takes per optimiser step, to save memory."""
    rate: float = 3e-5
    """Learning rate of Adam."""
    warm_up: int = 0
    """Steps over which the rate rises from zero."""
    clip: float = 1.0
    """Largest norm of the gradient; 0 does not clip."""
    ema: float = 0.0
    """Decay of the moving average of the weights, which is then the result; 0 for none."""
    optimizer: Literal["adam", "adam8bit"] = "adam"
    """adam8bit needs bitsandbytes."""
    precision: Literal["no", "bf16", "fp16"] = "bf16"
    """Arithmetic of the network; the optimiser's weights are float32."""
    parallel: Literal["copies", "shards"] = "copies"
    """Several processes: each has all weights, or a share of weights, gradients and optimiser (FSDP 2)."""
    resume: Literal["auto", "never"] = "auto"
    """auto goes on from the folder's last whole state; never refuses a folder with states."""
    save_every: int = 1000
    """Steps between states from which a killed run goes on."""
    validate_every: int = 1000
    """Steps between validations."""
    validation_pairs: int = 8
    """Pairs per validation."""
    seed: int = 0
    """Of the order of pairs, the noise and initial values."""
    tensorboard: bool = False
    """Also write for TensorBoard; needs the package tensorboard."""
    readers: int = 4
    """Threads of each process that read pictures and latents ahead; 0 reads them when they are needed."""
    cpu: bool = False
    """Train on the CPU even if a GPU is available."""

    def rate_at(self, step: int) -> float:
        """Learning rate at a step, counted from 0."""
        return self.rate * min(1.0, (step + 1) / self.warm_up) if self.warm_up else self.rate

    def check(self, processes: int) -> int:
        """Check the options.

        Args:
            processes: number of training processes.

        Returns:
            Pairs per process and pass.

        Raises:
            ValueError: an option is out of range, or the batch cannot be divided evenly.
        """
        for name in ("steps", "batch", "accumulate", "save_every", "validate_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name.replace('_', '-')}: expected at least 1, found {getattr(self, name)}")
        if self.readers < 0:
            raise ValueError(f"--readers: expected a number of threads from 0, found {self.readers}")
        if not 0 <= self.ema < 1:
            raise ValueError(f"--ema: expected a decay from 0 to below 1, found {self.ema}")
        if self.parallel == "shards":
            if self.optimizer == "adam8bit":
                raise ValueError("--optimizer: expected adam with --parallel shards, found adam8bit")
            if self.precision == "fp16":
                raise ValueError("--precision: expected bf16 or no with --parallel shards, found fp16")
        passes = processes * self.accumulate
        if self.batch % passes:
            raise ValueError(
                f"--batch: expected a multiple of {passes} ({processes} processes x --accumulate {self.accumulate}), "
                f"found {self.batch}"
            )
        return self.batch // passes
