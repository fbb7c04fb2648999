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
import threading
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from .database import (
    Focals,
    calibrated_focals,
    copy_with_features,
    find_features,
    inside_masks,
    levels,
    match,
    median_focals,
    unmatched_pairs,
    with_focals,
    with_own_cameras,
)
from .job import Clock, Job, say
from .refinement import refined
from .scores import Answer, best_of, connected_photos, unposed

_ALL, _MASKED = "photos", "masked"
"""Names of the databases: with all features, and with those inside the masks."""
_ENOUGH_PHOTOS = 0.9
"""A model with this share of all photos, and with all that have matches, may end the search."""
_CLEAR_EXPLAINED = 0.5
"""It ends the search where it explains this share of all verified matches."""
_SAME_FOCAL = 0.03
"""A second start that is closer to the first than this share gives the same model."""

Mapper = Callable[[Job, Path, Path], list[Any]]
"""From a job, a database and an empty folder to models."""


def main(words: dict[str, Any]) -> None:
    """The best model of the job in `words` goes to its output, as JSON."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)  # pyright: ignore[reportAttributeAccessIssue]
    job, clock = Job(**words), Clock()
    pycolmap.set_random_seed(job.seed)
    with clock.phase("features"):
        find_features(job)
    best = _Search(job, clock).best()
    best |= {"unposed": unposed(job.folder / f"{_ALL}.db", best)}
    _write(job.output, best | {"seconds": clock.seconds, "cpu_seconds": clock.cpu_seconds})


def _end_with_parent() -> None:
    """A parent that is killed closes its end of the standard input; the next run then has the databases to itself."""
    # not sys.stdin, whose lock ends Python with an error when a thread holds it at the end
    while os.read(0, 1):
        pass
    os._exit(1)


def _write(path: Path, content: dict[str, Any]) -> None:
    """Write JSON as a whole or not at all."""
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(content))
    os.replace(partial, path)


@dataclass(frozen=True)
class _Search:
    """What a search for a model needs; what a killed run finished is not made again."""

    job: Job
    clock: Clock

    def best(self) -> Answer:
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
            all_features = self._database(_ALL)
            copy_with_features(all_features, self._database(_MASKED), inside_masks(job, all_features))
            self._match(_MASKED, first)
            yield first, self._global(_MASKED, first)
        for level in further:
            best = _best(answers)
            if len(best["images"]) >= _ENOUGH_PHOTOS * len(job.names):
                break
            pairs, seconds = unmatched_pairs(job, self._database(best["database"])), self.clock.seconds_per_pair
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
        posed, job = len(answer["images"]), self.job
        return (
            answer["explained"] >= _CLEAR_EXPLAINED
            and posed >= _ENOUGH_PHOTOS * connected_photos(self._database(_ALL))
            and (level == levels(job)[-1] or posed >= _ENOUGH_PHOTOS * len(job.names))
        )

    def _database(self, name: str) -> Path:
        return self.job.folder / f"{name}.db"

    def _match(self, database: str, level: str) -> None:
        with self.clock.phase("matching"):
            self.clock.pairs += match(self.job, self._database(database), level)

    def _global(self, database: str, level: str) -> Answer:
        inside = " inside the masks" if database == _MASKED else ""
        return self._model(f"global, {level} pairs{inside}", database, self._start(database, level), _global_models)

    def _incremental(self, database: str, level: str) -> Generator[Answer]:
        """With a camera per photo first; its median focal lengths start two more models."""
        start = self._start(database, level)
        if all(len(names) == 1 for names in self.job.groups):
            yield self._model("incremental", database, start, _incremental_models)
            return
        medians = self._focals(f"{database}, medians", lambda: self._medians(database))
        if any(abs(f / start.get(camera, np.inf) - 1) > _SAME_FOCAL for camera, f in medians.items()):
            yield self._model("global from medians", database, medians, _global_models)
        yield self._model("incremental from medians", database, medians, _incremental_models)

    def _model(self, method: str, database: str, focals: Focals, mapper: Mapper) -> Answer:
        def make() -> Answer:
            matched = self._database(database)
            with self.clock.phase("mapping"):
                work = with_focals(matched, self.job.folder / "mapping.db", focals)
                models = mapper(self.job, work, _fresh_folder(self.job))
            with self.clock.phase("refinement"):
                better = [refined(self.job, work, models)] if models else []
            found = best_of(matched, [*models, *better], len(self.job.names))
            return found | {"models": len(models), "method": method, "database": database}

        return self._kept(method, make)

    def _start(self, database: str, level: str) -> Focals:
        def make() -> Focals:
            with self.clock.phase("mapping"):
                return calibrated_focals(self._database(database), self.job.seed)

        return self._focals(f"{database}, {level} pairs, focal lengths", make)

    def _medians(self, database: str) -> Focals:
        with self.clock.phase("mapping"):
            own = with_own_cameras(self._database(database), self.job.folder / "own.db")
            return median_focals(self._database(database), _incremental_models(self.job, own, _fresh_folder(self.job)))

    def _focals(self, name: str, make: Callable[[], Focals]) -> Focals:
        # JSON has texts as keys
        return {int(camera): focal for camera, focal in self._kept(name, make).items()}

    def _kept(self, name: str, make: Callable[[], dict[Any, Any]]) -> dict[str, Any]:
        """What `make` gives, read from the scratch folder where a killed run left it."""
        path = self.job.folder / "answers" / f"{name}.json"
        if not path.is_file():
            path.parent.mkdir(exist_ok=True)
            _write(path, make())
        return json.loads(path.read_text())


def _best(answers: list[Answer]) -> Answer:
    """The best score with all features, or with those inside the masks where these pose more photos or explain more.

    Masks leave out what is hardest to explain, so that more than `_CLEAR_EXPLAINED` speaks for neither side; the
    background then counts, which makes poses more accurate where the scene is still.
    """
    best: dict[str, Answer] = {}
    for answer in sorted(answers, key=lambda answer: (answer["database"] == _MASKED, -answer["score"])):
        best.setdefault(answer["database"], answer)
    return max(best.values(), key=lambda answer: len(answer["images"]) * min(answer["explained"], _CLEAR_EXPLAINED))


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
    # one thread: more add sums in another order each time, and save only a tenth of the time
    options = pycolmap.GlobalPipelineOptions(num_threads=1, random_seed=job.seed, min_model_size=3)
    options.mapper.bundle_adjustment.ceres.use_gpu = False
    options.mapper.global_positioning.use_gpu = False
    return list(pycolmap.global_mapping(database, Path(job.photos), folder, options).values())


def _incremental_models(job: Job, database: Path, folder: Path) -> list[Any]:
    options = pycolmap.IncrementalPipelineOptions(num_threads=job.threads, random_seed=job.seed, min_model_size=3)
    return list(pycolmap.incremental_mapping(database, Path(job.photos), folder, options).values())
