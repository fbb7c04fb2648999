"""Quantisation by learnt tables: 256 numbers for scalars, a palette for the higher SH bands (Lloyd 1982, both).

A palette of thousands of entries is found in two levels, as a search over all entries for all Gaussians would take
minutes: rows are first divided among coarse groups, then each group gets its share of the entries.
"""

import numpy as np
import torch
from jaxtyping import Float, Int64, UInt8
from torch import Tensor

from splatgraft.core.k_means import k_means

CODES = 256
_SCALAR_ROUNDS = 100
_COARSE_GROUPS = 256
_COARSE_SAMPLE = 1 << 15
"""Rows that the coarse groups are found from."""
_ROUNDS = 5
"""Of the coarse groups, and of the entries in each; more rounds changed the pictures of a demo by less than 0.1 dB."""
_CHUNK = 1 << 14


def scalar_codes(values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "256"]:
    """256 ascending numbers that represent `values` with a small squared error; the last one repeated where fewer do.

    Starts from quantiles of the values, and moves each code to the mean of the values nearest to it.
    """
    ordered = np.sort(values.astype(np.float64))
    if not len(ordered):
        return np.zeros(CODES, np.float32)
    distinct = np.unique(ordered)
    if len(distinct) <= CODES:
        return np.pad(distinct, (0, CODES - len(distinct)), mode="edge").astype(np.float32)
    # half of the codes by quantiles, half evenly over the range, so that rare large values have codes from the start
    codes = np.sort(
        np.concatenate(
            [np.quantile(ordered, (np.arange(CODES // 2) + 0.5) / (CODES // 2)),
             np.linspace(ordered[0], ordered[-1], CODES // 2)]
        )
    )  # fmt: skip
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    for _ in range(_SCALAR_ROUNDS):
        ends = np.concatenate([[0], np.searchsorted(ordered, (codes[1:] + codes[:-1]) / 2), [len(ordered)]])
        counts = np.diff(ends)
        codes = np.where(counts > 0, np.diff(sums[ends]) / np.maximum(counts, 1), codes)
    return np.sort(codes).astype(np.float32)


def nearest_codes(values: Float[np.ndarray, "*shape"], codes: Float[np.ndarray, "256"]) -> UInt8[np.ndarray, "*shape"]:
    """Index of the code nearest to each value; codes ascend."""
    return np.searchsorted((codes[1:] + codes[:-1]) / 2, values).astype(np.uint8)


def palette(rows: Float[Tensor, "n f"], size: int) -> tuple[Float[Tensor, "p f"], Int64[Tensor, "n"]]:
    """At most `size` rows that represent all, and which of them represents each row.

    Args:
        rows: Feature vectors.
        size: Most entries; all rows themselves are entries where they are no more.
    """
    n = len(rows)
    if n <= size:
        return rows, torch.arange(n)
    group = _nearest(rows, _coarse_means(rows, min(_COARSE_GROUPS, size)))
    members = [torch.nonzero(group == i)[:, 0] for i in range(int(group.max()) + 1)]
    entries, labels, start = [], torch.empty(n, dtype=torch.int64), 0
    for chosen in members:
        if not len(chosen):
            continue
        own = rows[chosen]
        # rounded down, and at least one: no more than `size` in all, as groups are no more than entries
        share = max(1, int(len(chosen) / n * (size - len(members))))
        means = k_means(own, own[_spread(len(own), share)], rounds=_ROUNDS)
        entries.append(means)
        labels[chosen] = start + _nearest(own, means)
        start += len(means)
    return torch.cat(entries), labels


def _coarse_means(rows: Float[Tensor, "n f"], count: int) -> Float[Tensor, "g f"]:
    sample = rows[_spread(len(rows), min(len(rows), _COARSE_SAMPLE))]
    return k_means(sample, sample[_spread(len(sample), count)], rounds=_ROUNDS)


def _spread(n: int, count: int) -> Int64[Tensor, "count"]:
    """`count` of n indices, evenly spaced."""
    return (torch.arange(count) * n) // count


def _nearest(rows: Float[Tensor, "n f"], means: Float[Tensor, "k f"]) -> Int64[Tensor, "n"]:
    return torch.cat([torch.cdist(part, means).argmin(1) for part in rows.split(_CHUNK)])
