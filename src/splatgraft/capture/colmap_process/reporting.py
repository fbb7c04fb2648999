"""What the process tells its parent: lines `PHASE MESSAGE` for the bar, lines `- SENTENCE`; and the time per phase."""

import time
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field

PHASES = ("features", "matching", "mapping", "refinement")


def say(sentence: str) -> None:
    """Tell the parent a sentence for people."""
    print(f"- {sentence}", flush=True)


@dataclass
class Clock:
    """Seconds per phase."""

    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PHASES, 0.0))
    """Wall-clock time."""
    cpu_seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PHASES, 0.0))
    """Of all threads."""
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
        """Of matching; 0 where none was measured."""
        return self.seconds["matching"] / self.pairs if self.pairs else 0.0
