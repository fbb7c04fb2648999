"""What the COLMAP process is told, and what it tells its parent: lines `PHASE MESSAGE` for the bar, `- SENTENCE`."""

import time
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

PHASES = ("features", "matching", "mapping", "refinement")
MIN_TRACK = 3
"""Photos that must see a point for it to count; two photos make a point of any false match."""
MAX_ERROR_PX = 1.5
"""Largest mean reprojection error of a point that counts."""


@dataclass(frozen=True)
class Job:
    """What is to be posed, how, and where the process keeps what a killed run leaves to the next."""

    photos: str
    """Folder of the working copies."""
    masks: str
    """Folder of masks, NAME.jpg.png for NAME.jpg, black where features do not count; empty where there is none."""
    scratch: str
    """Folder for databases and models; what lies there from a run of the same job is used."""
    thorough: bool
    """Whether to find more features, and to match them with a wider limit."""
    groups: list[list[str]]
    """File names of the photos that share a camera."""
    exhaustive: bool
    """Whether all pairs of photos are compared, or neighbours in name order."""
    threads: int
    """CPU threads."""
    seed: int
    """Seed of the random choices of matching and mapping."""

    @property
    def names(self) -> list[str]:
        """File names of all photos, sorted."""
        return sorted(name for group in self.groups for name in group)

    @property
    def folder(self) -> Path:
        """`scratch` as a path."""
        return Path(self.scratch)

    @property
    def output(self) -> Path:
        """The file for the best model."""
        return self.folder / "best.json"


def say(sentence: str) -> None:
    """Tell the parent a sentence for people."""
    print(f"- {sentence}", flush=True)


@dataclass
class Clock:
    """Seconds per phase."""

    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PHASES, 0.0))
    """Wall-clock time."""
    cpu_seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PHASES, 0.0))
    """CPU time of all threads."""
    pairs: int = 0
    """Pairs matched so far."""

    @contextmanager
    def phase(self, name: str) -> Generator[None]:
        """Count the time of the block, and say that it begins."""
        print(f"{PHASES.index(name)} {name}", flush=True)
        start, cpu_start = time.monotonic(), time.process_time()
        try:
            yield
        finally:
            self.seconds[name] += time.monotonic() - start
            self.cpu_seconds[name] += time.process_time() - cpu_start

    @property
    def seconds_per_pair(self) -> float:
        """Seconds that matching takes per pair; 0 where none was measured."""
        return self.seconds["matching"] / self.pairs if self.pairs else 0.0
