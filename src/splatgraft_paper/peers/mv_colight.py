"""MV-CoLight's single-view network (Ren et al. 2025), run in the user's own checkout and Python environment.

A small program runs there and exchanges arrays through files. The input is prepared as in the authors' data set
classes: the shorter side becomes 256 pixels and a square is cut out. The authors keep the middle square; here several
squares cover the view and their changes are blended. Untested with the real code and weights.
"""

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.images import resize
from splatgraft.harmonization.interface import Harmonizer, HarmonizerContext, HarmonizerInputs
from splatgraft.runtime.process import last_line, run_logged

SIDE = 256
"""Width and height of the network's pictures, pixels, as in its training."""
RATIO_OFFSET = 0.02
"""Offset on both sides of the ratio of the network's output and input, sRGB, against noise in dark pixels."""

# runs in the other project's Python, in its folder, as `python - MODEL_FOLDER INPUT.npy OUTPUT.npy`
_PROGRAM = """
import glob, os, sys
import numpy as np, torch
from easydict import EasyDict
from omegaconf import OmegaConf
sys.path.insert(0, os.getcwd())
import models
from registry import MODELS, build_module
folder, given, out = sys.argv[1:]
config = EasyDict(OmegaConf.to_container(OmegaConf.load(os.path.join(folder, "config.py")), resolve=True))
config.model.num_in_ch = 7
device = "cuda" if torch.cuda.is_available() else "cpu"
network = build_module(config.model, MODELS).to(device).eval()
newest = max(glob.glob(os.path.join(folder, "model_step_*.pt")), key=lambda name: int(name.split("_")[-1][:-3]))
network.load_state_dict(torch.load(newest, map_location=device)["model_state_dict"])
with torch.no_grad():
    made = [network(square.to(device)[None, None]) for square in torch.from_numpy(np.load(given))]
np.save(out, np.stack([one.reshape(3, *one.shape[-2:]).float().cpu().numpy() for one in made]))
"""


@dataclass(frozen=True)
class MVCoLightOptions:
    """MV-CoLight's network for single pictures (Ren et al. 2025), run in your own checkout of its code."""

    name: ClassVar[str] = "mv-colight"

    weights: str | None = None
    """Folder with config.py and model_step_N.pt; required."""
    checkout: Path | None = None
    """Folder of its code; required."""

    def make(self, context: HarmonizerContext) -> Harmonizer:
        """Find the folders."""
        if self.checkout is None or not (self.checkout / "registry.py").is_file():
            raise ValueError(
                "harmonizer mv-colight: expected --checkout with the code of github.com/InternRobotics/MV-CoLight, "
                f"found {self.checkout or 'none'}"
            )
        weights = Path(self.weights or "")
        if not (weights / "config.py").is_file() or not list(weights.glob("model_step_*.pt")):
            raise ValueError(
                "harmonizer mv-colight: expected --weights FOLDER with config.py and model_step_N.pt, found "
                f"{self.weights or 'none'}"
            )
        interpreter = self.checkout / ".venv" / "bin" / "python"
        return MVCoLight(self.checkout, weights.resolve(), interpreter if interpreter.is_file() else Path("python"))


@dataclass(frozen=True)
class MVCoLight:
    """The network, run in a new process for each view."""

    checkout: Path
    weights: Path
    python: Path
    """Interpreter that runs the network."""

    def harmonize(self, view: HarmonizerInputs) -> Float[Tensor, "h w 3"]:
        """Multiply the composite by the ratio of the network's output and input, upsampled from the network's size."""
        height, width = view.mask.shape
        small = network_input(view)
        with tempfile.TemporaryDirectory() as name:
            given, out = Path(name) / "input.npy", Path(name) / "output.npy"
            np.save(given, small.numpy())
            command = [str(self.python), "-", str(self.weights), str(given), str(out)]
            log = Path(name) / "log"
            # standard output is not logged, so that the last line of the log is the error's
            code = run_logged(command, log, folder=self.checkout, stdin=_PROGRAM, on_line=lambda _: None)
            if code != 0 or not out.is_file():
                last = last_line(log) or "no output"
                raise ValueError(f"{self.checkout}: expected MV-CoLight to make a picture, found {last[:200]}")
            made = torch.from_numpy(np.load(out)).clamp(0, 1)
        ratio = (made + RATIO_OFFSET) / (small[:, :3] + RATIO_OFFSET)
        return (view.composite * resize(_joined(ratio, height, width), width, height)).clamp(0, 1)


def network_input(view: HarmonizerInputs) -> Float[Tensor, "k 7 256 256"]:
    """Cut squares of composite, background and depth over its maximum; the shorter side becomes 256 pixels."""
    depth = view.depth / view.depth.max().clamp_min(1e-6)
    rows, columns = _reduced(*view.mask.shape)
    # resized one by one, because OpenCV shrinks at most four channels
    parts = [resize(picture, columns, rows) for picture in (view.composite, view.background, depth[..., None])]
    small = torch.cat(parts, -1).permute(2, 0, 1)
    squares = [small[:, y : y + SIDE, x : x + SIDE] for y in _starts(rows) for x in _starts(columns)]
    return torch.stack(squares).contiguous()


def _reduced(height: int, width: int) -> tuple[int, int]:
    """Compute rows and columns of the view when its shorter side is `SIDE`."""
    scale = SIDE / min(height, width)
    return round(height * scale), round(width * scale)


def _starts(length: int) -> list[int]:
    """List the first pixels of evenly spaced, overlapping squares that cover a side."""
    count = 1 if length == SIDE else length // SIDE + 1
    return [round(i * (length - SIDE) / max(count - 1, 1)) for i in range(count)]


def _joined(squares: Float[Tensor, "k 3 256 256"], height: int, width: int) -> Float[Tensor, "i j 3"]:
    """Blend the squares with tent weights."""
    rows, columns = _reduced(height, width)
    tent = torch.minimum(torch.arange(SIDE) + 1, SIDE - torch.arange(SIDE)).float()
    weight = torch.minimum(tent[:, None], tent[None, :])
    total, weights = torch.zeros(3, rows, columns), torch.zeros(rows, columns)
    places = [(y, x) for y in _starts(rows) for x in _starts(columns)]
    for (y, x), square in zip(places, squares, strict=True):
        total[:, y : y + SIDE, x : x + SIDE] += weight * square
        weights[y : y + SIDE, x : x + SIDE] += weight
    return (total / weights).permute(1, 2, 0)
