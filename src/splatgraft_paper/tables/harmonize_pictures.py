"""Harmonised pictures without a 3D scene, kept one by one: for Table 3, the check of the release and the 2D sheet."""

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Protocol

from jaxtyping import Float
from torch import Tensor

from splatgraft.core.images import write_image
from splatgraft.harmonization import HarmonizerContext, HarmonizerInputs, HarmonizerOptions, make_harmonizer
from splatgraft.project.step import Context, Device, Inputs, choose_device
from splatgraft.runtime.progress import Progress
from splatgraft.steps.harmonize import method_record, weight_files


class PictureInputs(Protocol):
    """One picture to harmonise, in files."""

    @property
    def files(self) -> tuple[Path, ...]:
        """Files from which the picture is made."""
        ...

    def read(self) -> HarmonizerInputs:
        """Read the images."""
        ...


@dataclass(frozen=True)
class HarmonizePictures:
    """Pictures by one method; those that a killed run made are kept."""

    pictures: tuple[PictureInputs, ...]
    names: tuple[str, ...]
    """File name of each picture, without suffix."""
    method: HarmonizerOptions
    out: Path
    """Folder for images/."""
    device: Device = "auto"

    def inputs(self) -> Inputs:
        """List the files of the pictures and of the weights."""
        return {"pictures": tuple(f for one in self.pictures for f in one.files), "weights": weight_files(self.method)}

    def recorded_options(self) -> dict[str, Any]:
        """Return the method and the names of the pictures."""
        return {"harmonizer": method_record(self.method), "names": list(self.names)}

    def write(self, folder: Path, context: Context) -> None:
        """Harmonise what an earlier run did not."""

        @cache
        def harmonizer() -> Any:
            device = choose_device(self.device, context.console)
            height, width = self.pictures[0].read().mask.shape
            workload = HarmonizerContext(device, len(self.pictures), height * width, say=context.console.say)
            return make_harmonizer(self.method, workload)

        def make(index: int) -> Float[Tensor, "h w 3"]:
            return harmonizer().harmonize(self.pictures[index].read())

        kept = context.checkpoint.folder / "images"
        keep_pictures(kept, self.names, make, context.progress)
        shutil.copytree(kept, folder / "images")


def keep_pictures(
    folder: Path, names: Sequence[str], make: Callable[[int], Float[Tensor, "h w 3"]], progress: Progress
) -> list[Path]:
    """Make the pictures that `folder` lacks, and return the files of all; a killed run continues with the next one."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{name}.png" for name in names]
    for index, path in enumerate(paths):
        if not path.is_file():
            write_image(path, make(index).cpu())
        progress(index + 1, len(paths), path.stem)
    return paths
