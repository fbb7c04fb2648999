"""The command `init`: a folder with a commented project.toml."""

import json
import os
from dataclasses import dataclass
from pathlib import Path

from splatgraft.project import PROJECT_FILE
from splatgraft.steps.project_file import TEMPLATE
from splatgraft.steps.step import Positional
from splatgraft.steps.terminal import Terminal
from splatgraft.whole_file import whole_file


@dataclass(frozen=True)
class Init:
    """Write a commented project.toml."""

    folder: Positional
    """The project's folder; made where it does not exist."""
    source: Path
    """The capture with the object: photos, a video, a COLMAP folder or a folder with transforms.json."""
    target: Path
    """The capture that receives it."""

    def execute(self, terminal: Terminal) -> int:
        """Write the file; one that is there is never replaced."""
        path = self.folder / PROJECT_FILE
        if path.exists():
            raise ValueError(f"{path}: expected no project here yet, found one")
        for capture in (self.source, self.target):
            if not capture.exists():
                raise ValueError(f"{capture}: expected photos, a video or a posed capture, found nothing")
        self.folder.mkdir(parents=True, exist_ok=True)
        # a JSON string is a TOML string
        source, target = (json.dumps(os.path.relpath(capture, self.folder)) for capture in (self.source, self.target))
        with whole_file(path) as stream:
            stream.write(TEMPLATE.replace("{source}", source).replace("{target}", target).encode())
        terminal.result(path)
        return 0


COMMAND = Init
