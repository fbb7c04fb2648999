"""Verified matches between photos: of selected pairs, of neighbours, or of all pairs."""

import os
import sqlite3
from contextlib import closing
from pathlib import Path

from .features import copy_with_features, fresh, largest
from .job import SEARCH, Job

NEIGHBOURING, PROMISING, ALL = "neighbouring", "promising", "all"


def levels(job: Job) -> list[str]:
    """Choices of pairs, the cheapest first; each holds the earlier ones."""
    choices = [PROMISING, ALL] if len(job.names) > SEARCH.preselect_above else [ALL]
    return choices if job.exhaustive else [NEIGHBOURING, *choices]


def match(job: Job, database: Path, level: str) -> int:
    """Match the pairs of `level`; those that are matched already are not matched again.

    Returns:
        The number of pairs that were matched.
    """
    import pycolmap

    before = _matched(database)
    if level == NEIGHBOURING:
        pycolmap.match_sequential(
            database, _matching(job), verification_options=_verification(job), device=pycolmap.Device.cpu
        )
    elif level == ALL:
        pycolmap.match_exhaustive(
            database, _matching(job), verification_options=_verification(job), device=pycolmap.Device.cpu
        )
    else:
        pycolmap.match_image_pairs(
            database,
            _matching(job),
            pycolmap.ImportedPairingOptions(match_list_path=str(_kept_pairs(job, database))),
            verification_options=_verification(job),
            device=pycolmap.Device.cpu,
        )
    return _matched(database) - before


def unmatched_pairs(job: Job, database: Path, level: str) -> int:
    """The most pairs that `match` has left to match at this level."""
    photos = len(job.names)
    return photos * (photos - 1) // 2 - _matched(database)


def _matched(database: Path) -> int:
    """Pairs that were compared, with or without a match."""
    with closing(sqlite3.connect(database)) as opened:
        return int(opened.execute("SELECT COUNT(*) FROM two_view_geometries").fetchone()[0])


def _kept_pairs(job: Job, database: Path) -> Path:
    """The file of promising pairs, which a killed run may have left."""
    pairs = database.with_suffix(".pairs.txt")
    if not pairs.exists():
        chosen = _promising_pairs(job, database)
        partial = fresh(pairs.with_suffix(".partial"))
        partial.write_text("".join(f"{a} {b}\n" for a, b in chosen))
        os.replace(partial, pairs)
    return pairs


def _promising_pairs(job: Job, database: Path) -> list[tuple[str, str]]:
    """Pairs whose largest features match; a photo with few of these is paired with every other."""
    import pycolmap

    small = database.with_suffix(".small.db")
    if not small.exists():
        copy_with_features(database, small, largest(SEARCH.preselect_features))
    options = pycolmap.FeatureMatchingOptions(num_threads=job.threads, use_gpu=False, skip_geometric_verification=True)
    pycolmap.match_exhaustive(small, options, device=pycolmap.Device.cpu)
    with pycolmap.Database.open(small) as few:
        names = {image.image_id: image.name for image in few.read_all_images()}
        pairs = {pycolmap.pair_id_to_image_pair(pair) for pair in few.read_all_matches()[0]}
    for i in names:
        if sum(i in pair for pair in pairs) < SEARCH.preselect_partners:
            pairs |= {(min(i, other), max(i, other)) for other in names if other != i}
    return [(names[a], names[b]) for a, b in sorted(pairs)]


def _matching(job: Job):
    import pycolmap

    matching = pycolmap.FeatureMatchingOptions(num_threads=job.threads, use_gpu=False)
    if job.thorough:
        matching.sift.max_ratio = 0.85
        matching.guided_matching = True
    return matching


def _verification(job: Job):
    import pycolmap

    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = job.seed
    return verification
