"""The search for a model: matchings, masks and mappers, the likeliest first, until one holds and explains enough.

The global mapper (GLOMAP: Pan et al. 2024, Global Structure-from-Motion Revisited) comes first. The incremental mapper
starts from one pair of photos, and where the matches of that pair lie on a plane its pose can be wrong while its error
is small: on 72 photos of a bonsai on a table the first pair was turned by 24 degrees instead of 36, with its baseline
33 degrees off, at 0.29 px. A focal length and a distortion that all photos share then bend until the rest fits, and
nothing undoes it, not even the right focal length held fixed. Averaging the rotations of all pairs has no first pair.
"""

import json
import os
import shutil
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .features import copy_with_features, inside_masks
from .focal_lengths import Focals, calibrated_focals, median_focals, with_focals, with_own_cameras
from .job import SEARCH, Job
from .matching import levels, match, unmatched_pairs
from .refinement import refined
from .reporting import Clock, say
from .scores import Answer, best_of, connected_photos

_ALL, _MASKED = "photos", "masked"
"""Names of the databases: with all features, and with those inside the masks."""


@dataclass(frozen=True)
class ModelSearch:
    """What a search for a model needs; what a killed run finished is not made again."""

    job: Job
    """What is posed."""
    clock: Clock
    """Measures the phases."""

    def best(self) -> Answer:
        """The best model by the score of `best_of`."""
        answers: list[Answer] = []
        for level, answer in self._candidates(answers):
            answers.append(answer)
            if self._is_enough(answer, level):
                break
        return _best(answers)

    def _candidates(self, answers: list[Answer]) -> Generator[tuple[str, Answer]]:
        """Which pairs are matched by then, and a model, which is made when it is asked for; `answers`: those before."""
        job, (first, *further) = self.job, levels(self.job)
        self._match(_ALL, first)
        yield first, self._global(_ALL, first)
        if job.masks:
            say(f"{_shortfall(answers, job)}: tried again with the features inside the masks alone")
            if not _database(job, _MASKED).exists():
                all_features = _database(job, _ALL)
                copy_with_features(all_features, _database(job, _MASKED), inside_masks(job, all_features))
            self._match(_MASKED, first)
            yield first, self._global(_MASKED, first)
        for level in further:
            best = _best(answers)
            if len(best["images"]) >= SEARCH.enough_photos * len(job.names):
                break
            pairs, seconds = unmatched_pairs(job, _database(job, best["database"]), level), self.clock.seconds_per_pair
            time = f", about {max(1, round(pairs * seconds / 60))} min" if seconds else ""
            say(f"{_shortfall(answers, job)}: up to {pairs} more pairs of photos are compared{time}")
            self._match(best["database"], level)
            yield level, self._global(best["database"], level)
            first = level
        say(f"{_shortfall(answers, job)}: tried again with the incremental mapper")
        for answer in self._incremental(_best(answers)["database"], first):
            yield first, answer

    def _is_enough(self, answer: Answer, level: str) -> bool:
        """Whether the search may end; more pairs may connect photos that have too few matches so far."""
        posed, share = len(answer["images"]), SEARCH.enough_photos
        connected = connected_photos(_database(self.job, _ALL))
        return (
            answer["explained"] >= SEARCH.clear_explained
            and posed >= share * connected
            and (level == levels(self.job)[-1] or posed >= share * len(self.job.names))
        )

    def _match(self, database: str, level: str) -> None:
        with self.clock.phase("matching"):
            self.clock.pairs += match(self.job, _database(self.job, database), level)

    def _global(self, database: str, level: str) -> Answer:
        inside = " inside the masks" if database == _MASKED else ""
        return self._model(f"global, {level} pairs{inside}", database, self._start(database, level), _global_models)

    def _incremental(self, database: str, level: str) -> Generator[Answer]:
        """With a camera per photo first; its median focal lengths start two more models."""
        start = self._start(database, level)
        if all(len(names) == 1 for names in self.job.groups):
            yield self._model("incremental", database, start, _incremental_models)
            return
        medians = self._kept(f"{database}, medians", lambda: self._medians(database))
        if any(abs(f / start.get(camera, np.inf) - 1) > SEARCH.same_focal for camera, f in _focals(medians).items()):
            yield self._model("global from medians", database, _focals(medians), _global_models)
        yield self._model("incremental from medians", database, _focals(medians), _incremental_models)

    def _model(self, method: str, database: str, focals: Focals, mapper: "Mapper") -> Answer:
        def make() -> Answer:
            matched = _database(self.job, database)
            with self.clock.phase("mapping"):
                work = with_focals(matched, self.job.folder / "mapping.db", focals)
                models = mapper(self.job, work, _fresh_folder(self.job))
            with self.clock.phase("refinement"):
                better = [refined(self.job, work, models)] if models else []
            found = best_of(matched, [*models, *better], len(self.job.names))
            return found | {"models": len(models), "method": method, "database": database}

        return self._kept(method, make)

    def _start(self, database: str, level: str) -> Focals:
        def make() -> dict[str, float]:
            with self.clock.phase("mapping"):
                return {str(i): f for i, f in calibrated_focals(_database(self.job, database), self.job.seed).items()}

        return _focals(self._kept(f"{database}, {level} pairs, focal lengths", make))

    def _medians(self, database: str) -> dict[str, float]:
        with self.clock.phase("mapping"):
            own = with_own_cameras(_database(self.job, database), self.job.folder / "own.db")
            models = _incremental_models(self.job, own, _fresh_folder(self.job))
            return {str(i): f for i, f in median_focals(_database(self.job, database), models).items()}

    def _kept(self, name: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """What `make` gives, read from the scratch folder where a killed run left it."""
        path = self.job.folder / "answers" / f"{name}.json"
        if not path.is_file():
            path.parent.mkdir(exist_ok=True)
            path.with_suffix(".partial").write_text(json.dumps(make()))
            os.replace(path.with_suffix(".partial"), path)
        return json.loads(path.read_text())


Mapper = Callable[[Job, Path, Path], list[Any]]
"""From a job, a database and an empty folder to models."""


def _database(job: Job, name: str) -> Path:
    return job.folder / f"{name}.db"


def _best(answers: list[Answer]) -> Answer:
    """The best score with all features, or with those inside the masks where these pose more photos or explain more.

    Masks leave out what is hardest to explain, so that more than `SEARCH.clear_explained` speaks for neither side; the
    background then counts, which makes poses more accurate where the scene is still.
    """
    by_database = {
        name: max(found, key=lambda answer: answer["score"])
        for name in (_ALL, _MASKED)
        if (found := [answer for answer in answers if answer["database"] == name])
    }
    return max(
        by_database.values(),
        key=lambda answer: len(answer["images"]) * min(answer["explained"], SEARCH.clear_explained),
    )


def _focals(kept: dict[str, float]) -> Focals:
    """JSON has texts as keys."""
    return {int(camera): focal for camera, focal in kept.items()}


def _shortfall(answers: list[Answer], job: Job) -> str:
    """What the best model so far lacks."""
    best = _best(answers)
    return f"{len(best['images'])} of {len(job.names)} photos, {best['explained']:.0%} of matches explained"


def _fresh_folder(job: Job) -> Path:
    folder = job.folder / "models"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder


def _global_models(job: Job, database: Path, folder: Path) -> list[Any]:
    import pycolmap

    # one thread: more add sums in another order each time, and save only a tenth of the time
    options = pycolmap.GlobalPipelineOptions(num_threads=1, random_seed=job.seed, min_model_size=3)
    options.mapper.bundle_adjustment.ceres.use_gpu = False
    options.mapper.global_positioning.use_gpu = False
    return list(pycolmap.global_mapping(database, Path(job.photos), folder, options).values())


def _incremental_models(job: Job, database: Path, folder: Path) -> list[Any]:
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions(num_threads=job.threads, random_seed=job.seed, min_model_size=3)
    return list(pycolmap.incremental_mapping(database, Path(job.photos), folder, options).values())
