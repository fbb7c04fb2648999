"""MV-CoLight's network for single pictures (Ren et al. 2025), in the user's own checkout and Python of it.

A small program of ours runs there and exchanges arrays through files. Not run with the real code where it was written.
"""

import subprocess
import tempfile
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.images import resize
from splatgraft.harmonization.interface import Harmonized, HarmonizerInputs
from splatgraft.harmonization.options import MVCoLightOptions

SIDE = 256
"""Pixels: what the network was trained at."""

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
    made = network(torch.from_numpy(np.load(given)).to(device)[None, None])
np.save(out, made.reshape(3, *made.shape[-2:]).float().cpu().numpy())
"""


class MVCoLight:
    """The network, started once a view: it is small."""

    def __init__(self, checkout: Path, weights: Path, python: Path) -> None:
        """Folders of code and weights, and the Python that runs them."""
        self._checkout, self._weights, self._python = checkout, weights, python

    def harmonize(self, view: HarmonizerInputs) -> Harmonized:
        """The network's change at its size, laid as a ratio onto the composite's pixels.

        Raises: ValueError where the other program fails.
        """
        height, width = view.mask.shape
        small = network_input(view)
        with tempfile.TemporaryDirectory() as name:
            given, out = Path(name) / "input.npy", Path(name) / "output.npy"
            np.save(given, small.numpy())
            command = [str(self._python), "-", str(self._weights), str(given), str(out)]
            done = subprocess.run(
                command, input=_PROGRAM, cwd=self._checkout, capture_output=True, text=True, check=False
            )
            if done.returncode != 0 or not out.is_file():
                last = (done.stderr.strip().splitlines() or ["no output"])[-1]
                raise ValueError(f"{self._checkout}: expected MV-CoLight to make a picture, found {last[:200]}")
            made = torch.from_numpy(np.load(out)).permute(1, 2, 0).clamp(0, 1)
        ratio = (made + 0.02) / (small[:3].permute(1, 2, 0) + 0.02)
        return Harmonized((view.composite * resize(ratio, width, height)).clamp(0, 1))


def network_input(view: HarmonizerInputs) -> Float[Tensor, "7 256 256"]:
    """Composite, background and depth scaled to its own range, at the network's size."""
    depth = view.depth / view.depth.max().clamp_min(1e-6)
    pictures = torch.cat([view.composite, view.background, depth[..., None]], -1)
    return resize(pictures, SIDE, SIDE).permute(2, 0, 1).contiguous()


def load_mv_colight(options: MVCoLightOptions) -> MVCoLight:
    """The adaptor, its folders found.

    Raises: ValueError where one is missing.
    """
    checkout, weights = options.checkout, Path(options.weights or "")
    if checkout is None or not (checkout / "registry.py").is_file():
        raise ValueError(
            "harmonizer mv-colight: expected --checkout with the code of github.com/InternRobotics/MV-CoLight, found "
            f"{checkout or 'none'}"
        )
    if options.weights is None or not (weights / "config.py").is_file() or not list(weights.glob("model_step_*.pt")):
        raise ValueError(
            "harmonizer mv-colight: expected --weights FOLDER with config.py and model_step_N.pt, found "
            f"{options.weights or 'none'}"
        )
    own = checkout / ".venv" / "bin" / "python"
    return MVCoLight(checkout, weights.resolve(), own if own.is_file() else Path("python"))
