"""Search for a model that poses enough photos and explains enough of their matches.

The search tries, in this order, until a model is good enough:

1. the cheapest choice of pairs, with all features;
2. the same pairs, with the features inside the masks;
3. more pairs, with the features that gave the better model.

If there are masks, only photos count whose poses explain the object's own matches. So a background that moved against
the object does not decide, even if it explains all photos.

The global mapper makes the models (GLOMAP: Pan et al. 2024, Global Structure-from-Motion Revisited), because it
averages the rotations of all pairs. The incremental mapper starts from one pair. If the matches of this pair lie on a
plane, its pose can be wrong at a small error, and the shared lens is then distorted until the other photos fit.
"""

import json
import os
import shutil
import threading
from pathlib import Path
from typing import Any

import pycolmap

from .database import (
    copy_database,
    copy_with_features,
    find_features,
    inside_masks,
    levels,
    match,
    unmatched_pairs,
    with_calibrated_focals,
)
from .job import Clock, Job, say
from .refinement import refined
from .scores import Answer, agreements, best_of, connected_photos, moved_photos, photo_figures

_ALL, _MASKED = "photos", "masked"  # names of the databases with all features, and with those inside the masks
_ENOUGH_PHOTOS = 0.9  # smallest share of photos with a pose at which the search may end
_CLEAR_EXPLAINED = 0.5  # smallest share of verified matches explained at which the search may end


def main(words: dict[str, Any]) -> None:
    """Write the best model of the job in `words` to its output file, as JSON."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)  # pyright: ignore[reportAttributeAccessIssue]
    job, clock = Job(**words), Clock()
    pycolmap.set_random_seed(job.seed)
    with clock.phase("features"):
        find_features(job)
    best = _search(job, clock)
    times = {"seconds": clock.seconds, "cpu_seconds": clock.cpu_seconds}
    pairs = agreements(_database(job, best["database"]), best["images"])
    _write(job.output, best | {"photos": photo_figures(_database(job, _ALL), best), "agreements": pairs} | times)


def _end_with_parent() -> None:
    """End this process when standard input closes, as it does if the parent is killed; the next run needs its files."""
    # sys.stdin has a lock; if a thread holds it at exit, Python ends with an error
    while os.read(0, 1):
        pass
    os._exit(1)


def _write(path: Path, content: dict[str, Any]) -> None:
    """Write JSON completely or not at all."""
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(content), encoding="utf-8")
    os.replace(partial, path)


def _search(job: Job, clock: Clock) -> Answer:
    answers: list[Answer] = []

    def is_enough_after(name: str, level: str) -> bool:
        """Match the pairs of `level`, make a model, and return whether the search may end."""
        database = _database(job, name)
        with clock.phase("matching"):
            clock.pairs += match(job, database, level)
            if job.masks and name != _MASKED:
                copy_with_features(database, _database(job, _MASKED), inside_masks(job, database))
                clock.pairs += match(job, _database(job, _MASKED), level)
        answers.append(_answer(job, clock, name, level))
        posed = len(answers[-1]["images"])
        # before the last level, photos without matches may still get some from more pairs
        return (
            answers[-1]["explained"] >= _CLEAR_EXPLAINED
            and posed >= _ENOUGH_PHOTOS * connected_photos(_database(job, _ALL))
            and (level == levels(job)[-1] or posed >= _ENOUGH_PHOTOS * len(job.names))
        )

    first, *further = levels(job)
    if is_enough_after(_ALL, first):
        return _best(answers)
    if job.masks:
        say(f"{_shortfall(answers, job)}: trying again with only the features inside the masks")
        if is_enough_after(_MASKED, first):
            return _best(answers)
    for level in further:
        best = _best(answers)
        if len(best["images"]) >= _ENOUGH_PHOTOS * len(job.names):
            break
        pairs, seconds = unmatched_pairs(job, _database(job, best["database"])), clock.seconds_per_pair
        time = f", about {max(1, round(pairs * seconds / 60))} min" if seconds else ""
        say(f"{_shortfall(answers, job)}: comparing up to {pairs} more pairs of photos{time}")
        if is_enough_after(best["database"], level):
            break
    return _best(answers)


def _database(job: Job, name: str) -> Path:
    return job.folder / f"{name}.db"


def _answer(job: Job, clock: Clock, name: str, level: str) -> Answer:
    """Make a model from the matches in a database, or read the one that a killed run left in the scratch folder.

    Photos that contradict the matches on the object are in the file, not in the result.
    """
    method = f"global, {level} pairs{' inside the masks' if name == _MASKED else ''}"
    path = job.folder / "answers" / f"{method}.json"
    if not path.is_file():
        path.parent.mkdir(exist_ok=True)
        matched, work = _database(job, name), job.folder / "mapping.db"
        with clock.phase("mapping"):
            is_calibrated = job.camera_model == "EQUIRECTANGULAR"
            work = copy_database(matched, work) if is_calibrated else with_calibrated_focals(matched, work, job.seed)
            models = _global_models(job, work)
        with clock.phase("refinement"):
            better = [refined(job, work, models)] if models else []
        found = best_of(matched, [*models, *better], len(job.names))
        found["moved"] = moved_photos(_database(job, _MASKED), found, Path(job.masks)) if job.masks else []
        _write(path, found | {"models": len(models), "method": method, "database": name})
    answer = json.loads(path.read_text(encoding="utf-8"))
    return answer | {"images": [image for image in answer["images"] if image["name"] not in answer["moved"]]}


def _best(answers: list[Answer]) -> Answer:
    """Choose between the best model with all features and the best with the features inside the masks.

    Masks remove the matches that are hardest to explain. Explained shares are therefore compared only up to
    `_CLEAR_EXPLAINED`. Ties go to all features, because a still background makes poses more accurate.
    """
    best: dict[str, Answer] = {}
    for answer in sorted(answers, key=lambda answer: (answer["database"] == _MASKED, -answer["score"])):
        best.setdefault(answer["database"], answer)
    return max(best.values(), key=lambda answer: len(answer["images"]) * min(answer["explained"], _CLEAR_EXPLAINED))


def _shortfall(answers: list[Answer], job: Job) -> str:
    """Describe the best model so far by photos and explained matches."""
    best = _best(answers)
    moved = f", {len(best['moved'])} more contradict the object's matches" if best["moved"] else ""
    return f"{len(best['images'])} of {len(job.names)} photos{moved}, {best['explained']:.0%} of matches explained"


def _global_models(job: Job, database: Path) -> list[Any]:
    folder = job.folder / "models"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    # one thread: several add sums in another order each time, and save only a tenth of the time
    options = pycolmap.GlobalPipelineOptions(num_threads=1, random_seed=job.seed, min_model_size=3)
    options.mapper.bundle_adjustment.ceres.use_gpu = False
    options.mapper.global_positioning.use_gpu = False
    return list(pycolmap.global_mapping(database, Path(job.photos), folder, options).values())
