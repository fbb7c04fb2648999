"""The command `paper compare`: a view of each scene by several image models, as in the paper's figure of 2D results."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from jaxtyping import Float
from torch import Tensor

from splatgraft.core.images import read_mask, read_rgb, resize, write_image
from splatgraft.evaluation import side_by_side
from splatgraft.folders.view_folder import PICTURES, ViewFolder
from splatgraft.harmonization import HarmonizerInputs
from splatgraft.project.step import Device, locked
from splatgraft.runtime.console import Console
from splatgraft_paper.benchmark.scene import perform_if_stale
from splatgraft_paper.peers.methods import OptionWords, named_options
from splatgraft_paper.tables.harmonize_pictures import HarmonizePictures
from splatgraft_paper.tables.report import stacked

_ROW_HEIGHT = 300  # height of a picture on the sheet, pixels


@dataclass(frozen=True)
class _View:
    """One view of a folder that `splatgraft render` wrote."""

    folder: Path
    index: int

    @property
    def files(self) -> tuple[Path, ...]:
        """Files of the view."""
        views = ViewFolder.open(self.folder)
        return tuple(views.path(name, self.index) for name in PICTURES)

    def read(self) -> HarmonizerInputs:
        """Read the view."""
        return ViewFolder.open(self.folder).read(self.index)


@dataclass(frozen=True)
class Compare:
    """Harmonise one view of each scene by several methods; finished pictures are kept, so a service is paid once."""

    views: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders that `splatgraft render` wrote, such as PROJECT/views or scenes/NAME/views/off of `paper benchmark`."""
    out: Path = Path("comparison")
    """Folder for sheet.png and the pictures."""
    methods: tuple[str, ...] = ("flux:weights=dot3d",)
    """HARMONIZER[:KEY=VALUE,..], such as lbm, mv-colight:checkout=DIR,weights=DIR, image-editing:max_cost=1."""
    view: str | None = None
    """Name of the view; default: the one in which the object is largest."""
    device: Device = "auto"

    def execute(self, console: Console) -> int:
        """Make the missing pictures and the sheet; return 1 if a method could not run."""
        methods = {text: OptionWords.parse(text) for text in self.methods}
        names = [words.name for words in methods.values()]
        rows, failed = [], []
        with locked(self.out):
            for number, folder in enumerate(self.views):
                view = _View(folder, self._chosen(ViewFolder.open(folder)))
                shown = view.read()
                cells = {"background": shown.background, "composite": shown.composite}
                for text, words in methods.items():
                    out = self.out / f"{number}_{folder.resolve().parent.name}" / words.folder_name
                    try:
                        step = HarmonizePictures((view,), ("view",), named_options(words), out, self.device)
                        perform_if_stale(step, console)
                        cells[words.name if names.count(words.name) == 1 else text] = read_rgb(
                            out / "images" / "view.png"
                        )
                    except (ValueError, ModuleNotFoundError) as error:
                        failed.append(f"{folder}, {text}: {' '.join(str(error).split())}")
                rows.append(side_by_side(list(map(_small, cells.values())), list(cells)))
            write_image(self.out / "sheet.png", stacked(rows))
        for line in failed:
            console.say(line)
        console.result(self.out / "sheet.png")
        return 1 if failed else 0

    def _chosen(self, views: ViewFolder) -> int:
        if self.view is None:
            areas = [float(read_mask(views.path("mask", index)).mean()) for index in range(len(views))]
            return max(range(len(views)), key=areas.__getitem__)
        if self.view not in views.stems:
            raise ValueError(f"{views.folder}: expected the view {self.view}, found {', '.join(views.stems[:8])} ..")
        return views.stems.index(self.view)


def _small(image: Float[Tensor, "h w 3"]) -> Float[Tensor, "300 _ 3"]:
    return resize(image, round(image.shape[1] * _ROW_HEIGHT / image.shape[0]), _ROW_HEIGHT)
