"""Reads the pairs of the coming steps in threads while the network computes.

The pair at each place follows from the seed and the step alone; threads change when a pair is read, not which.
"""

import time
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor

from splatgraft_paper.training.latent_cache import LatentCache, LoadedPair
from splatgraft_paper.training.loop_options import LoopOptions
from splatgraft_paper.training.sources.pair_source import Mixture, Role

_STEPS_AHEAD = 4
"""Steps whose pairs are read while the network computes."""


class PairLoader:
    """The pairs of one training process, step by step."""

    def __init__(
        self, mixture: Mixture, cache: LatentCache, roles: Sequence[Role], *, loop: LoopOptions, rank: int, count: int
    ) -> None:
        """Start the threads.

        Args:
            mixture: From which pairs are drawn.
            cache: Of latents; a pair's pictures are read where theirs are not in it.
            roles: Pictures of a pair that the loss needs.
            loop: Its batch, passes, number of steps and readers.
            rank: Of this process.
            count: Of processes that train together.

        Raises:
            ValueError: An option is out of range.
        """
        self._mixture, self._cache, self._roles, self._loop = mixture, cache, roles, loop
        self.pairs_per_pass = loop.check(count)
        self._rank, self._count = rank, count
        self._threads = ThreadPoolExecutor(loop.readers) if loop.readers else None
        self._reading: deque[list[list[Future[LoadedPair]]]] = deque()
        self.waited = 0.0
        """Seconds that `batches` took so far, in which the network had nothing to do."""

    def positions(self, step: int, number: int) -> range:
        """Positions in the order of the mixture that this process takes in pass `number` of a step."""
        begin = step * self._loop.batch
        begin += (number * self._count + self._rank) * self.pairs_per_pass
        return range(begin, begin + self.pairs_per_pass)

    def batches(self, step: int) -> list[list[LoadedPair]]:
        """The pairs of a step, pass by pass; the following steps are begun. Steps are asked for one after the other.

        Raises:
            ValueError: A pair cannot be read.
        """
        began = time.monotonic()
        try:
            if self._threads is None:
                passes = range(self._loop.accumulate)
                return [[self._read(at) for at in self.positions(step, number)] for number in passes]
            for later in range(step + len(self._reading), min(step + _STEPS_AHEAD, self._loop.steps)):
                self._reading.append(self._begin(later, self._threads))
            return [[future.result() for future in batch] for batch in self._reading.popleft()]
        finally:
            self.waited += time.monotonic() - began

    def close(self) -> None:
        """End the threads, after what they read at this moment."""
        if self._threads is not None:
            self._threads.shutdown(wait=True, cancel_futures=True)

    def _begin(self, step: int, threads: ThreadPoolExecutor) -> list[list[Future[LoadedPair]]]:
        passes = range(self._loop.accumulate)
        return [[threads.submit(self._read, at) for at in self.positions(step, number)] for number in passes]

    def _read(self, position: int) -> LoadedPair:
        return self._cache.load(self._mixture.draw(position), self._roles)
