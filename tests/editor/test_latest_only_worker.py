"""The worker that processes only the newest request."""

import threading

from waiting import HANG_LIMIT, wait_until

from splatgraft.editor.previews.latest_only_worker import LatestOnlyWorker


def test_superseded_requests_are_skipped_and_errors_do_not_end_the_worker() -> None:
    release, done, failed = threading.Event(), [], []
    finished = threading.Event()

    def work(request: int) -> None:
        release.wait(HANG_LIMIT)
        if request == 3:
            raise ValueError("three")
        done.append(request)
        if request == 4:
            finished.set()

    worker = LatestOnlyWorker(work, lambda error: failed.append(str(error)))
    worker.submit(0)
    wait_until(lambda: not worker.superseded, what="the start of the first request")
    for request in (1, 2, 3):
        worker.submit(request)
    assert worker.superseded
    release.set()
    wait_until(lambda: bool(failed), what="the error of the third request")
    worker.submit(4)
    assert finished.wait(HANG_LIMIT)
    worker.close()
    assert done == [0, 4]
    assert failed == ["three"]


def test_waiting_for_idleness_ends_with_a_newer_request() -> None:
    started, answers, errors = threading.Event(), [], []

    def work(request: int) -> None:
        if request == 0:
            started.set()
            answers.append(worker.wait_idle(HANG_LIMIT))
        else:
            answers.append(worker.wait_idle(0.01))
            started.set()

    worker = LatestOnlyWorker(work, errors.append)
    worker.submit(0)
    assert started.wait(HANG_LIMIT)
    started.clear()
    worker.submit(1)
    assert started.wait(HANG_LIMIT)
    worker.close()
    assert not errors
    assert answers == [False, True]


def test_what_ends_after_closing_knows_it_and_reports_no_error() -> None:
    started, go_on, ended = threading.Event(), threading.Event(), threading.Event()
    errors: list[Exception] = []
    closed: list[bool] = []

    def work(request: int) -> None:
        started.set()
        assert go_on.wait(HANG_LIMIT)
        closed.append(worker.closed)
        ended.set()
        raise ValueError

    worker = LatestOnlyWorker(work, errors.append)
    worker.submit(0)
    assert started.wait(HANG_LIMIT)
    worker.close()
    go_on.set()
    assert ended.wait(HANG_LIMIT)
    worker._thread.join(HANG_LIMIT)
    assert closed == [True]
    assert not errors
