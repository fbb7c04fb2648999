"""The command `harmonize`: rendered views become harmonised views, one image each."""

import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from splatgraft.folders.harmonized_views import Part, finished, harmonize_part, harmonize_parts, picture_folders
from splatgraft.folders.view_folder import ViewFolder
from splatgraft.harmonization import HARMONIZERS
from splatgraft.project.step import Context, Device, Inputs, Positional

_KEY_VARIABLE = "SPLATGRAFT_IMAGE_EDITING_KEY"


@dataclass(frozen=True)
class Harmonize:
    """Make the light of each view agree; views that a killed run finished are kept."""

    views: Positional
    """The folder that `splatgraft render` wrote for a composite."""
    out: Path = Path("harmonized")
    """Folder for images/, and confidence/ where the method says how far it trusts itself."""
    method: str = "none"
    """none (keeps the prior), compact (a small network of ours), reinhard (a baseline), flux (the paper's); lbm,
    ic-light, mv-colight, image-editing."""
    weights: str | None = None
    """Folder, file or hub id of the method's weights, such as nviolante/dot3d/image-mask for flux."""
    base: str | None = None
    """Folder or hub id of the model that the weights were trained from, for what they lack."""
    lora: Path | None = None
    """flux: a low-rank adaptation (lora.safetensors) to merge in."""
    variant: Literal["auto", "image-mask", "image-background"] = "auto"
    """flux: what the network is given beside the composite; by the weights' folder where auto."""
    checkout: Path | None = None
    """mv-colight: the folder of its code."""
    seed: int = 0
    """Of what is drawn at random; the same for all views."""
    sampling_steps: int = 4
    """flux: of the sampling."""
    strength: float = 1.0
    """flux: how far the object's material may change; 0 lets only its light change. compact: how much is corrected."""
    detail: float = 0.0
    """flux: 1 lays the network's light onto the composite's own pixels, 0 keeps the network's pixels."""
    precision: Literal["auto", "bf16", "fp8", "nf4", "offload", "float32"] = "auto"
    """flux: of the weights; auto takes the best that fits the free memory."""
    device: Device = "auto"
    batch: int = 1
    """Views at once, where the method can."""
    compile: bool = False
    """flux: compile the network first; pays from some twenty views on."""
    processes: int = 1
    """GPUs of this machine, or with --ray workers anywhere, over which the views are split."""
    ray: str | None = None
    """Address of a Ray cluster whose machines all see the folders."""
    max_cost: float = 0.0
    """image-editing: US dollars that may be spent at most."""

    def inputs(self) -> Inputs:
        """All pictures of all views, and what small files say which weights these are."""
        files: dict[str, tuple[Path, ...]] = {"views": ViewFolder.open(self.views).files()}
        if self.lora is not None:
            files["lora"] = (self.lora,)
        if self.weights is not None and Path(self.weights).is_dir():
            files["weights"] = tuple(sorted(Path(self.weights).glob("**/*.json")))
        return files

    def write(self, folder: Path, context: Context) -> None:
        """Make one image per view."""
        if self.method not in HARMONIZERS:
            raise ValueError(f"--method: expected one of {', '.join(sorted(HARMONIZERS))}, found {self.method!r}")
        kept, views = context.checkpoint.folder, ViewFolder.open(self.views)
        picture_folders(kept)
        whole = Part(self, kept, key=os.environ.get(_KEY_VARIABLE))
        if self.processes > 1 or self.ray is not None:
            harmonize_parts(whole, console=context.console, progress=context.progress)
        else:
            harmonize_part(whole, context.console.say, context.progress)
        missing = len(views) - len(finished(kept, views))
        if missing:
            raise ValueError(f"{self.views}: expected {len(views)} harmonised views, found {missing} missing")
        for name in ("images", "confidence"):
            if any((kept / name).iterdir()):
                shutil.copytree(kept / name, folder / name)


COMMAND = Harmonize
