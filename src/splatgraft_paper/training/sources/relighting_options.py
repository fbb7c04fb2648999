"""Options of relighting that `synth generated` and `synth orida` share: the relighter and its environment maps."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from splatgraft_paper.training.sources.diffusion_renderer import DiffusionRenderer
from splatgraft_paper.training.sources.generate import Lighting
from splatgraft_paper.training.sources.relighters import Relighter, SilhouetteRelighter


@dataclass(frozen=True)
class RelightingOptions:
    """The relighter and its environment maps."""

    lights: Path = Path("lights")
    """Folder with .hdr environment maps."""
    each: int = 4
    """Lights per image."""
    relighter: Literal["diffusion-renderer", "stand-in"] = "diffusion-renderer"
    """The paper's DiffusionRenderer, in your own installation; or a simple stand-in without a learned model."""
    renderer: Path | None = None
    """Folder of DiffusionRenderer's code."""
    renderer_variant: Literal["svd", "cosmos"] = "svd"
    """Which of its two versions."""
    renderer_python: Path | None = None
    """The Python that runs it; the current one where not given."""

    def open(self, seed: int) -> Lighting:
        """Prepare the relighter and list the maps; `seed` determines the choice of maps.

        Raises:
            ValueError: the relighter or the maps are missing.
        """
        maps = sorted(self.lights.glob("*.hdr")) if self.lights.is_dir() else []
        if not maps:
            raise ValueError(f"{self.lights}: expected a folder with .hdr environment maps (--lights), found none")
        return Lighting(self._relighter(), maps, self.each, seed)

    def _relighter(self) -> Relighter:
        if self.relighter == "stand-in":
            return SilhouetteRelighter()
        if self.renderer is None:
            raise ValueError(
                "--renderer: expected the folder of DiffusionRenderer's code, found none; or --relighter stand-in"
            )
        return DiffusionRenderer(self.renderer, self.renderer_python or Path(sys.executable), self.renderer_variant)
