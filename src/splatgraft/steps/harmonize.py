"""The command `harmonize`: make one harmonised image of each rendered view."""

import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import subcommand

from splatgraft.folders.harmonized_views import (
    Part,
    finished,
    harmonize_part,
    harmonize_with_processes,
    harmonize_with_ray,
)
from splatgraft.folders.view_folder import ViewFolder
from splatgraft.harmonization import EditOptions, FluxOptions, HarmonizerOptions, NoneOptions
from splatgraft.project.step import Context, Device, Inputs, Positional, plain_options

_WEIGHTS = ("weights", "base", "model", "lora")  # options of the methods that name weights
_WEIGHT_SUFFIXES = (".json", ".safetensors", ".bin")  # a training's folder also holds logs and pictures


@dataclass(frozen=True)
class Harmonize:
    """Make the light of each view agree, by an image model; finished views of a killed run are kept."""

    views: Positional
    """The folder that `splatgraft render` wrote for a composite."""
    out: Path = Path("harmonized")
    """Folder for images/."""
    method: (
        Annotated[NoneOptions, subcommand("none")]
        | Annotated[FluxOptions, subcommand("flux")]
        | Annotated[EditOptions, subcommand("edit")]
    ) = field(default_factory=NoneOptions)
    """The image model; its options are further keys of the table, or options of the sub-command."""
    device: Device = "auto"
    """Device to compute on."""
    processes: int = 1
    """Number of GPUs of this machine, or with --ray of workers anywhere, that share the views."""
    ray: str | None = None
    """Address of a Ray cluster whose machines all see the folders."""

    def inputs(self) -> Inputs:
        """Return all pictures of all views, and the files of weights on this machine; hub ids are options."""
        return {"views": ViewFolder.open(self.views).files(), "weights": weight_files(self.method)}

    def recorded_options(self) -> dict[str, Any]:
        """Return the options for step.json."""
        return method_record(self.method)

    def write(self, folder: Path, context: Context) -> None:
        """Write one image per view."""
        kept, views = context.checkpoint.folder, ViewFolder.open(self.views)
        (kept / "images").mkdir(exist_ok=True)
        whole = Part(self.views, self.method, kept, device=self.device)
        if self.ray is not None:
            harmonize_with_ray(whole, self.processes, address=self.ray, progress=context.progress)
        elif self.processes > 1:
            harmonize_with_processes(whole, self.processes, say=context.console.say, progress=context.progress)
        else:
            harmonize_part(whole, context.console.say, context.progress)
        missing = len(views) - len(finished(kept, views))
        if missing:
            raise ValueError(f"{self.views}: expected {len(views)} harmonised views, found {missing} missing")
        shutil.copytree(kept / "images", folder / "images")


def method_record(method: HarmonizerOptions) -> dict[str, Any]:
    """Return a method's name and its own options as plain JSON."""
    lora = getattr(method, "lora", None)
    # plain options omit paths, but `consolidate` with updates needs this one to make the method again
    given = {} if lora is None else {"lora": str(lora.resolve())}
    return plain_options({"method": method.name, **vars(method)}) | given


def weight_files(method: HarmonizerOptions) -> tuple[Path, ...]:
    """List the files of weights on this machine that a method names; hub ids are options."""
    named = [path for name in _WEIGHTS if (path := getattr(method, name, None)) is not None]
    return tuple(file for path in named for file in _files_of(path))


def _files_of(named: Path | str) -> list[Path]:
    """List the files of a file or folder of weights; none of a hub id."""
    path = Path(named)
    if path.is_dir():
        return [file for file in sorted(path.rglob("*")) if file.suffix in _WEIGHT_SUFFIXES]
    return [path] if path.is_file() or isinstance(named, Path) else []


COMMAND = Harmonize
