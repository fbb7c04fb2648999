"""The command `consolidate`: fit the colours of a scene to harmonised views."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from splatgraft.consolidation import ConsolidateOptions, consolidate
from splatgraft.core.images import read_rgb
from splatgraft.folders.view_folder import ViewFolder
from splatgraft.formats import read_gaussians, write_gaussians
from splatgraft.project.layout import SCENE_FILE
from splatgraft.project.step import Context, Device, Inputs, choose_device
from splatgraft.rendering import RenderOptions
from splatgraft.runtime.lazy_sequence import LazySequence


@dataclass(frozen=True)
class Consolidate:
    """Fit the colours of a scene (all SH bands) to harmonised views; geometry and opacity stay fixed."""

    scene: Path
    """The composite, or the relit composite, a .ply."""
    views: Path
    """The folder that `splatgraft render` wrote, for its cameras."""
    images: Path
    """The folder that `splatgraft harmonize` wrote."""
    out: Path = Path("result")
    """Folder for scene.ply."""
    nuisance: Literal["tint-flow", "none"] = "tint-flow"
    """Errors of single views that are solved for together with the colours."""
    passes: int = 12
    """Passes of the gradient descent over all views, after the normal equations."""
    low_pass: Literal["classic", "antialiased"] = "classic"
    """Low-pass filter with which the scene was trained: `antialiased` for mip-splatting and for gsplat's antialiased
    mode."""
    device: Device = "auto"
    """Device of the computation."""

    def inputs(self) -> Inputs:
        """Return the scene, the cameras and the harmonised images."""
        views = ViewFolder.open(self.views)
        return {"scene": (self.scene,), "cameras": views.files()[:1], "images": self._images(views)}

    def write(self, folder: Path, context: Context) -> None:
        """Make scene.ply."""
        device = choose_device(self.device, context.console)
        views = ViewFolder.open(self.views)
        scene = consolidate(
            read_gaussians(self.scene).to(device),
            views.cameras.to(device),
            self.read_images(views, device),
            self.options(),
            progress=context.progress,
        )
        write_gaussians(folder / SCENE_FILE, scene.to("cpu"))

    def options(self) -> ConsolidateOptions:
        """Return the options of the fit."""
        return ConsolidateOptions(
            view_error=self.nuisance == "tint-flow",
            polish_passes=self.passes,
            rendering=RenderOptions(low_pass=self.low_pass),
        )

    def read_images(self, views: ViewFolder, device: torch.device) -> Sequence[Tensor]:
        """Open the harmonised images, which are read on access."""
        images = self._images(views)
        return LazySequence(len(images), lambda index: read_rgb(images[index]).to(device))

    def _images(self, views: ViewFolder) -> tuple[Path, ...]:
        return tuple(self.images / "images" / f"{stem}.png" for stem in views.stems)


COMMAND = Consolidate
