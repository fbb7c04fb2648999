"""The command `weights verify`: fetched weights compared with the hashes that the hub gave."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from splatgraft.runtime.console import Console
from splatgraft.runtime.weights.catalogue import CATALOGUE, find_model
from splatgraft.runtime.weights.store import check_files, folder_of, home, read_stored


@dataclass(frozen=True)
class WeightsVerify:
    """Compare all files of fetched weights with their recorded size and SHA-256; 1 where any differs."""

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = field(default_factory=tuple)
    """Names of `splatgraft weights list`, or folders; everything that was fetched where none is given."""

    def execute(self, console: Console) -> int:
        """Print one line per folder, and one per file that is not as it should be."""
        faults = 0
        for folder in self._folders():
            stored = read_stored(folder)
            if stored is None:
                raise ValueError(f"{folder}: expected weights that `splatgraft weights fetch` brought, found none")
            with console.bar(stored.repository) as progress:
                lines = check_files(folder, stored.files, progress=progress)
            for line in lines:
                console.result(line)
            hashed = sum(file.sha256 is not None for file in stored.files)
            state = f"{len(lines)} files differ" if lines else "all as recorded"
            console.result(f"{stored.repository}: {len(stored.files)} files, {hashed} of them by hash; {state}")
            faults += len(lines)
        return 1 if faults else 0

    def _folders(self) -> list[Path]:
        if not self.names:
            return sorted(path for path in home().glob("*") if read_stored(path) is not None)
        known = {model.name for model in CATALOGUE}
        return [_folder(name) if name in known or not Path(name).is_dir() else Path(name) for name in self.names]


def _folder(name: str) -> Path:
    model = find_model(name)
    return folder_of(model.repository or model.name)


COMMAND = WeightsVerify
