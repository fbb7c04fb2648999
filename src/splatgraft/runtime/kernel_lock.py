"""A lock that lets one parallel numba kernel run at a time in a process."""

import functools
import threading
from collections.abc import Callable
from typing import Any

KERNEL_LOCK = threading.Lock()
"""Held while a kernel runs: without OpenMP numba uses its workqueue layer, which aborts the process when two threads
start kernels at the same time."""


def serialized(kernel: Callable[..., Any]) -> Callable[..., Any]:
    """`kernel`, called under the lock; must not be called while the lock is held, nor from another kernel."""

    @functools.wraps(kernel)
    def call(*args: Any) -> Any:
        with KERNEL_LOCK:
            return kernel(*args)

    return call
