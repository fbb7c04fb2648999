"""A training pair from four pictures on disk: target, background, mask, and the object under another light."""

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol, runtime_checkable

from splatgraft.core.images import read_mask, read_rgb, read_straight_rgb
from splatgraft_paper.synthesis.pairs import composite, match_statistics
from splatgraft_paper.training.sources.pair_source import PairSource, TrainingPair

PICTURES = ("target", "background", "mask", "relit")
"""Names of the pictures that make a pair."""


@runtime_checkable
class FilePairs(PairSource, Protocol):
    """A source whose pairs are four files each."""

    def files(self, index: int) -> dict[str, Path]:
        """The files of a pair, by `PICTURES`."""
        ...


def read_pair(files: Mapping[str, Path]) -> TrainingPair:
    """Read a pair; its composite has the relit object at the exposure of the object in the scene (paper, Eq. 2).

    Raises:
        ValueError: a file is missing or broken, or has another size than the target.
    """
    target, background = read_rgb(files["target"]), read_rgb(files["background"])
    mask, relit = read_mask(files["mask"]), read_straight_rgb(files["relit"])
    for name, picture in (("background", background), ("mask", mask), ("relit", relit)):
        if picture.shape[:2] != target.shape[:2]:
            expected, found = (f"{size[1]}x{size[0]}" for size in (target.shape, picture.shape))
            raise ValueError(f"{files[name]}: expected {expected} pixels as {files['target'].name}, found {found}")
    return TrainingPair(composite(match_statistics(relit, target, mask), background, mask), target, background, mask)
