"""Refinement of a model: outliers dropped, all cameras adjusted, and the photos that it explains worst posed anew.

The global mapper places all photos at once, and a few of them wrongly: on 73 photos of a bonsai eight had 28% to 59% of
their matches explained where 74% is usual. The lens that all photos share bends towards them (836 px with, 827 px
without them). Such photos are taken out, the rest is adjusted, and each is posed from the points of the rest.
"""

from pathlib import Path
from typing import Any

import numpy as np

from .job import SEARCH, Job
from .joining import joined
from .lenses import crops, describe_crop, mean_error_px, with_full_lenses
from .refiner import Refiner
from .reporting import say
from .scores import Matches, explained_shares, posed_and_explained, read_matches


def refined(job: Job, database: Path, models: list[Any]) -> Any:
    """The best of `models`, of which there is at least one, with what others of them add to it, refined."""
    matches, refiner = read_matches(database), Refiner(job, database)
    start = joined(models) or max(models, key=lambda model: posed_and_explained(matches, model))
    best = _reposed(refiner, matches, refiner.adjusted(refiner.with_all_photos(start)))
    best = _with_own_lenses(job, database, matches, best)
    best.extract_colors_for_all_images(job.photos)
    return best


def _reposed(refiner: Refiner, matches: Matches, model: Any) -> Any:
    """The model with badly explained photos, and those without a pose, posed anew as long as the score grows."""
    import pycolmap

    best, tried_before = model, set()
    while True:
        shares = explained_shares(matches, best)
        usual = float(np.median(list(shares.values()))) if shares else 0.0
        poor = [i for i, share in sorted(shares.items()) if share < SEARCH.poor_share * usual]
        again = {*poor, *(i for i in best.images if not best.images[i].has_pose)}
        if again <= tried_before:
            return best
        tried_before |= again
        tried = refiner.reposed(pycolmap.Reconstruction(best), poor)
        if posed_and_explained(matches, tried) <= posed_and_explained(matches, best):
            return best
        best = tried


def _with_own_lenses(job: Job, database: Path, matches: Matches, model: Any) -> Any:
    """The model with the lenses of crops solved, where these photos then fit better and no fewer matches do.

    With a radial distortion around the optical axis first, which is right where a photo was cut out of a larger one;
    with OPENCV's, whose tangential part trades against the axis, where that fits better still.
    """
    photos = crops(model)
    images, best = [i for posed in photos.values() for i in posed], model
    for full in (False, True) if photos else ():
        lenses = with_full_lenses(database, job.folder / "lenses.db", set(photos)) if full else database
        refiner = Refiner(job, lenses)
        tried = refiner.with_lenses(refiner.with_all_photos(best), photos)
        if mean_error_px(tried, images) <= SEARCH.lens_error * mean_error_px(best, images) and posed_and_explained(
            matches, tried
        ) >= SEARCH.alike * posed_and_explained(matches, best):
            best = tried
    if best is not model:
        for camera, posed in photos.items():
            say(describe_crop(best, camera, posed))
    return best
