"""Checkpoints on disk: the state of a killed run, found again by the next run of the same job."""

import shutil
from typing import Any

from splatgraft.project.job import Job
from splatgraft.runtime.atomic_file import atomic_write


class FolderCheckpoint:
    """A `Checkpoint` with a folder for files; killed runs of one job share it, another job starts with an empty one."""

    def __init__(self, job: Job) -> None:
        """Open the checkpoint of an earlier run of the same job, or start an empty one."""
        self.folder = job.folder.with_name(f".{job.folder.name}.checkpoint")
        key, name = self.folder / "job", job.fingerprint
        if not key.is_file() or key.read_text() != name:
            self.drop()
            self.folder.mkdir(parents=True)
            with atomic_write(key) as stream:
                stream.write(name.encode())

    def load(self) -> dict[str, Any] | None:
        """The last state saved for this job, or None."""
        import torch

        path = self.folder / "state.pt"
        return torch.load(path, weights_only=True) if path.is_file() else None

    def save(self, state: dict[str, Any]) -> None:
        """Replace the saved state atomically."""
        import torch

        with atomic_write(self.folder / "state.pt") as stream:
            torch.save(state, stream)

    def drop(self) -> None:
        """Remove the checkpoint."""
        shutil.rmtree(self.folder, ignore_errors=True)
