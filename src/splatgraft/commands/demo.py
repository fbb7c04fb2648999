"""The command `demo`: a whole transfer on two captures that come with the package."""

from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path

from splatgraft.project.layout import PROJECT_FILE
from splatgraft.project.step import Positional
from splatgraft.runtime.console import Console
from splatgraft.runtime.files import atomic_write
from splatgraft.segmentation import SolidifyOptions
from splatgraft.workflow.run import run_steps

CAPTURES_FOLDER = "captures"
"""Folder of the two captures, inside the demo's folder."""

_PROJECT = """\
# The project of `splatgraft demo`: photographed bananas are moved onto a rendered kitchen table.

[source]
capture = "captures/bananas"

[target]
capture = "captures/table"

[reconstruct]
iterations = {iterations}
budget = {budget}

[source.reconstruct]
iterations = {source_iterations}
{segment}
[compose]
scale = 1.0  # both captures are in metres

[evaluate]
width = {width}
frames = 32
"""


@dataclass(frozen=True)
class Demo:
    """Move photographed bananas onto a rendered kitchen table, on captures that come with the package: 3 minutes on two
    cores, nothing is downloaded."""

    folder: Positional = Path("splatgraft_demo")
    """Folder of the project, made if it does not exist; 150 MB at the end of the demo."""
    width: int = 1280
    """Width of the report's pictures, pixels."""
    iterations: int = 2000
    """Training steps of the table; the bananas take half, and the object's second fit takes at most this many."""
    budget: int = 30_000
    """Maximum number of Gaussians of each scene."""

    def execute(self, console: Console) -> int:
        """Write the project and run it; finished steps of an earlier, killed demo are kept."""
        project = self.folder / PROJECT_FILE
        lengths = {"iterations": self.iterations, "source_iterations": max(1, self.iterations // 2)}
        segment = f"\n[segment]\nsolidify = {self.iterations}\n" if self.iterations < SolidifyOptions.iterations else ""
        text = _PROJECT.format(**lengths, budget=self.budget, width=self.width, segment=segment)
        if project.exists() and project.read_text(encoding="utf-8") != text:
            raise ValueError(f"{project}: expected no project, or a demo with the same options; found another")
        copy_captures(self.folder / CAPTURES_FOLDER)
        with atomic_write(project) as stream:
            stream.write(text.encode())
        console.say(f"{project}: 16 photographs of bananas and 28 views of a kitchen become one scene")
        run_steps(project, console)
        console.say("next, with your own photos: splatgraft init PROJECT --source PHOTOS --target PHOTOS")
        return 0


def copy_captures(folder: Path) -> None:
    """Copy the captures that come with the package to `folder`; existing files are kept."""
    with as_file(files("splatgraft") / "demo_captures") as shipped:
        for source in shipped.rglob("*"):
            target = folder / source.relative_to(shipped)
            if source.is_file() and not target.exists():
                target.parent.mkdir(parents=True, exist_ok=True)
                with atomic_write(target) as stream:
                    stream.write(source.read_bytes())


COMMAND = Demo
