"""benchmarks/loader.py at toy size: every row has the pairs of the training's own loader, in its order."""

from dataclasses import replace

import loader
import pytest
import torch

from splatgraft_paper.training.latent_cache import LatentCache
from splatgraft_paper.training.loop_options import LoopOptions
from splatgraft_paper.training.pair_loader import PairLoader
from splatgraft_paper.training.sources.packed_pairs import PackedPairs, pack_pairs
from splatgraft_paper.training.sources.pair_source import split_mixture

TOY = loader.Size(width=64, height=48, photographs=3, steps=3, batch=2, readers=(0, 2))


@pytest.fixture
def folders(tmp_path):
    return loader.write_pairs(tmp_path / "pairs", TOY)


def test_every_row_is_measured_from_folders_and_packs(tmp_path, folders):
    pack_pairs([folders], tmp_path / "packed", shard_bytes=10_000)
    said = []
    sources = {"folders": folders, "packed": PackedPairs(str(tmp_path / "packed"))}
    rows = loader.measure(sources, TOY, tmp_path / "work", said.append)
    assert [(row.source, row.what, row.readers) for row in rows] == [
        (source, what, readers) for source in sources for what in ("pictures", "latents") for readers in (0, 2)
    ]
    assert len(said) == len(rows)
    for row in rows:
        assert row.pairs_per_second > 0
        assert row.cpu_seconds_a_pair > 0
        # both are rounded
        assert row.h100s == pytest.approx(row.pairs_per_second / loader.PAPER_PAIRS_PER_SECOND, abs=0.1)


def read_all(source, cache, loop, *, rank=0, count=1):
    mixture, _ = split_mixture([source], weights=(), held_out=0.0, seed=3)
    pairs = PairLoader(mixture, cache, ("target",), loop=loop, rank=rank, count=count)
    found = [[[one.pictures["target"] for one in batch] for batch in pairs.batches(step)] for step in range(loop.steps)]
    pairs.close()
    assert pairs.waited > 0
    return found


def test_threads_and_processes_change_when_a_pair_is_read_but_not_which(tmp_path, folders):
    cache = LatentCache(tmp_path / "none", lambda images: images, width=64, height=48, autoencoder="")
    plain = LoopOptions(steps=6, batch=4, accumulate=2, readers=0)
    wanted = read_all(folders, cache, plain)
    assert [len(batch) for step in wanted for batch in step] == [2] * 12
    for readers in (1, 3):
        found = read_all(folders, cache, replace(plain, readers=readers))
        assert all(
            torch.equal(a, b)
            for steps in zip(found, wanted, strict=True)
            for one, other in zip(*steps, strict=True)
            for a, b in zip(one, other, strict=True)
        )
    shares = [read_all(folders, cache, plain, rank=rank, count=2) for rank in (0, 1)]
    for step, whole in enumerate(wanted):
        # passes go to the processes in turn: pass 0 of both, then pass 1 of both
        together = [picture for number in (0, 1) for share in shares for picture in share[step][number]]
        assert all(torch.equal(a, b) for a, b in zip(together, [p for batch in whole for p in batch], strict=True))


def test_a_number_of_threads_below_zero_is_one_line():
    with pytest.raises(ValueError, match="--readers: expected a number of threads from 0, found -1"):
        LoopOptions(readers=-1).check(1)
