"""The worker that does the newest request."""

import threading

from splatgraft.editor.previews.latest_only_worker import LatestOnlyWorker


def test_what_was_overtaken_is_never_done_and_a_failure_ends_nothing() -> None:
    gate, done, failed = threading.Event(), [], []
    finished = threading.Event()

    def work(request: int) -> None:
        gate.wait(20)
        if request == 3:
            raise ValueError("three")
        done.append(request)
        if request == 4:
            finished.set()

    latest = LatestOnlyWorker(work, lambda error: failed.append(str(error)))
    latest.ask(0)
    while latest.overtaken:
        pass
    for request in (1, 2, 3):
        latest.ask(request)
    assert latest.overtaken
    gate.set()
    while not failed:
        pass
    latest.ask(4)
    assert finished.wait(20)
    latest.close()
    assert done == [0, 4]
    assert failed == ["three"]


def test_idle_ends_when_something_newer_comes() -> None:
    started, answers, errors = threading.Event(), [], []

    def work(request: int) -> None:
        if request == 0:
            started.set()
            answers.append(latest.idle(20.0))
        else:
            answers.append(latest.idle(0.01))
            started.set()

    latest = LatestOnlyWorker(work, errors.append)
    latest.ask(0)
    assert started.wait(20)
    started.clear()
    latest.ask(1)
    assert started.wait(20)
    latest.close()
    assert not errors
    assert answers == [False, True]
