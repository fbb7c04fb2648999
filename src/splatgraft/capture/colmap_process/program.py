"""Reads a job, finds features, searches for a model, and writes the best one as JSON."""

import json
import os
import threading
from pathlib import Path
from typing import Any

from .features import find_features
from .job import Job
from .mapping import ModelSearch
from .reporting import Clock
from .scores import unposed


def main(words: dict[str, Any]) -> None:
    """The best model of the job in `words` goes to its output."""
    import pycolmap

    threading.Thread(target=_end_with_parent, daemon=True).start()
    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)  # pyright: ignore[reportAttributeAccessIssue]
    job, clock = Job(**words), Clock()
    pycolmap.set_random_seed(job.seed)
    with clock.phase("features"):
        database = find_features(job)
    best = ModelSearch(job, clock).best()
    best |= {"unposed": unposed(database, best), "seconds": clock.seconds, "cpu_seconds": clock.cpu_seconds}
    partial = Path(job.output).with_suffix(".partial")
    partial.write_text(json.dumps(best))
    os.replace(partial, job.output)


def _end_with_parent() -> None:
    """A parent that is killed closes its end of the standard input; the next run then has the databases to itself."""
    # not sys.stdin, whose lock ends Python with an error when a thread holds it at the end
    while os.read(0, 1):
        pass
    os._exit(1)
