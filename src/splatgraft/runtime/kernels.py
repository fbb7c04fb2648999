"""Numba kernels: compiled once and cached under a hash of all kernel sources, and run one at a time in a process."""

import functools
import hashlib
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

KERNEL_LOCK = threading.Lock()
"""Held while a kernel runs: without OpenMP numba uses its workqueue layer, which aborts the process when two threads
start kernels at the same time."""


def kernel(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """`numba.njit` with a cache that is renewed when any kernel source of the package changes.

    Numba looks at the file of the function alone, and would go on to run what it once inlined from another file.
    Constants that kernels use stand in files with kernels, too.
    """
    if function is None:
        return functools.partial(kernel, **options)
    compiled = numba.njit(cache=True, **options)(function)
    if not numba.config.DISABLE_JIT:
        index = compiled._cache._cache_file
        index._source_stamp = (index._source_stamp, _hash_of_sources())
    return compiled


@functools.cache
def _hash_of_sources() -> str:
    """Of all files of the package that name numba or this module."""
    sources = (path.read_bytes() for path in sorted(Path(__file__).parents[1].rglob("*.py")))
    kernels = [source for source in sources if b"numba" in source or b"runtime.kernels" in source]
    return hashlib.sha256(b"\0".join(kernels)).hexdigest()


def serialized(kernel: Callable[..., Any]) -> Callable[..., Any]:
    """`kernel`, called under the lock; must not be called while the lock is held, nor from another kernel."""

    @functools.wraps(kernel)
    def call(*args: Any) -> Any:
        with KERNEL_LOCK:
            return kernel(*args)

    return call
