"""The command `synth sheet`: one picture with all scenes of a folder."""

from dataclasses import dataclass
from pathlib import Path

import torch

from splatgraft.core.images import read_rgb, resize, write_image
from splatgraft.project.step import Positional
from splatgraft.runtime.console import Console


@dataclass(frozen=True)
class SynthSheet:
    """Write one picture with all scenes of a folder."""

    out: Positional
    """The folder that `synth pairs` or `synth benchmark` wrote."""
    picture: Path | None = None
    """Where to write it; sheet.png in the folder where not given."""
    columns: int = 6
    """Pictures side by side."""
    width: int = 240
    """Pixels of one picture."""

    def execute(self, console: Console) -> int:
        """Write the sheet."""
        paths = sorted(self.out.glob("*/object*/0002.png")) or sorted(self.out.glob("*/ground_truth/images/0002.png"))
        paths = [path for path in paths if "_light" not in path.parent.name]
        if not paths:
            raise ValueError(f"{self.out}: expected rendered pairs or benchmark scenes, found none")
        pictures = [read_rgb(path) for path in paths]
        height = round(self.width * pictures[0].shape[0] / pictures[0].shape[1])
        small = [resize(picture, self.width, height) for picture in pictures]
        small += [torch.ones(height, self.width, 3)] * (-len(small) % self.columns)
        rows = [torch.cat(small[i : i + self.columns], 1) for i in range(0, len(small), self.columns)]
        target = self.picture or self.out / "sheet.png"
        write_image(target, torch.cat(rows, 0))
        console.result(target)
        return 0


COMMAND = SynthSheet
