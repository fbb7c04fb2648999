"""One parallel kernel at a time in a process. Knows no kernel."""

import functools
import threading
from collections.abc import Callable
from typing import Any

KERNEL_LOCK = threading.Lock()
"""Held while a kernel runs: numba's workqueue threads, which a machine without OpenMP has, end the process where two
threads start kernels at once."""


def serialized(kernel: Callable[..., Any]) -> Callable[..., Any]:
    """`kernel`, called under the lock; it must not be called by what holds it, nor from within another kernel."""

    @functools.wraps(kernel)
    def call(*args: Any) -> Any:
        with KERNEL_LOCK:
            return kernel(*args)

    return call
