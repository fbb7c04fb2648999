"""The log of a training run: one line of JSON per step, validation images, and optionally TensorBoard."""

import json
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from splatgraft.core.images import write_image
from splatgraft.runtime.atomic_file import atomic_write

LOG_FILE = "log.jsonl"
VALIDATION_FOLDER = "validation"
_SMOOTHING_STEPS = 50


class TrainingLog:
    """The open log of a running training."""

    def __init__(self, folder: Path, tensorboard: bool) -> None:
        """Append to the folder's log.

        Raises:
            ValueError: TensorBoard is requested and not installed.
        """
        self.smooth = float("nan")
        """Exponential moving average of the loss over about 50 steps; nan before the first."""
        self._folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        (folder / VALIDATION_FOLDER).mkdir(exist_ok=True)
        self._log = (folder / LOG_FILE).open("a")
        self._board: Any = None
        if tensorboard:
            if find_spec("tensorboard") is None:
                raise ValueError(
                    "--tensorboard: expected the package tensorboard (pip install tensorboard), found none"
                )
            from torch.utils.tensorboard import SummaryWriter

            self._board = SummaryWriter(str(folder / "tensorboard"))

    def add(self, step: int, loss: float, rate: float) -> None:
        """Log one step."""
        self.smooth = loss if self.smooth != self.smooth else self.smooth + (loss - self.smooth) / _SMOOTHING_STEPS
        self._write({"step": step, "loss": loss, "rate": rate})
        if self._board:
            self._board.add_scalar("loss", loss, step)

    def add_validation(self, step: int, metrics: dict[str, float], sheet: Float[Tensor, "h w 3"]) -> None:
        """Log the metrics of a validation and write its contact sheet."""
        self._write({"step": step, "validation": metrics})
        write_image(self._folder / VALIDATION_FOLDER / f"{step:08d}.png", sheet)
        if self._board:
            for name, value in metrics.items():
                self._board.add_scalar(f"validation/{name}", value, step)
            self._board.add_image("validation", sheet.clamp(0, 1), step, dataformats="HWC")

    def close(self) -> None:
        """Close the log."""
        self._log.close()
        if self._board:
            self._board.close()

    def _write(self, entry: dict[str, Any]) -> None:
        self._log.write(json.dumps(entry) + "\n")
        self._log.flush()


def read_losses(path: Path) -> list[float]:
    """Read the loss of each step, in order.

    Raises:
        ValueError: the log is missing or broken.
    """
    try:
        entries = [json.loads(line) for line in path.read_text().splitlines()]
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: expected the log of a training, found {error}") from error
    return [entry["loss"] for entry in entries if "loss" in entry]


def truncate_log(path: Path, step: int) -> None:
    """Remove the entries after `step`, which a resumed run will write again."""
    if not path.is_file():
        return
    remaining = []
    for line in path.read_text().splitlines():
        try:
            if json.loads(line)["step"] <= step:
                remaining.append(line)
        except (ValueError, KeyError, TypeError):
            continue  # an incomplete line of a killed run
    with atomic_write(path) as stream:
        stream.write("".join(f"{line}\n" for line in remaining).encode())
