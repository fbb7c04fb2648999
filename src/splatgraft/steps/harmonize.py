"""The command `harmonize`: rendered views become harmonised views, one image each."""

import shutil
from dataclasses import dataclass
from pathlib import Path

from splatgraft.harmonize import make_harmonizer
from splatgraft.images import write_image
from splatgraft.steps.step import Context, Inputs, Positional
from splatgraft.steps.view_images import ViewFolder


@dataclass(frozen=True)
class Harmonize:
    """Make the light of each view agree; views that a killed run finished are kept."""

    views: Positional
    """The folder that `splatgraft render` wrote for a composite."""
    out: Path = Path("harmonized")
    """Folder for images/, and confidence/ where the method says how far it trusts itself."""
    method: str = "none"
    """none (keep the light prior), reinhard (a baseline), or another that is installed."""

    def inputs(self) -> Inputs:
        """All pictures of all views."""
        return {"views": ViewFolder.open(self.views).files()}

    def write(self, folder: Path, context: Context) -> None:
        """Make one image per view."""
        views, harmonizer = ViewFolder.open(self.views), make_harmonizer(self.method)
        kept = context.checkpoint.folder
        for name in ("images", "confidence"):
            (kept / name).mkdir(exist_ok=True)
        for index, stem in enumerate(views.stems):
            image = kept / "images" / f"{stem}.png"
            if not image.is_file():
                done = harmonizer.harmonize(views.read(index))
                if done.confidence is not None:
                    write_image(kept / "confidence" / f"{stem}.png", done.confidence)
                write_image(image, done.image)  # last: it says that the view is done
            context.progress(index + 1, len(views), stem)
        for name in ("images", "confidence"):
            if any((kept / name).iterdir()):
                shutil.copytree(kept / name, folder / name)


COMMAND = Harmonize
