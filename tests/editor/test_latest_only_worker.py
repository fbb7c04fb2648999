"""The worker that does the newest request."""

import threading

from splatgraft.editor.previews.latest_only_worker import LatestOnlyWorker


def test_what_was_overtaken_is_never_done_and_a_failure_ends_nothing() -> None:
    access, done, failed = threading.Event(), [], []
    finished = threading.Event()

    def work(request: int) -> None:
        access.wait(20)
        if request == 3:
            raise ValueError("three")
        done.append(request)
        if request == 4:
            finished.set()

    worker = LatestOnlyWorker(work, lambda error: failed.append(str(error)))
    worker.submit(0)
    while worker.superseded:
        pass
    for request in (1, 2, 3):
        worker.submit(request)
    assert worker.superseded
    access.set()
    while not failed:
        pass
    worker.submit(4)
    assert finished.wait(20)
    worker.close()
    assert done == [0, 4]
    assert failed == ["three"]


def test_idle_ends_when_something_newer_comes() -> None:
    started, answers, errors = threading.Event(), [], []

    def work(request: int) -> None:
        if request == 0:
            started.set()
            answers.append(worker.wait_idle(20.0))
        else:
            answers.append(worker.wait_idle(0.01))
            started.set()

    worker = LatestOnlyWorker(work, errors.append)
    worker.submit(0)
    assert started.wait(20)
    started.clear()
    worker.submit(1)
    assert started.wait(20)
    worker.close()
    assert not errors
    assert answers == [False, True]
