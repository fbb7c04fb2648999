"""Job of the COLMAP process, and its output to the parent: lines `PHASE MESSAGE` for the bar, and `- SENTENCE`."""

import time
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

PHASES = ("features", "matching", "mapping", "refinement")
MIN_TRACK = 3
"""Fewest photos that must see a reliable point; with two, any false match makes a point."""
MIN_INLIERS = 30
"""Fewest points, or verified matches with another photo, for a reliable pose (COLMAP: abs_pose_min_num_inliers)."""
MAX_ERROR_PX = 1.5
"""Largest mean reprojection error of a reliable point, pixels."""


@dataclass(frozen=True)
class Job:
    """Photos to pose, options, and the folder from which a killed run is continued."""

    photos: str
    """Folder of the working copies."""
    masks: str
    """Folder of masks, NAME.jpg.png for NAME.jpg, black where features are ignored; empty string without masks."""
    scratch: str
    """Folder for databases and models; results of an earlier run of the same job are used."""
    thorough: bool
    """Whether more features are found and matched with a wider limit."""
    groups: list[list[str]]
    """File names of the photos that share a camera."""
    exhaustive: bool
    """Whether all pairs of photos are matched from the start, instead of neighbours in name order."""
    threads: int
    """CPU threads."""
    seed: int
    """Seed of the random choices of matching and mapping."""
    camera_model: str = "SIMPLE_RADIAL"
    """COLMAP's name of the lens; EQUIRECTANGULAR for 360-degree panoramas."""
    common_mask: str = ""
    """Mask for all photos, black where no features are found; empty string without one."""

    @property
    def names(self) -> list[str]:
        """File names of all photos, sorted."""
        return sorted(name for group in self.groups for name in group)

    @property
    def folder(self) -> Path:
        """The scratch folder as a path."""
        return Path(self.scratch)

    @property
    def output(self) -> Path:
        """File of the best model."""
        return self.folder / "model.json"


def say(sentence: str) -> None:
    """Send a sentence for the user to the parent process."""
    print(f"- {sentence}", flush=True)


@dataclass
class Clock:
    """Time spent per phase."""

    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PHASES, 0.0))
    """Wall-clock time by phase, seconds."""
    cpu_seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PHASES, 0.0))
    """CPU time of all threads by phase, seconds."""
    pairs: int = 0
    """Pairs matched so far."""

    @contextmanager
    def phase(self, name: str) -> Generator[None]:
        """Announce the phase and add the time of the block to it."""
        print(f"{PHASES.index(name)} {name}", flush=True)
        start, cpu_start = time.monotonic(), time.process_time()
        try:
            yield
        finally:
            self.seconds[name] += time.monotonic() - start
            self.cpu_seconds[name] += time.process_time() - cpu_start

    @property
    def seconds_per_pair(self) -> float:
        """Matching time per pair, seconds; 0 before the first pair."""
        return self.seconds["matching"] / self.pairs if self.pairs else 0.0
