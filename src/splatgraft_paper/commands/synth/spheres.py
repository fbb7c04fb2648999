"""The command `synth spheres`: training pairs in closed form, to learn training with the recipe `tiny`."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatgraft.project.folder_lock import locked
from splatgraft.project.step import Positional
from splatgraft.runtime.console import Console
from splatgraft.workflow.image_size import parse_image_size
from splatgraft_paper.synthesis.spheres import render_spheres
from splatgraft_paper.training.sources.relit_pairs import RECORD_FILE, RelitSample, write_manifest, write_sample


@dataclass(frozen=True)
class SynthSpheres:
    """Render pairs of two balls on a floor without Blender, a fifth of a second each; a killed run is continued."""

    out: Positional
    """Folder for one folder per scene and manifest.jsonl."""
    scenes: int = 400
    """Number of scenes."""
    lights: int = 3
    """Other suns per scene."""
    size: str = "64x48"
    """Pixels, WIDTHxHEIGHT."""
    seed: int = 0
    """Of places, colours and suns."""

    def execute(self, console: Console) -> int:
        """Render the missing scenes."""
        width, height = parse_image_size(self.size)
        self.out.mkdir(parents=True, exist_ok=True)
        with locked(self.out), console.bar("spheres") as progress:
            for number in range(self.scenes):
                folder = self.out / f"{number:05d}"
                if not (folder / RECORD_FILE).is_file():
                    shown = render_spheres(
                        self.seed * 1_000_003 + number, width=width, height=height, lights=self.lights
                    )
                    relit = [_tensor(picture) for picture in shown.relit]
                    sample = RelitSample(_tensor(shown.target), _tensor(shown.background), _tensor(shown.mask), relit)
                    write_sample(folder, sample, {"group": folder.name, "licence": "own render"})
                progress(number + 1, self.scenes, folder.name)
            count = write_manifest(self.out)
        console.say(f"{count} scenes with {self.lights} pairs each")
        console.result(self.out / "manifest.jsonl")
        return 0


def _tensor(picture: np.ndarray) -> Float[Tensor, "h w *c"]:
    return torch.from_numpy(np.ascontiguousarray(picture)).float()


COMMAND = SynthSpheres
